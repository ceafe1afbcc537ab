#pragma once

#include <cstdint>
#include <span>

#include "backend/coarse_switch.h"
#include "backend/saved_state.h"
#include "backend/step_inputs.h"
#include "view/scene.h"

/// The checkpoint of a scene: the state before a step that can be taken back.
namespace tensormass::backend {

/// Says which elements a step evaluates, if tangents lag (matrix/lagged_tangents.h).
class TangentLag {
 public:
  /// Kept tensors no longer fit, because values, cuts or the state are others. So the next step evaluates all elements.
  void forget() { steps_ = 0; }
  template <class Real>
  void begin(const model::Model& m, const StepInput& input, view::StepControl<Real>& control) {
    const bool fits = steps_ > 0 && steps_ < kStepsOfSums && projects_ == input.projects_stiffness;
    // After all were evaluated turns begin anew, so that a run goes on alike from a snapshot.
    steps_ = fits && !input.evaluates_all ? steps_ + 1 : 1;
    control.refreshes_all = steps_ == 1 ? 1 : 0;
    control.refresh_turn = steps_ % m.lag_steps;
    projects_ = input.projects_stiffness;
  }

 private:
  /// Steps after which sums over kept tensors start anew, before their rounding errors add up.
  static constexpr std::uint32_t kStepsOfSums = 1024;

  std::uint32_t steps_ = 0;  // since all elements were evaluated, that step included; 0: nothing is kept
  bool projects_ = false;
};

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
    lag_.begin(m, input, control);
    return control;
  }
  /// Call after a step.
  void end(const StepInput& input) {
    past_.dt_s = past_.internal_dt_s = input.dt_s;
    past_.solution = 1 - checkpoint_.solution;
  }
  /// Call after fields were written from outside.
  void start_anew(double internal_dt_s) {
    past_ = {.internal_dt_s = internal_dt_s};
    coarse_ = CoarseSwitch();
    lag_.forget();
  }
  /// Call after a history was written from outside; see write_history.
  void go_on(const StepHistory& history) {
    past_.dt_s = history.last_dt_s;
    past_.largest_force_squared = history.largest_force_squared;
    past_.solution = 0;
    coarse_ = CoarseSwitch(history.coarse_solves);
    lag_.forget();
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
    copy(view.links.checkpoint_slips, slip_reals(view.links), view.links.slips);
    copy(view.links.checkpoint_broken, view.links.spring_count, view.links.broken);
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
    lag_.forget();  // a step is made again because it failed, perhaps by its lag
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
  /// A step that is taken back leaves it as it is: its retry has the same matrix.
  CoarseSwitch& coarse() { return coarse_; }
  const CoarseSwitch& coarse() const { return coarse_; }
  TangentLag& lag() { return lag_; }
  double& largest_force_squared() { return past_.largest_force_squared; }

 private:
  StepRecord past_, checkpoint_;
  CoarseSwitch coarse_;
  TangentLag lag_;
  bool restored_ = false;  // restored since the checkpoint was saved
};

}  // namespace tensormass::backend
