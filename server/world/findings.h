#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <mutex>
#include <string>

#include "tensormass/v1/stream.pb.h"
#include "world/iteration_budget.h"
#include "world/world.h"

namespace tensormass::world {

/// What a scene's status says of its results besides their numbers: how the outer iteration ended, whether elements are
/// pressed flat, whether a law has left its range, where energy went, what guards and budget did. Written by the loop,
/// which allocates nothing for it; read by anyone.
class Findings {
 public:
  Findings(const model::Model& model, const IterationBudget& budget)
      : model_(model), budget_(budget), groups_(model.groups.size()) {}

  /// Of the last World::step, also of one that the guard did not let pass.
  void take_step(const World& world);
  /// Of the last World::watch.
  void take_diagnostics(const World& world);
  /// The scene is at rest again.
  void clear();
  void add_to(v1::SceneStatus& status) const;

 private:
  void add_solve(v1::SceneStatus& status) const;
  void add_elements(v1::SceneStatus& status) const;
  void add_energy(v1::SceneStatus& status) const;
  void add_guard(v1::SceneStatus& status) const;
  void add_budget(v1::SceneStatus& status) const;
  const std::string& body_of_group(std::size_t group) const;

  struct Group {
    std::atomic<double> min_det_f{1}, max_strain{0}, max_rotation_rad{0}, least_stretch{1};
  };
  const model::Model& model_;
  const IterationBudget& budget_;
  std::deque<Group> groups_;  // a deque because an atomic does not move
  std::atomic<std::uint32_t> cg_iterations_{0}, newton_iterations_{0};
  std::atomic<std::uint64_t> unconverged_steps_{0};
  std::atomic<double> cg_residual_{0}, newton_residual_{0};
  std::atomic<double> kinetic_j_{0}, elastic_j_{0}, work_j_{0}, dissipated_j_{0};
  std::atomic<bool> converged_{true}, negative_curvature_{false};
  std::atomic<std::uint64_t> guard_events_{0}, guard_recoveries_{0};
  // Of the last whole window of steps, how many were made again.
  static constexpr std::uint32_t kWindow = 64;
  std::uint32_t window_steps_ = 0, window_again_ = 0;
  std::atomic<std::uint32_t> made_again_{0};
  mutable std::mutex event_mutex_;  // taken by the loop only when there is an event
  GuardEvent last_event_;           // of the events that were counted
};

}  // namespace tensormass::world
