#pragma once

#include <chrono>
#include <condition_variable>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "control/scene_registry.h"
#include "core/log.h"
#include "core/state_limits.h"
#include "daemon/state_store.h"

namespace tensormass::daemon {

/// Keeps the scenes of a registry in a store, so that another process can bring them back.
///
///     load    ── follow ──> scene file, before the call answers
///     loop    <── Runner::keep, between two steps ── thread of the scene ──> snapshot file
///     unload  ── forget ──> files removed, before the call answers
///
/// Each scene has a thread of its own: a scene with long steps, or one that hangs, delays the snapshots of no other. A
/// snapshot costs a loop one copy of its state. Checksum, file and disk are the thread's. A scene whose state has not
/// changed is not written again.
///
/// What cannot be written is logged and tried again. The scene goes on, and its last good snapshot stays.
class StateKeeper final : public control::SceneFollower {
 public:
  explicit StateKeeper(std::unique_ptr<StateStore> store, std::chrono::milliseconds period = limits::kStatePeriod);
  /// Writes what `take_last` took, then ends the threads.
  ~StateKeeper() override;

  /// Loads every scene of the store and restores the newest snapshot that is good and of this version. What cannot be
  /// used is logged with its reason and moved to `aside`. Returns when all scenes step.
  /// stop_asked: ends it early if it returns true; the scenes that are left keep their files
  void bring_back(control::SceneRegistry& registry, const std::function<bool()>& stop_asked);
  /// Takes a last state of every scene, for as long as `at_most`.
  void take_last(std::chrono::milliseconds at_most);

  void follow(const control::RunnerPtr& runner) override;
  void forget(const std::string& name) override;

 private:
  struct Scene {
    std::weak_ptr<world::Runner> runner;
    std::string name;
    StateStore::Ticket ticket = 0;  // 0: the scene could not be written yet
    std::optional<world::StateMark> written;
    // Guarded by mutex_, as is next. done: the thread needs the mutex no more.
    bool last = false, taken = false, ended = false, done = false;
    std::chrono::milliseconds next{};  // time until the next snapshot
    std::thread thread;
  };

  StateStore::Ticket add(const world::Runner& runner);
  void restore(const control::RunnerPtr& runner);
  void start(const control::RunnerPtr& runner, StateStore::Ticket ticket);
  void run(Scene& scene);
  /// Takes and writes a snapshot, if the state is another than the last one.
  void keep(Scene& scene);
  void took(Scene& scene, std::chrono::milliseconds next);
  void log_failure(const std::string& scene, const Error& error);
  void join_ended();

  const std::unique_ptr<StateStore> store_;
  const std::chrono::milliseconds period_;
  log::Limiter failure_lines_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::map<std::string, std::unique_ptr<Scene>> scenes_;  // guarded by mutex_, as is ended_
  std::vector<std::unique_ptr<Scene>> ended_;             // forgotten; their threads may be writing
};

}  // namespace tensormass::daemon
