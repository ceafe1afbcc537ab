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

void Vitals::look_for_losses(const std::vector<control::RunnerPtr>& scenes) {
  std::vector<control::RunnerPtr> newly;  // a scene of each device
  for (const control::RunnerPtr& runner : scenes) {
    if (runner->device_lost() && lost_.insert(runner->device()).second) newly.push_back(runner);
  }
  if (lost_.empty() || told_of_end_) return;
  const bool goes_on = std::any_of(scenes.begin(), scenes.end(),
                                   [&](const control::RunnerPtr& runner) { return !lost_.contains(runner->device()); });
  for (const control::RunnerPtr& runner : newly) watched_.on_device_lost(*runner, goes_on);
  if (!goes_on && !std::exchange(told_of_end_, true)) watched_.on_no_device();
}

void Vitals::run() {
  name_thread("vitals");
  const auto watchdog = watched_.manager.watchdog();
  const auto look = watchdog ? std::min(kLook, *watchdog / 4) : kLook;
  std::optional<bool> was_live;
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
      look_for_losses(scenes);
    }
    lock.lock();
    wake_.wait_for(lock, look, [&] { return stop_; });
  }
}

}  // namespace tensormass::daemon
