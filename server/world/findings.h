#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <memory>
#include <mutex>
#include <string>
#include <utility>

#include "tensormass/v1/stream.pb.h"
#include "world/iteration_budget.h"
#include "world/present.h"
#include "world/world.h"

namespace tensormass::world {

/// The findings of a scene: what its status says about the quality of the results.
///
///     World::step        --> take_step         --+
///     World::diagnose    --> take_diagnostics  --+--> atomics --> add_to, by any thread: values, findings, warnings
///     IterationBudget    ------------------------+
///
/// Values are residuals, iterations, energies and det F. Findings (core/findings.h) say with a remedy when linear
/// solves end above their tolerance, Newton's method did not converge, elements are inverted, a law left its range, the
/// guard repeats steps or the budget lowers iterations. Those of the load come first.
///
/// The loop allocates nothing for this: the thread that asks puts findings into words.
class Findings {
 public:
  Findings(std::shared_ptr<const model::Model> model, const IterationBudget& budget)
      : groups_(kGroupsOfCuts * model->groups.size()), model_(std::move(model)), budget_(budget) {}

  /// Loop: takes the results of the last World::step, also if the guard refused it. Returns whether a recovery began or
  /// ended with it.
  bool take_step(const World& world);
  /// Loop: takes what an edit between two steps has changed.
  void take_edits(const World& world);
  /// Loop: takes the results of the last World::diagnose.
  void take_diagnostics(const World& world);
  /// Loop: goes on counting with a model of other values.
  void go_on_with(std::shared_ptr<const model::Model> model) noexcept;
  /// Loop: forgets everything, because the scene was reset.
  void clear();
  /// Any thread: adds values, findings and warnings.
  void add_to(v1::SceneStatus& status) const;

 private:
  void add_solve(const model::Model& m, v1::SceneStatus& status) const;
  void add_elements(const model::Model& m, v1::SceneStatus& status) const;
  void add_energy(const model::Model& m, v1::SceneStatus& status) const;
  void add_guard(const model::Model& m, v1::SceneStatus& status) const;
  void add_budget(const model::Model& m, v1::SceneStatus& status) const;

  struct Group {
    std::atomic<double> min_det_f{1}, max_strain{0}, max_rotation_rad{0}, least_stretch{1};
  };
  // Cuts divide a group into whole elements, members of clusters, and splinters of both.
  static constexpr std::size_t kGroupsOfCuts = 4;
  std::deque<Group> groups_;  // a deque because an atomic does not move
  Present<model::Model> model_;
  const IterationBudget& budget_;
  std::atomic<std::uint32_t> cg_iterations_{0}, newton_iterations_{0}, touching_nodes_{0}, broken_springs_{0};
  std::atomic<std::uint64_t> unconverged_steps_{0};
  std::atomic<double> cg_residual_{0}, missing_energy_j_{0}, newton_residual_{0}, deepest_contact_m_{0},
      momentum_error_{0};
  std::atomic<double> kinetic_j_{0}, elastic_j_{0}, work_j_{0}, dissipated_j_{0};
  std::atomic<bool> converged_{true}, negative_curvature_{false};
  /// Bits of the last solves, the newest lowest: whether it ended above cg_tolerance. solves_: up to kWindow.
  std::atomic<std::uint64_t> solves_above_{0};
  std::atomic<std::uint32_t> solves_{0};
  std::atomic<std::uint64_t> guard_events_{0}, guard_recoveries_{0};
  std::atomic<std::uint64_t> recoveries_{0}, recovering_steps_{0}, held_steps_{0};
  std::atomic<bool> recovering_{false};
  static constexpr std::uint32_t kWindow = 64;  // steps
  // Number of steps in the last full window that the guard repeated.
  std::uint32_t window_steps_ = 0, window_repeated_ = 0;
  std::atomic<std::uint32_t> repeated_{0};
  bool was_recovering_ = false;     // the loop's
  mutable std::mutex event_mutex_;  // taken by the loop only when there is an event
  GuardEvent last_event_;           // the newest that was counted
};

}  // namespace tensormass::world
