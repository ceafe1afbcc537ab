#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <shared_mutex>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "tensormass/v1/scene.pb.h"
#include "world/runner.h"

namespace tensormass::control {

using RunnerPtr = std::shared_ptr<world::Runner>;

/// The scenes of a daemon by name. Loading and unloading one never holds up another, nor a pose: compiling happens
/// outside the lock, with the name reserved. All methods may be called from any thread.
class SceneRegistry {
 public:
  /// `output_signal` is called after every load and unload, and by scenes' loops: it must not block.
  SceneRegistry(const world::RunnerOptions& options, std::function<void()> output_signal);

  /// Compiles and starts the scene.
  Result<RunnerPtr> load(const v1::Scene& scene, const model::Progress& progress = {});
  /// Checks and compiles without running.
  Result<v1::SceneReport> inspect(const v1::Scene& scene, const model::Progress& progress = {}) const {
    return world::Runner::inspect(scene, options_, progress);
  }
  Result<void> unload(std::string_view name);
  Result<RunnerPtr> find(std::string_view name) const;
  /// All that run, by name.
  std::vector<RunnerPtr> list() const;
  /// Changes with every load and unload.
  std::uint64_t generation() const { return generation_.load(std::memory_order_acquire); }
  /// Takes every scene out and refuses what comes later. The scenes end when the result goes.
  std::vector<RunnerPtr> close();

 private:
  class Reservation;
  void changed();

  const world::RunnerOptions options_;
  const std::function<void()> output_signal_;
  std::atomic<std::uint64_t> generation_{0};
  mutable std::shared_mutex mutex_;
  // Guarded by mutex_. Null: the name of a scene that is being compiled.
  std::map<std::string, RunnerPtr, std::less<>> scenes_;
  bool closed_ = false;
};

}  // namespace tensormass::control
