#pragma once

// Keeps a stalled loop from leaving a force on the hand: a lock around the device and a watchdog thread.
//
// Forces in N, torques in N m, times in s. ForceGuard may be used by any thread. Device errors pass through; a write
// after release() fails with kFailedPrecondition.

#include <cstdint>
#include <mutex>
#include <thread>

#include "haptic/clock.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// The only access to the device while the loop runs. A wrench must be renewed: if no write comes for `timeout_s`,
/// check() sets force and torques to zero. The next write may apply them again.
class ForceGuard {
 public:
  /// `device` must be open. `device` and `clock` must outlive the guard.
  ForceGuard(Device& device, Clock& clock, double timeout_s);
  /// Releases.
  ~ForceGuard();
  ForceGuard(const ForceGuard&) = delete;
  ForceGuard& operator=(const ForceGuard&) = delete;

  const DeviceInfo& info() const { return device_.info(); }
  Result<DevicePose> read();
  Result<void> write(const Wrench& wrench);
  /// Sets force and torques to zero. Every later write fails.
  void release() noexcept;
  /// The wrench that the device holds; zero after the watchdog has cleared it.
  Wrench held() const;

  /// Sets a wrench to zero that was not renewed in time. Called by the watchdog.
  void check();
  /// How often check() had to set a wrench to zero.
  std::uint64_t trips() const;

 private:
  Device& device_;
  Clock& clock_;
  const std::int64_t timeout_ns_;
  mutable std::mutex mutex_;
  Wrench held_;
  std::int64_t last_write_ns_ = 0;
  bool released_ = false;
  std::uint64_t trips_ = 0;
};

/// Calls guard.check() every `interval_s` from its own thread until destroyed. `guard` must outlive it.
class Watchdog {
 public:
  Watchdog(ForceGuard& guard, double interval_s);

 private:
  std::jthread thread_;
};

}  // namespace tensormass::haptic
