#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "bus/bus.h"
#include "control/scene_registry.h"
#include "core/log.h"

namespace tensormass::daemon {

/// Wakes one waiting thread from threads that must not wait (the scenes' loops). Signals before a wait count as one.
///
///     signal():  flag false -> true: write the eventfd       flag already true: nothing to do, no system call
///     wait():    poll the eventfd, read it empty, then set the flag to false
///
/// The order in `wait` matters. A signal between the read and the reset finds the flag true and writes nothing. That
/// loses nothing, because the thread reads the mailboxes after `wait` returns. With the reset first, the read could
/// remove the write of a signal that came in between. The flag would stay true, and later signals would not wake the
/// thread before its timeout.
class WakeUp {
 public:
  WakeUp();
  ~WakeUp();
  WakeUp(const WakeUp&) = delete;
  WakeUp& operator=(const WakeUp&) = delete;

  /// Never blocks. Any thread may call it.
  void signal();
  /// Returns after a signal since the last wait, or after `timeout_ms` [ms]. One thread may call it.
  void wait(int timeout_ms);

 private:
  int event_ = -1;
  std::atomic<bool> signalled_{false};
};

/// Moves output from the scenes' mailboxes to the bus, on a thread of its own. Serializing and sending a frame takes
/// longer than a step may wait, so the scenes' loops do neither.
///
///     loop of scene A ─┬─ writes ──> mailboxes of A: frame, feedback, … ┐
///     loop of scene B ─┼─ writes ──> mailboxes of B ───────────────────┤
///                      └─ WakeUp::signal ────────────┐                 │ take_frame, take_feedback, take_status
///     registry ── load, unload: WakeUp::signal ──────┴──> publisher <──┘
///                                                             └──> bus.publish(key, message)
///
/// - Who waits: only the publisher. It sleeps until a signal, but at most 50 ms, because paused scenes do not signal.
/// - What is dropped: a frame or a feedback that the loop overwrites before the publisher takes it. A mailbox keeps the
///   newest.
/// - Changes of the surface and events go out at most 20 times a second; each message has all of them.
/// - Order: feedback before frames, and again after each frame. A hand feels a late force; nobody feels a late frame.
/// - Other tools: a topology with them goes before their first frame, and tools that are gone get a last feedback.
/// - End of a scene: the publisher sends a last feedback with zero force and zero stiffness for each tool, so that no
///   client keeps pressing with an old force. Then it drops the scene's retained messages.
///
/// The publisher holds scenes by weak pointers and locks one only while it takes its messages. With shared pointers it
/// would be the last owner of every unloaded scene, and would wait for its loop to end, up to a step.
class Publisher {
 public:
  /// Starts the thread. `registry`, `bus` and `wake_up` must outlive the publisher; the registry's output signal must
  /// signal `wake_up`.
  Publisher(const control::SceneRegistry& registry, bus::Bus& bus, std::string server, WakeUp& wake_up);
  /// Ends the scenes that are no longer in the registry, as above, then joins the thread.
  ~Publisher();

  /// Returns false if the thread has not turned for `late`. Any thread may call it.
  bool turns(std::chrono::nanoseconds late) const {
    return now() - turned_.load(std::memory_order_relaxed) < std::chrono::steady_clock::duration(late).count();
  }

 private:
  struct Scene {
    explicit Scene(const control::RunnerPtr& started) : runner(started), id(started.get()) {}

    std::weak_ptr<world::Runner> runner;
    const world::Runner* id;                           // to compare only; may dangle
    std::uint64_t topology_version = 0;                // the last published one
    std::vector<v1::ToolFeedback> feedback;            // the last published feedback of each tool
    std::map<std::string, std::string> feedback_keys;  // [tool] of that topology
    std::string frame_key, status_key, topology_key, changes_key, events_key;
    std::chrono::steady_clock::time_point next_changes, next_events;  // not before
    std::uint64_t recoveries = 0;                                     // logged so far
    bool stopped = false;                                             // a fault was logged
    std::set<std::string> found;  // findings about results that were logged and last
  };

  static std::chrono::steady_clock::rep now() { return std::chrono::steady_clock::now().time_since_epoch().count(); }

  void run();
  /// Publishes what the mailboxes have, feedback first.
  void publish_news();
  /// Starts and ends scenes until `scenes_` has those of the registry. Cheap if the registry has not changed.
  void follow_registry();
  /// Publishes the topology and prepares the keys.
  void start_scene(const control::RunnerPtr& runner);
  /// Publishes the topology if it is another one than before, and the end of tools that it does not have.
  void follow_tools(const std::string& name, Scene& scene, const world::Runner& runner);
  /// Publishes a last feedback, without force.
  void release(const std::string& key, v1::ToolFeedback& feedback, bool removed);
  /// Publishes zero forces and drops the retained messages.
  void end_scene(Scene& scene);
  void publish_feedback(const std::string& name, Scene& scene);
  void publish_changes(Scene& scene, world::Runner& runner);
  void log_recovery(const std::string& name, Scene& scene);
  void log_findings(const std::string& name, Scene& scene);

  const control::SceneRegistry& registry_;
  bus::Bus& bus_;
  const std::string server_;
  log::Limiter recovery_lines_, finding_lines_;
  WakeUp& wake_up_;
  std::uint64_t generation_ = 0;  // generation of the registry that `scenes_` reflects
  std::map<std::string, Scene> scenes_;
  // Reused for every message, so that their buffers are allocated once.
  v1::Frame frame_;
  std::vector<v1::ToolFeedback> feedback_;
  v1::SceneStatus status_;
  v1::SurfaceChanges changes_;
  v1::SceneEvents events_;
  std::atomic<bool> stop_{false};
  std::atomic<std::chrono::steady_clock::rep> turned_{now()};
  std::thread thread_;
};

}  // namespace tensormass::daemon
