#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <memory>
#include <mutex>
#include <string>

#include "core/result.h"
#include "tensormass/v1/stream.pb.h"
#include "world/findings.h"
#include "world/generation.h"
#include "world/loop_outputs.h"
#include "world/pose_inbox.h"
#include "world/present.h"
#include "world/runner_options.h"
#include "world/scene_counts.h"
#include "world/step_clock.h"

/// A scene's state (running, paused, ...), its step times and its counts: what SceneStatus reports.
///
///     loop's thread: set_state, take_..., clear  -->  atomics, and a mutex for each text  -->  any thread: make
///     publisher's thread: take, at the scene's status rate and after each change of state
///
/// The loop takes a mutex only when a scene stops or a step leaves its bounds. No lock holds the values of one
/// status together, so they may come from two consecutive steps.
namespace tensormass::world {

class LoopStatus {
 public:
  using State = v1::SceneStatus::State;

  /// All references outlive the status.
  LoopStatus(const std::shared_ptr<const model::Model>& model, SceneDevice device, const IterationBudget& budget,
             const Present<Generation>& generation, const PoseCounts& poses, const LoopOutputs& outputs,
             std::shared_ptr<SceneCounts> counts);

  // -- the loop's thread ----------------------------------------------------------------------------------------------

  /// Restarts the measured rate, and makes a status due.
  void set_state(State next);
  /// Stops the scene: its state becomes STATE_FAULTED. `reason` is the text that callers get from then on.
  void set_fault(std::string reason);
  /// Clears a fault and all findings of a scene that was reset. The state stays: set_state changes it.
  void clear();
  /// Goes on counting with a model of other values. A fault has ended, because its values are gone.
  void go_on_with(const std::shared_ptr<const model::Model>& model) noexcept;
  /// Takes what World::step found, also if the guard stopped the scene.
  /// A status is due if a recovery began or ended.
  void take_step(const World& world) {
    const bool turns = findings_.take_step(world);
    if (turns) due_.store(true, std::memory_order_relaxed);
    counts_->take_step(world.last(), world.guard_event(), turns && world.recovering());
  }
  void take_device_fault() { counts_->take_device_fault(); }
  void take_pose_age(Clock::duration age) {
    counts_->pose_ages.add(std::chrono::duration_cast<std::chrono::nanoseconds>(age).count());
  }
  /// Takes what World::diagnose found.
  void take_diagnostics(const World& world) { findings_.take_diagnostics(world); }
  /// Step and simulated time of a step that was published, or of a state that a reset or a snapshot brought.
  void take_stamp(const StepStamp& stamp);
  /// Takes what edits have removed and severed.
  void take_edits(const World& world);
  /// Takes the area of the cuts of a scene that goes on with them.
  void take_cut_area(double area_m2) { cut_area_m2_.store(area_m2, std::memory_order_relaxed); }
  /// The process can use its device no more (device_loss.h).
  void take_device_loss() { device_lost_.store(true, std::memory_order_relaxed); }
  /// period: of the poses of the hand that leads. lead: of the steps; see hand_phase.h. Both are zero without a hand.
  void take_phase(Clock::duration period, Clock::duration lead) {
    hand_period_s_.store(std::chrono::duration<double>(period).count(), std::memory_order_relaxed);
    step_lead_s_.store(std::chrono::duration<double>(lead).count(), std::memory_order_relaxed);
  }
  /// in_time: the step met its deadline.
  void take_time(Clock::time_point begin, Clock::time_point end, bool in_time) {
    statistics_->add(end - begin, end, in_time);
  }

  // -- any thread -----------------------------------------------------------------------------------------------------

  State state() const { return state_.load(); }
  const std::shared_ptr<StepStatistics>& statistics() const { return statistics_; }
  /// A number that differs after each change of the scene's state.
  std::uint64_t changes() const { return changes_.load(std::memory_order_relaxed); }
  bool device_lost() const { return device_lost_.load(std::memory_order_relaxed); }
  const std::shared_ptr<SceneCounts>& counts() const { return counts_; }
  /// An error that says why the scene stopped, if it did.
  Result<void> require_not_faulted() const;
  v1::SceneStatus make() const;

  // -- the publisher's thread -----------------------------------------------------------------------------------------

  /// Fills `status` if one is due, else returns false.
  bool take(v1::SceneStatus& status);

 private:
  const model::Settings settings_;
  const SceneDevice device_;
  const Present<Generation>& generation_;  // has the inboxes
  const PoseCounts& poses_;
  const LoopOutputs& outputs_;

  std::atomic<State> state_;
  std::atomic<bool> due_{true}, device_lost_{false};
  std::atomic<std::uint64_t> step_count_{0}, changes_{0};
  std::atomic<double> simulated_time_s_{0}, removed_mass_kg_{0}, removed_volume_m3_{0};
  std::atomic<double> cut_area_m2_{0}, fracture_energy_j_{0};
  std::atomic<double> hand_period_s_{0}, step_lead_s_{0};
  const std::shared_ptr<StepStatistics> statistics_;
  const std::shared_ptr<SceneCounts> counts_;
  Findings findings_;
  mutable std::mutex fault_mutex_;
  std::string fault_;  // guarded by fault_mutex_

  Clock::time_point next_{};  // the publisher's: when the next status is due by rate
};

}  // namespace tensormass::world
