#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <string>

#include "tensormass/v1/stream.pb.h"
#include "world/world.h"

namespace tensormass::world {

/// What a scene's status says of its results besides their numbers: how the outer iteration ended, whether elements are
/// pressed flat, whether a law has left its range. Written by the loop, which allocates nothing for it; read by anyone.
class Findings {
 public:
  explicit Findings(const model::Model& model) : model_(model), groups_(model.groups.size()) {}

  void take_step(const backend::StepResult& result);
  /// Of the last World::watch.
  void take_watch(const World& world);
  /// The scene is at rest again.
  void clear();
  void add_to(v1::SceneStatus& status) const;

 private:
  const std::string& body_of_group(std::size_t group) const;

  struct Group {
    std::atomic<double> min_det_f{1}, max_strain{0}, max_rotation_rad{0};
  };
  const model::Model& model_;
  std::deque<Group> groups_;  // a deque because an atomic does not move
  std::atomic<std::uint32_t> newton_iterations_{0};
  std::atomic<std::uint64_t> unconverged_steps_{0};
  std::atomic<double> newton_residual_{0};
  std::atomic<bool> converged_{true}, negative_curvature_{false};
};

}  // namespace tensormass::world
