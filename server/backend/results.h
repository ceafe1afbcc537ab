#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "core/assert.h"
#include "model/loads.h"
#include "view/scene.h"

/// Results and state of a scene, for buffers on any device: reduces the reports of patches to results, and saves,
/// restores, reads and writes a state. Reductions run in the order of the patches, so that they repeat bitwise.
namespace tensormass::backend {

/// Returns StepResult::min_det_f.
/// of_solve: smallest det F that the solve has found (read_step).
/// min_det_f: [group_count, ..] the same from the stages; infinity for groups that the solve checks.
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

/// diagnostics: [group_count, patch_count]
template <class Real>
void read_diagnostics(std::span<const view::PatchDiagnostics<Real>> diagnostics, std::span<GroupDiagnostics> groups) {
  const std::size_t patches = groups.empty() ? 0 : diagnostics.size() / groups.size();
  for (std::size_t group = 0; group < groups.size(); ++group) {
    constexpr double kNone = std::numeric_limits<double>::infinity();
    GroupDiagnostics all{.min_det_f = kNone, .least_stretch = kNone};
    for (const auto& patch : diagnostics.subspan(group * patches, patches)) {
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
void read_forces(std::span<const view::ToolLoad<Real>> loads, std::span<ToolForce> forces) {
  const std::size_t patches = forces.empty() ? 0 : loads.size() / forces.size();
  for (std::size_t tool = 0; tool < forces.size(); ++tool) {
    ToolForce sum;
    double pressed_n = 0, moduli[2] = {0, 0};
    for (std::size_t patch = 0; patch < patches; ++patch) {
      const auto& load = loads[tool * patches + patch];
      for (int c = 0; c < 3; ++c) {
        sum.force_n[c] += static_cast<double>(load.force_n[c]);
        sum.torque_n_m[c] += static_cast<double>(load.torque_n_m[c]);
        sum.friction_n[c] += static_cast<double>(load.friction_n[c]);
      }
      for (std::size_t j = 0; j < sum.joints.size(); ++j) sum.joints[j] += static_cast<double>(load.joints[j]);
      pressed_n += static_cast<double>(load.pressed_n);
      for (std::size_t i = 0; i < 2; ++i) moduli[i] += static_cast<double>(load.pressed_moduli[i]);
    }
    if (pressed_n > 0) {
      sum.young_modulus_pa = moduli[0] / pressed_n;
      sum.plane_strain_modulus_pa = moduli[1] / pressed_n;
    }
    forces[tool] = sum;
  }
}

/// Implements SceneState::read_broken. from: TiesView::broken, on the host
template <class Real>
void copy_broken(std::span<const Real> from, std::span<std::uint8_t> to) {
  TM_ASSERT(from.size() == to.size(), "a flag for each spring");
  for (std::size_t i = 0; i < from.size(); ++i) to[i] = from[i] != 0 ? 1 : 0;
}

/// samples: ContactView::samples
/// tools: [tool_count]
template <class Real>
void write_tools(const model::Model& m, const StepInput& input, const float* samples,
                 physics::PlacedTool<Real>* tools) {
  for (std::size_t i = 0; i < input.tools.size(); ++i) {
    const ToolInput& one = input.tools[i];
    tools[i] = m.tools[i].placed<Real>(one.shape, one.start, one.presence);
    tools[i].samples = samples + m.tools[i].first_sample;
  }
}

/// prescribed: [Model::prescribed, 4]
template <class Real>
void write_prescribed(const model::Model& m, const StepInput& input, Real* prescribed) {
  for (std::size_t i = 0; i < m.prescribed.size(); ++i) {
    const model::Prescribed& one = m.prescribed[i];
    const Vec3<double> now = one.at(input.end_time_s) * (one.schedule.empty() ? input.load_factor : 1);
    for (std::size_t c = 0; c < 3; ++c) prescribed[4 * i + c] = static_cast<Real>(now[static_cast<Eigen::Index>(c)]);
  }
}

/// Says whether gravity, loads or pressure of a scene ever change: they have schedules, or grow in the first step.
inline bool loads_change(const model::Model& m) { return m.quasi_static() || !m.scheduled.schedules.empty(); }

/// Follows the factors of gravity, loads and pressure from step to step.
class LoadFactors {
 public:
  /// No step has taken the factors of schedules yet, so the first step writes them.
  explicit LoadFactors(const model::Model& m)
      : factors_(m.scheduled.schedules.size(), std::numeric_limits<double>::quiet_NaN()) {}

  /// Takes the factors of a step. If one has changed, writes gravity, loads and pressure, and returns true.
  ///
  ///   external, faces   host memory of [row_count, 4] and [PressureSurface::faces]
  template <class Real>
  bool write(const model::Model& m, const StepInput& input, Real* external, view::PressureFace<Real>* faces) {
    bool changed = input.load_factor != load_factor_;
    load_factor_ = input.load_factor;
    for (std::size_t i = 0; i < factors_.size(); ++i) {
      const double now = m.scheduled.schedules[i].at(input.loads_time_s);
      changed = changed || now != factors_[i];
      factors_[i] = now;
    }
    if (!changed) return false;
    TM_ASSERT(loads_change(m), "only loads of such a scene change, and only it has memory to write them");
    model::write_external(m, load_factor_, factors_, external);
    model::write_pressure(m, load_factor_, factors_, faces);
    return true;
  }

 private:
  double load_factor_ = 1;
  std::vector<double> factors_;  // [schedule] of the last step
};

/// Number of reals in ContactView::slips and in TiesView::slips; 0 if contacts remember nothing.
template <class Real>
std::size_t slip_reals(const view::ContactView<Real>& contact) {
  return contact.slips == nullptr ? 0 : 4 * std::size_t{contact.contact_points} * contact.triangle_count;
}
template <class Real>
std::size_t slip_reals(const view::TiesView<Real>& ties) {
  return ties.slips == nullptr ? 0 : 4 * std::size_t{ties.candidate_count};
}

/// State of the step sequence, besides the fields of the rows.
struct StepRecord {
  double dt_s = 0;                   ///< length of the last step; 0: there was none
  double internal_dt_s = 0;          ///< RowState::internal_dt_s
  double largest_force_squared = 0;  ///< see solver::newton_step
  std::uint32_t solution = 0;        ///< index of the last step's solution in SolveView::kept
};

/// Returns the inputs of a step for the device, without next_solution. BDF2 starts anew where the last two steps differ
/// in length.
template <class Real>
view::StepControl<Real> control_of(const model::Model& m, const StepInput& input, const StepRecord& past) {
  const bool starts = input.first_order || past.dt_s != input.dt_s;
  const solver::Integrator integrator = input.by_euler ? solver::Integrator::kImplicitEuler : m.integrator;
  const view::StepScheme<double> scheme = solver::step_scheme(integrator, input.dt_s, starts);
  view::StepControl<Real> out;
  out.scheme.step_s = static_cast<Real>(scheme.step_s);
  out.scheme.reach = static_cast<Real>(scheme.reach);
  for (int i = 0; i < 2; ++i) {
    out.scheme.displacement_weights[i] = static_cast<Real>(scheme.displacement_weights[i]);
    out.scheme.velocity_weights[i] = static_cast<Real>(scheme.velocity_weights[i]);
  }
  out.dt_s = static_cast<Real>(input.dt_s);
  out.internal_dt_s = static_cast<Real>(past.internal_dt_s);
  out.cg_max_iterations = input.cg_max_iterations;
  out.saves_checkpoint = input.saves_checkpoint ? 1 : 0;
  out.projects_stiffness = input.projects_stiffness ? 1 : 0;
  out.starts_from_last = !starts && !m.iterates() ? 1 : 0;
  out.last_solution = past.solution;
  return out;
}

/// Records the sequence of steps, and restores a state from its checkpoint. The same code serves every device.
template <class Real>
class Checkpoint {
 public:
  /// Call before a step. Returns the inputs of the step for the device.
  view::StepControl<Real> begin(const model::Model& m, const StepInput& input) {
    if (input.saves_checkpoint) {
      checkpoint_ = past_;
      restored_ = false;
    }
    view::StepControl<Real> control = control_of<Real>(m, input, past_);
    // A retry keeps the solution that belongs to the checkpoint, because the next retry starts from it.
    control.next_solution = 1 - checkpoint_.solution;
    return control;
  }
  /// Call after a step.
  void end(const StepInput& input) {
    past_.dt_s = past_.internal_dt_s = input.dt_s;
    past_.solution = 1 - checkpoint_.solution;
  }
  /// Call after fields were written from outside.
  void start_anew(double internal_dt_s) { past_ = {.internal_dt_s = internal_dt_s}; }
  /// Call after a history was written from outside; see write_history.
  void go_on(const StepHistory& history) {
    past_.dt_s = history.last_dt_s;
    past_.largest_force_squared = history.largest_force_squared;
    past_.solution = 0;
  }
  /// Implements SceneState::restore.
  ///
  ///   copy(from, count, to)   copies reals within the device; may return before the copy has ended
  template <class Copy>
  void restore(const model::Model& m, const view::SceneView<Real>& view,
               std::span<const view::ElementView<Real>> groups, const Copy& copy) {
    const std::size_t reals = 4 * std::size_t{view.patches.row_count};
    copy(view.guard.checkpoint_displacement, reals, view.state.displacement);
    copy(view.guard.checkpoint_velocity, reals, view.state.velocity);
    if (view.state.previous_displacement != nullptr) {
      copy(view.guard.checkpoint_previous_displacement, reals, view.state.previous_displacement);
      copy(view.guard.checkpoint_previous_velocity, reals, view.state.previous_velocity);
    }
    copy(view.contact.checkpoint_slips, slip_reals(view.contact), view.contact.slips);
    copy(view.ties.checkpoint_slips, slip_reals(view.ties), view.ties.slips);
    copy(view.ties.checkpoint_broken, view.ties.spring_count, view.ties.broken);
    // The step that is taken back has advanced the internal variables to the checkpoint's stress, and a retry needs
    // them there. So the first restore saves them. A later restore, after a retry of several steps, copies them back.
    for (std::size_t g = 0; g < groups.size(); ++g) {
      const std::size_t count = m.groups[g].internal_variable_reals();
      if (restored_) {
        copy(groups[g].checkpoint_internal_variables, count, groups[g].internal_variables);
      } else {
        copy(groups[g].internal_variables, count, groups[g].checkpoint_internal_variables);
      }
    }
    restored_ = true;
    past_ = checkpoint_;
    past_.internal_dt_s = 0;
  }

  /// Implements SceneState::come_to_rest.
  ///
  ///   copy(from, count, to)   as in `restore`
  ///   clear(count, to)        sets reals within the device to zero; may return before that
  template <class Copy, class Clear>
  void come_to_rest(const view::SceneView<Real>& view, const Copy& copy, const Clear& clear) {
    const std::size_t reals = 4 * std::size_t{view.patches.row_count};
    clear(reals, view.state.velocity);
    if (view.state.previous_displacement != nullptr) {
      copy(view.state.displacement, reals, view.state.previous_displacement);
      clear(reals, view.state.previous_velocity);
    }
    past_.dt_s = 0;
  }

  const StepRecord& past() const { return past_; }
  double internal_dt_s() const { return past_.internal_dt_s; }
  double& largest_force_squared() { return past_.largest_force_squared; }

 private:
  StepRecord past_, checkpoint_;
  bool restored_ = false;  // restored since the checkpoint was saved
};

/// Reads the state of all rows.
///
///   download(from, count) -> std::vector<double>   copies reals to the host
template <class Real, class Download>
RowState read_state(const model::Model& m, const view::SceneView<Real>& view,
                    std::span<const view::ElementView<Real>> groups, double internal_dt_s, const Download& download) {
  const std::size_t reals = 4 * std::size_t{view.patches.row_count};
  RowState state{download(view.state.displacement, reals), download(view.state.velocity, reals), {}, internal_dt_s};
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::vector<double> history = download(groups[g].internal_variables, m.groups[g].internal_variable_reals());
    state.internal_variables.insert(state.internal_variables.end(), history.begin(), history.end());
  }
  return state;
}

/// Writes the state of all rows.
///
///   upload(to, std::span<const double> from)   copies reals to the device
template <class Real, class Upload>
void write_state(const model::Model& m, const view::SceneView<Real>& view,
                 std::span<const view::ElementView<Real>> groups, const RowState& state, const Upload& upload) {
  upload(view.state.displacement, state.displacement);
  upload(view.state.velocity, state.velocity);
  if (view.state.previous_displacement != nullptr) {
    upload(view.state.previous_displacement, state.displacement);
    upload(view.state.previous_velocity, state.velocity);
  }
  // Friction starts anew and attachments are whole: a state from outside says nothing about them.
  upload(view.contact.slips, std::vector<double>(slip_reals(view.contact), 0.0));
  upload(view.ties.slips, std::vector<double>(slip_reals(view.ties), 0.0));
  upload(view.ties.broken, std::vector<double>(view.ties.spring_count, 0.0));
  std::span<const double> histories = state.internal_variables;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::size_t count = m.groups[g].internal_variable_reals();
    upload(groups[g].internal_variables, histories.first(count));
    histories = histories.subspan(count);
  }
}

/// Reads the history of the steps. download: as in read_state.
template <class Real, class Download>
StepHistory read_history(const view::SceneView<Real>& view, const StepRecord& past, const Download& download) {
  const std::size_t reals = 4 * std::size_t{view.patches.row_count};
  StepHistory history;
  history.last_dt_s = past.dt_s;
  history.largest_force_squared = past.largest_force_squared;
  if (view.state.previous_displacement != nullptr) {
    history.previous_displacement = download(view.state.previous_displacement, reals);
    history.previous_velocity = download(view.state.previous_velocity, reals);
  }
  history.slips = download(view.contact.slips, slip_reals(view.contact));
  history.tie_slips = download(view.ties.slips, slip_reals(view.ties));
  history.broken = download(view.ties.broken, view.ties.spring_count);
  if (view.solve.kept != nullptr) history.solution = download(view.solve.kept + past.solution * reals, reals);
  return history;
}

/// Writes the history of the steps; the last solution goes to the first place of SolveView::kept. upload: as in
/// write_state.
template <class Real, class Upload>
void write_history(const view::SceneView<Real>& view, const StepHistory& history, const Upload& upload) {
  if (view.state.previous_displacement != nullptr) {
    upload(view.state.previous_displacement, history.previous_displacement);
    upload(view.state.previous_velocity, history.previous_velocity);
  }
  TM_ASSERT(history.slips.size() == slip_reals(view.contact) && history.tie_slips.size() == slip_reals(view.ties) &&
                history.broken.size() == view.ties.spring_count,
            "a history is of the same model");
  upload(view.contact.slips, history.slips);
  upload(view.ties.slips, history.tie_slips);
  upload(view.ties.broken, history.broken);
  if (view.solve.kept != nullptr) upload(view.solve.kept, history.solution);
}

}  // namespace tensormass::backend
