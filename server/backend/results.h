#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "tensor/view.h"

/// Between a view and the host: from reports to a StepResult, the last, short reduction over patches, in their order;
/// and what a state remembers, gives and takes, whatever device its buffers are on.
namespace tensormass::backend {

template <class Real>
StepResult read_step(const tensor::SolveReport<Real>& solve, std::span<const tensor::PatchReport<Real>> patches) {
  StepResult result;
  result.cg_iterations = solve.iterations;
  result.cg_relative_residual = static_cast<double>(solve.relative_residual);
  result.negative_curvature = solve.negative_curvature != 0;
  result.finite = std::isfinite(solve.relative_residual);
  result.min_det_f = std::numeric_limits<double>::infinity();
  for (const auto& patch : patches) {
    result.finite = result.finite && patch.finite == 1;
    result.max_speed_m_per_s = std::max(result.max_speed_m_per_s, static_cast<double>(patch.max_speed_m_per_s));
    result.max_move_m = std::max(result.max_move_m, static_cast<double>(patch.max_move_m));
    result.max_distance_m = std::max(result.max_distance_m, static_cast<double>(patch.max_distance_m));
    result.kinetic_energy_j += static_cast<double>(patch.kinetic_energy_j);
    result.work_j += static_cast<double>(patch.work_j);
    result.min_det_f = std::min(result.min_det_f, static_cast<double>(patch.min_det_f));
  }
  return result;
}

/// StepResult::min_det_f. of_solve: what the solve has found (read_step); min_det_f: [group_count, ..] what stages
/// have, infinity for groups that the solve checks.
template <class Real>
double read_volume(const model::Model& m, double of_solve, std::span<const Real> min_det_f) {
  if (!m.checks_volume()) return 1;
  double least = of_solve;
  const std::size_t of_group = min_det_f.size() / m.groups.size();
  for (std::size_t group = 0; group < m.groups.size(); ++group) {
    if (!m.groups[group].checks_volume) continue;
    for (const Real one : min_det_f.subspan(group * of_group, of_group))
      least = std::min(least, static_cast<double>(one));
  }
  return least;
}

/// watch: [group_count, patch_count]
template <class Real>
void read_watch(std::span<const tensor::PatchWatch<Real>> watch, std::span<GroupWatch> groups) {
  const std::size_t patches = groups.empty() ? 0 : watch.size() / groups.size();
  for (std::size_t group = 0; group < groups.size(); ++group) {
    constexpr double kNone = std::numeric_limits<double>::infinity();
    GroupWatch all{.min_det_f = kNone, .least_stretch = kNone};
    for (const auto& patch : watch.subspan(group * patches, patches)) {
      all.min_det_f = std::min(all.min_det_f, static_cast<double>(patch.min_det_f));
      all.max_strain = std::max(all.max_strain, static_cast<double>(patch.max_strain));
      all.max_rotation_rad = std::max(all.max_rotation_rad, static_cast<double>(patch.max_rotation));
      all.least_stretch = std::min(all.least_stretch, static_cast<double>(patch.least_stretch));
      all.elastic_energy_j += static_cast<double>(patch.elastic_energy_j);
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

/// What a state remembers between steps besides its fields.
struct Past {
  double dt_s = 0;                   ///< of the last step; 0: there was none
  double history_dt_s = 0;           ///< RowState::history_dt_s
  double largest_force_squared = 0;  ///< see newton_step
};

/// A scheme of two steps starts anew where they are not equally long.
template <class Real>
tensor::StepControl<Real> control_of(const model::Model& m, const StepInput& input, const Past& past) {
  const bool starts = input.careful || past.dt_s != input.dt_s;
  const tensor::StepScheme<double> scheme = model::step_scheme(m.integrator, input.dt_s, starts);
  tensor::StepControl<Real> out;
  out.scheme.step_s = static_cast<Real>(scheme.step_s);
  for (int i = 0; i < 2; ++i) {
    out.scheme.displacement_weights[i] = static_cast<Real>(scheme.displacement_weights[i]);
    out.scheme.velocity_weights[i] = static_cast<Real>(scheme.velocity_weights[i]);
  }
  out.dt_s = static_cast<Real>(input.dt_s);
  out.history_dt_s = static_cast<Real>(past.history_dt_s);
  out.cg_max_iterations = input.cg_max_iterations;
  out.keeps = input.keeps ? 1 : 0;
  return out;
}

/// What a state remembers, and how it goes back to the begin of a step; the same on every device.
template <class Real>
class Memory {
 public:
  /// What the coming step is told.
  tensor::StepControl<Real> begin(const model::Model& m, const StepInput& input) {
    if (input.keeps) {
      kept_ = past_;
      retries_ = false;
    }
    return control_of<Real>(m, input, past_);
  }
  void end(const StepInput& input) { past_.dt_s = past_.history_dt_s = input.dt_s; }
  /// Fields were written from outside.
  void start_anew(double history_dt_s) { past_ = {.history_dt_s = history_dt_s}; }
  /// SceneState::restore. copy(from, count, to) may return before it is done.
  template <class Copy>
  void restore(const model::Model& m, const tensor::SceneView<Real>& view,
               std::span<const tensor::ElementView<Real>> groups, const Copy& copy) {
    const std::size_t reals = 4 * std::size_t{view.row_count};
    copy(view.kept_displacement, reals, view.displacement);
    copy(view.kept_velocity, reals, view.velocity);
    if (view.previous_displacement != nullptr) {
      copy(view.kept_previous_displacement, reals, view.previous_displacement);
      copy(view.kept_previous_velocity, reals, view.previous_velocity);
    }
    // The step that is taken back has moved the histories on from the kept state, which is what a retry needs too; only
    // a retry of several steps moves them further.
    for (std::size_t g = 0; g < groups.size(); ++g) {
      const std::size_t count = m.groups[g].history_reals();
      if (retries_) {
        copy(groups[g].kept_history, count, groups[g].history);
      } else {
        copy(groups[g].history, count, groups[g].kept_history);
      }
    }
    retries_ = true;
    past_ = kept_;
    past_.history_dt_s = 0;
  }

  double history_dt_s() const { return past_.history_dt_s; }
  double& largest_force_squared() { return past_.largest_force_squared; }

 private:
  Past past_, kept_;
  bool retries_ = false;  // the last kept state has been gone back to
};

/// download(from, count): the numbers, as doubles.
template <class Real, class Download>
RowState read_state(const model::Model& m, const tensor::SceneView<Real>& view,
                    std::span<const tensor::ElementView<Real>> groups, double history_dt_s, const Download& download) {
  const std::size_t reals = 4 * std::size_t{view.row_count};
  RowState state{download(view.displacement, reals), download(view.velocity, reals), {}, history_dt_s};
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::vector<double> history = download(groups[g].history, m.groups[g].history_reals());
    state.histories.insert(state.histories.end(), history.begin(), history.end());
  }
  return state;
}

/// upload(to, from)
template <class Real, class Upload>
void write_state(const model::Model& m, const tensor::SceneView<Real>& view,
                 std::span<const tensor::ElementView<Real>> groups, const RowState& state, const Upload& upload) {
  upload(view.displacement, state.displacement);
  upload(view.velocity, state.velocity);
  if (view.previous_displacement != nullptr) {
    upload(view.previous_displacement, state.displacement);
    upload(view.previous_velocity, state.velocity);
  }
  std::span<const double> histories = state.histories;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::size_t count = m.groups[g].history_reals();
    upload(groups[g].history, histories.first(count));
    histories = histories.subspan(count);
  }
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
