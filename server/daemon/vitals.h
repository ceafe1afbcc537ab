#pragma once

#include <condition_variable>
#include <functional>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "control/scene_registry.h"
#include "daemon/service_manager.h"

namespace tensormass::daemon {

/// Watches, on a thread of its own, whether the daemon works:
///
///     live    every loop and the publisher turned within limits::kTurnTime, or had nothing to do
///     lost    a scene lost its device in a way that ends the device's use for this process
///
/// While the daemon is live, the service manager gets WATCHDOG=1. If a loop hangs, the watch goes on and says nothing.
/// If anything holds the registry, the watch hangs with it, which says the same.
class Vitals {
 public:
  struct Watched {
    const ServiceManager& manager;
    std::function<std::vector<control::RunnerPtr>()> scenes;  ///< all that step
    std::function<bool()> publisher_turns;
    std::function<void(bool live)> on_live;                        ///< called first, and after each change
    std::function<void(const std::string& scene)> on_device_lost;  ///< called once
  };
  /// The functions are called on the thread of the watch.
  explicit Vitals(Watched watched);
  ~Vitals();

 private:
  void run();
  bool is_live(const std::vector<control::RunnerPtr>& scenes) const;

  const Watched watched_;
  std::mutex mutex_;
  std::condition_variable wake_;
  bool stop_ = false;  // guarded by mutex_
  std::thread thread_;
};

}  // namespace tensormass::daemon
