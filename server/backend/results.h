#pragma once

#include <cmath>
#include <limits>

#include "backend/backend.h"
#include "tensor/view.h"

/// From a view's reports in host memory to a StepResult: the last, short reduction over patches, in their order.
namespace tensormass::backend {

template <class Real>
StepResult read_step(const tensor::SolveReport<Real>& solve, std::span<const tensor::PatchReport<Real>> patches) {
  StepResult result;
  result.cg_iterations = solve.iterations;
  result.cg_relative_residual = static_cast<double>(solve.relative_residual);
  result.negative_curvature = solve.negative_curvature != 0;
  result.finite = std::isfinite(solve.relative_residual);
  for (const auto& patch : patches) {
    result.finite = result.finite && patch.finite == 1;
    result.max_speed_m_per_s = std::max(result.max_speed_m_per_s, static_cast<double>(patch.max_speed_m_per_s));
  }
  return result;
}

/// watch: [group_count, patch_count]
template <class Real>
void read_watch(std::span<const tensor::PatchWatch<Real>> watch, std::span<GroupWatch> groups) {
  const std::size_t patches = groups.empty() ? 0 : watch.size() / groups.size();
  for (std::size_t group = 0; group < groups.size(); ++group) {
    GroupWatch all{std::numeric_limits<double>::infinity(), 0, 0};
    for (const auto& patch : watch.subspan(group * patches, patches)) {
      all.min_det_f = std::min(all.min_det_f, static_cast<double>(patch.min_det_f));
      all.max_strain = std::max(all.max_strain, static_cast<double>(patch.max_strain));
      all.max_rotation_rad = std::max(all.max_rotation_rad, static_cast<double>(patch.max_rotation));
    }
    groups[group] = all;
  }
}

/// loads: [tool_count, patch_count]
template <class Real>
void read_forces(std::span<const tensor::ToolLoad<Real>> loads, std::span<ToolForce> forces) {
  const std::size_t patches = forces.empty() ? 0 : loads.size() / forces.size();
  for (std::size_t tool = 0; tool < forces.size(); ++tool) {
    ToolForce sum;
    for (std::size_t patch = 0; patch < patches; ++patch) {
      const auto& load = loads[tool * patches + patch];
      for (int c = 0; c < 3; ++c) {
        sum.force_n[c] += static_cast<double>(load.force_n[c]);
        sum.torque_n_m[c] += static_cast<double>(load.torque_n_m[c]);
      }
    }
    forces[tool] = sum;
  }
}

/// prescribed: [Model::prescribed, 4]
template <class Real>
void write_prescribed(const model::Model& m, double time_s, Real* prescribed) {
  for (std::size_t i = 0; i < m.prescribed.size(); ++i) {
    const Vec3<double> now = m.prescribed[i].at(time_s);
    for (std::size_t c = 0; c < 3; ++c) prescribed[4 * i + c] = static_cast<Real>(now[static_cast<Eigen::Index>(c)]);
  }
}

template <class Real>
tensor::StepScheme<Real> scheme_of(const model::Model& m, bool first_step) {
  const tensor::StepScheme<double> scheme = model::step_scheme(m.integrator, m.dt_s, first_step);
  tensor::StepScheme<Real> out;
  out.step_s = static_cast<Real>(scheme.step_s);
  for (int i = 0; i < 2; ++i) {
    out.displacement_weights[i] = static_cast<Real>(scheme.displacement_weights[i]);
    out.velocity_weights[i] = static_cast<Real>(scheme.velocity_weights[i]);
  }
  return out;
}

template <class Real>
tensor::ToolState<Real> tool_state(const model::ToolModel& tool, const Vec3<double>& center) {
  tensor::ToolState<Real> state;
  for (int c = 0; c < 3; ++c) state.center_m[c] = static_cast<Real>(center[c]);
  state.radius_m = static_cast<Real>(tool.radius_m);
  state.penalty_pa_per_m = static_cast<Real>(tool.penalty_pa_per_m);
  return state;
}

}  // namespace tensormass::backend
