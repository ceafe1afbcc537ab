#include "world/findings.h"

#include <algorithm>
#include <limits>

#include <fmt/format.h>

#include "physics/lists.h"

namespace tensormass::world {

namespace {
constexpr auto kRelaxed = std::memory_order_relaxed;
}

void Findings::take_step(const backend::StepResult& result) {
  if (!result.converged) unconverged_steps_.fetch_add(1, kRelaxed);
  newton_iterations_.store(result.newton_iterations, kRelaxed);
  newton_residual_.store(result.newton_residual, kRelaxed);
  converged_.store(result.converged, kRelaxed);
  negative_curvature_.store(result.negative_curvature, kRelaxed);
}

void Findings::take_watch(const World& world) {
  for (std::size_t g = 0; g < groups_.size(); ++g) {
    groups_[g].min_det_f.store(world.watched()[g].min_det_f, kRelaxed);
    groups_[g].max_strain.store(world.watched()[g].max_strain, kRelaxed);
    groups_[g].max_rotation_rad.store(world.watched()[g].max_rotation_rad, kRelaxed);
  }
}

void Findings::clear() {
  backend::StepResult nothing;
  nothing.newton_iterations = 0;
  take_step(nothing);
  unconverged_steps_ = 0;
  for (Group& group : groups_) {
    group.min_det_f = 1;
    group.max_strain = 0;
    group.max_rotation_rad = 0;
  }
}

void Findings::add_to(v1::SceneStatus& status) const {
  if (model_.iterates()) {
    const double residual = newton_residual_.load(kRelaxed);
    status.set_newton_iterations(newton_iterations_.load(kRelaxed));
    status.set_newton_residual(residual);
    status.set_unconverged_steps(unconverged_steps_.load(kRelaxed));
    if (!converged_.load(kRelaxed)) {
      status.add_warnings(
          fmt::format("the last step ended with an imbalance of {:.2g} of the forces, above newton_tolerance = {:.2g}; "
                      "give it more "
                      "newton_max_iterations or cg_max_iterations, or reach the load in smaller steps",
                      residual, model_.newton_tolerance));
    }
  }
  if (negative_curvature_.load(kRelaxed)) {
    status.add_warnings(
        "conjugate gradients met a direction of negative curvature and ended early; the matrix is at the end of its "
        "precision: take double, or a milder ratio of stiffness to mass");
  }
  double min_det_f = std::numeric_limits<double>::infinity();
  for (std::size_t g = 0; g < groups_.size(); ++g) {
    min_det_f = std::min(min_det_f, groups_[g].min_det_f.load(kRelaxed));
    const model::ElementGroup& group = model_.groups[g];
    // A pair of wedges is watched by its wedges.
    if (group.law != physics::index_of<physics::Hooke>(physics::Laws{}) || group.is_wedge_pairs()) continue;
    const double strain = groups_[g].max_strain.load(kRelaxed), rotation = groups_[g].max_rotation_rad.load(kRelaxed);
    if (strain <= physics::Hooke::kMaxStrain && rotation <= physics::Hooke::kMaxRotation) continue;
    status.add_warnings(fmt::format(
        "body '{}': hooke has left its range of strains up to {} and rotations up to {} rad: strain {:.2g}, rotation "
        "{:.2g} rad; take corotational or another law that stands rotation",
        body_of_group(g), physics::Hooke::kMaxStrain, physics::Hooke::kMaxRotation, strain, rotation));
  }
  status.set_min_det_f(min_det_f);
  if (min_det_f <= 0) {
    status.add_warnings(fmt::format(
        "elements are turned inside out (min det F {:.2g}); what they carry means nothing until they come back, which "
        "only corotational and stable_neo_hookean do by themselves",
        min_det_f));
  }
}

const std::string& Findings::body_of_group(std::size_t group) const {
  const std::uint32_t element = model_.groups[group].elements.front();
  const auto holds = [&](const model::BodyModel& body) { return element - body.element_begin < body.element_count; };
  return std::find_if(model_.bodies.begin(), model_.bodies.end(), holds)->name;
}

}  // namespace tensormass::world
