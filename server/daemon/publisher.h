#pragma once

#include <atomic>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "bus/bus.h"
#include "control/scene_registry.h"

namespace tensormass::daemon {

/// Wakes a thread from another one that must not wait. Many signals before a wait are one.
class WakeUp {
 public:
  WakeUp();
  ~WakeUp();
  WakeUp(const WakeUp&) = delete;
  WakeUp& operator=(const WakeUp&) = delete;

  void signal();
  /// Returns after a signal, or after the time.
  void wait(int timeout_ms);

 private:
  int event_ = -1;
  std::atomic<bool> signalled_{false};
};

/// Carries what scenes leave in their mailboxes to the bus, on a thread of its own, so that no step waits for a
/// transport. Forces go first. When a scene ends, so do the forces that its tools were last told.
class Publisher {
 public:
  /// All outlive the publisher; `wake_up` is what scenes signal.
  Publisher(const control::SceneRegistry& registry, bus::Bus& bus, std::string server, WakeUp& wake_up);
  /// Publishes the end of the scenes that were taken out of the registry, then stops.
  ~Publisher();

 private:
  struct Scene {
    explicit Scene(const control::RunnerPtr& started) : runner(started), id(started.get()) {}

    /// The scene's owners decide when it ends; that takes up to a step, and is not for this thread to wait for.
    std::weak_ptr<world::Runner> runner;
    const world::Runner* id;
    std::vector<v1::ToolFeedback> feedback;
    std::vector<std::string> feedback_keys;
    std::string frame_key, status_key, topology_key;
  };

  void run();
  void follow_registry();
  void begin(const control::RunnerPtr& runner);
  void end(Scene& scene);
  void publish_feedback(Scene& scene);

  const control::SceneRegistry& registry_;
  bus::Bus& bus_;
  const std::string server_;
  WakeUp& wake_up_;
  std::uint64_t generation_ = 0;
  std::map<std::string, Scene> scenes_;
  v1::Frame frame_;
  v1::SceneStatus status_;
  std::atomic<bool> stop_{false};
  std::thread thread_;
};

}  // namespace tensormass::daemon
