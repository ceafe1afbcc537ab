#include "daemon/vitals.h"

#include <algorithm>
#include <chrono>
#include <optional>
#include <utility>
#include <vector>

#include "core/log.h"
#include "core/state_limits.h"
#include "core/thread_name.h"

namespace tensormass::daemon {
namespace {

/// Time between two looks, unless the watchdog wants to hear of the daemon more often.
constexpr std::chrono::microseconds kLook{250'000};

}  // namespace

Vitals::Vitals(Watched watched) : watched_(std::move(watched)) {
  thread_ = std::thread([this] { run(); });
}

Vitals::~Vitals() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  wake_.notify_one();
  thread_.join();
}

bool Vitals::is_live(const std::vector<control::RunnerPtr>& scenes) const {
  return watched_.publisher_turns() && std::all_of(scenes.begin(), scenes.end(), [](const control::RunnerPtr& runner) {
           return runner->turns(limits::kTurnTime);
         });
}

void Vitals::run() {
  name_thread("vitals");
  const auto watchdog = watched_.manager.watchdog();
  const auto look = watchdog ? std::min(kLook, *watchdog / 4) : kLook;
  std::optional<bool> was_live;
  bool lost = false;
  std::unique_lock lock(mutex_);
  while (!stop_) {
    lock.unlock();
    {
      const std::vector<control::RunnerPtr> scenes = watched_.scenes();
      const bool live = is_live(scenes);
      if (live) watched_.manager.tell("WATCHDOG=1");
      if (was_live != live) {
        if (!live) log::error("a loop or the publisher hangs", {{"for_s", limits::kTurnTime.count() / 1000.0}});
        if (live && was_live) log::info("all loops and the publisher turn again");
        watched_.on_live(live);
        was_live = live;
      }
      const auto one =
          std::find_if(scenes.begin(), scenes.end(), [](const auto& runner) { return runner->device_lost(); });
      if (one != scenes.end() && !std::exchange(lost, true)) watched_.on_device_lost((*one)->name());
    }
    lock.lock();
    wake_.wait_for(lock, look, [&] { return stop_; });
  }
}

}  // namespace tensormass::daemon
