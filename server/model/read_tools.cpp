#include <set>

#include <fmt/format.h>

#include "core/limits.h"
#include "model/compile_parts.h"
#include "model/scene_input.h"

/// Reads the tools of a scene.
namespace tensormass::model {

namespace {

/// Returns the stiffest material of the scene: contact must not be softer than the tissue.
const Material& stiffest_of(const std::vector<ReadBody>& bodies) {
  const Material* found = &bodies.front().materials.front();
  for (const ReadBody& body : bodies) {
    for (const Material& material : body.materials) {
      if (material.young_modulus_pa > found->young_modulus_pa) found = &material;
    }
  }
  return *found;
}

/// stiffest: material that sets the default stiffness of contact.
Result<ToolModel> read_tool(const v1::Tool& tool, const Material& stiffest) {
  const std::string where = fmt::format("tool '{}'", tool.name());
  if (tool.kind_case() != v1::Tool::kSphericalProbe) {
    return invalid(fmt::format("{}: no kind that this server knows; give spherical_probe", where));
  }
  const v1::SphericalProbe& probe = tool.spherical_probe();
  ToolModel out;
  out.name = tool.name();
  TM_ASSIGN_OR_RETURN(radius, read_number(probe.radius_m(), 1e-6, 1e3, where + ".spherical_probe.radius_m"));
  out.radius_m = radius;
  TM_ASSIGN_OR_RETURN(tip, read_vector(probe.tip_offset_m(), where + ".spherical_probe.tip_offset_m"));
  out.tip_offset_m = tip;
  const double default_penalty = 20 * stiffest.young_modulus_pa / radius;
  TM_ASSIGN_OR_RETURN(penalty, read_number(probe.has_penalty_stiffness_pa_per_m() ? probe.penalty_stiffness_pa_per_m()
                                                                                  : default_penalty,
                                           1e-3, 1e18, where + ".spherical_probe.penalty_stiffness_pa_per_m"));
  out.penalty_pa_per_m = penalty;
  TM_ASSIGN_OR_RETURN(speed, read_number(tool.has_max_speed_m_per_s() ? tool.max_speed_m_per_s() : 0.5, 1e-6, 1e3,
                                         where + ".max_speed_m_per_s"));
  out.max_speed_m_per_s = speed;
  out.plane_strain_modulus_pa = stiffest.young_modulus_pa / (1 - stiffest.poisson_ratio * stiffest.poisson_ratio);
  TM_ASSIGN_OR_RETURN(position, read_vector(tool.position_m(), where + ".position_m"));
  out.initial_position_m = position;
  TM_ASSIGN_OR_RETURN(orientation, read_orientation(tool.orientation(), where + ".orientation"));
  out.initial_orientation = orientation;
  return out;
}

}  // namespace

Result<void> read_tools(Compilation& c) {
  if (static_cast<std::size_t>(c.scene.tools_size()) > limits::kMaxTools) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.tools: {} exceed limits::kMaxTools = {}", c.scene.tools_size(), limits::kMaxTools));
  }
  const Material& stiffest = stiffest_of(c.bodies);
  std::set<std::string> names;
  for (int i = 0; i < c.scene.tools_size(); ++i) {
    const v1::Tool& tool = c.scene.tools(i);
    TM_RETURN_IF_ERROR(check_name(tool.name(), fmt::format("scene.tools[{}].name", i)));
    if (!names.insert(tool.name()).second) {
      return invalid(fmt::format("scene.tools[{}]: the name '{}' is taken by another tool", i, tool.name()));
    }
    TM_ASSIGN_OR_RETURN(out, read_tool(tool, stiffest));
    c.model.tools.push_back(std::move(out));
  }
  return {};
}

}  // namespace tensormass::model
