#include "haptic/force_guard.h"

#include <chrono>
#include <condition_variable>

#include "haptic/realtime.h"

namespace tensormass::haptic {

ForceGuard::ForceGuard(Device& device, Clock& clock, double timeout_s)
    : device_(device), clock_(clock), timeout_ns_(static_cast<std::int64_t>(timeout_s * kNsPerS)) {}

ForceGuard::~ForceGuard() { release(); }

Result<DevicePose> ForceGuard::read() {
  const std::scoped_lock lock(mutex_);
  return device_.read();
}

Result<void> ForceGuard::write(const Wrench& wrench) {
  const std::scoped_lock lock(mutex_);
  if (released_) return fail(ErrorCode::kFailedPrecondition, "force guard: written after its release");
  last_write_ns_ = clock_.now_ns();
  held_ = wrench;
  return device_.write(wrench);
}

void ForceGuard::release() noexcept {
  const std::scoped_lock lock(mutex_);
  if (released_) return;
  released_ = true;
  held_ = {};
  // If this write fails too, nothing is left to try: only the device's own watchdog can clear its force.
  static_cast<void>(device_.write(held_));
}

Wrench ForceGuard::held() const {
  const std::scoped_lock lock(mutex_);
  return held_;
}

void ForceGuard::check() {
  const std::scoped_lock lock(mutex_);
  if (released_ || held_.is_zero() || clock_.now_ns() - last_write_ns_ <= timeout_ns_) return;
  ++trips_;
  held_ = {};
  static_cast<void>(device_.write(held_));
}

std::uint64_t ForceGuard::trips() const {
  const std::scoped_lock lock(mutex_);
  return trips_;
}

Watchdog::Watchdog(ForceGuard& guard, double interval_s)
    : thread_([&guard, interval_s](std::stop_token stop) {
        // Above the loop's priority: a loop that spins must not block its watchdog.
        static_cast<void>(request_realtime(kWatchdogPriority));
        std::mutex mutex;
        std::condition_variable_any wake;
        std::unique_lock lock(mutex);
        while (!stop.stop_requested()) {
          wake.wait_for(lock, stop, std::chrono::duration<double>(interval_s), [] { return false; });
          guard.check();
        }
      }) {}

}  // namespace tensormass::haptic
