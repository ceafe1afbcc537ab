#pragma once

#include <cstdint>
#include <mutex>
#include <thread>

#include <Eigen/Core>

#include "haptic/clock.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// The only way to the device while the loop runs. A force on the hand has to be renewed: if no write comes for
/// `timeout_s`, the watchdog sets it to zero, so that a loop that stalls does not leave the last force standing.
class ForceGuard {
 public:
  /// `device` is open and outlives the guard, as does `clock`.
  ForceGuard(Device& device, Clock& clock, double timeout_s);
  /// Zero force.
  ~ForceGuard();
  ForceGuard(const ForceGuard&) = delete;
  ForceGuard& operator=(const ForceGuard&) = delete;

  const DeviceInfo& info() const { return device_.info(); }
  Result<DevicePose> read();
  Result<void> write(const Eigen::Vector3d& force_n);
  /// Zero now, and every later write is refused.
  void release() noexcept;
  /// What the device holds; zero after the watchdog has stepped in.
  Eigen::Vector3d held_force_n() const;

  /// The watchdog's look: zeroes a force that was not renewed in time.
  void check();
  /// How often it had to.
  std::uint64_t trips() const;

 private:
  Device& device_;
  Clock& clock_;
  const std::int64_t timeout_ns_;
  mutable std::mutex mutex_;
  Eigen::Vector3d held_force_n_ = Eigen::Vector3d::Zero();
  std::int64_t last_write_ns_ = 0;
  bool released_ = false;
  std::uint64_t trips_ = 0;
};

/// Looks at a guard every `interval_s` from a thread of its own until destroyed.
class Watchdog {
 public:
  Watchdog(ForceGuard& guard, double interval_s);

 private:
  std::jthread thread_;
};

}  // namespace tensormass::haptic
