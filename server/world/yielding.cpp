#include "world/yielding.h"

namespace tensormass::world {

YieldingSpring yielding_of(const model::Model& model, std::size_t tool, const Pose& pose,
                           std::span<const backend::BladeFront> fronts) {
  const physics::ToolParameters& parameters = model.tools[tool].parameters;
  const double spacing_m = parameters[0] / static_cast<double>(fronts.size() - 1), thickness_m = parameters[1];
  YieldingSpring out;
  double bulging_n_per_m = 0;
  for (const backend::BladeFront& front : fronts) {
    if (!(front.holds_n > 0) || front.element == view::kNoTetrahedron) continue;
    out.limit_n += front.holds_n;
    bulging_n_per_m += spacing_m * model.bodies[model.body_of_element(front.element)].most_surface_modulus_pa;
  }
  if (!(out.limit_n > 0)) return {};
  out.direction = physics::rotation(pose) * Vec3<double>::UnitX();
  const double bulges = bulging_n_per_m > 0 ? 1 / bulging_n_per_m : 0;
  out.stiffness_n_per_m = 1 / (thickness_m / out.limit_n + bulges);
  return out;
}

void read_yielding(const model::Model& model, std::span<const backend::BladeFront> fronts,
                   std::span<ToolReading> readings) {
  const model::Blades& blades = model.links.blades;
  for (std::uint32_t blade = 0; blade < blades.count(); ++blade) {
    const std::uint32_t tool = blades.tools[blade], first = blades.first_points[blade];
    ToolReading& reading = readings[tool];
    const bool is_scalpel = model.tools[tool].joints.empty();
    if (!is_scalpel || reading.gives_way || reading.retired) continue;
    reading.yielding =
        yielding_of(model, tool, reading.pose, fronts.subspan(first, blades.first_points[blade + 1] - first));
  }
}

}  // namespace tensormass::world
