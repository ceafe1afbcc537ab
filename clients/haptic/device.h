#pragma once

#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "core/result.h"

namespace tensormass::haptic {

/// What a device can render; the force pipeline stays within it.
struct DeviceInfo {
  std::string name;
  double max_force_n = 0.0;
  /// Stiffest spring that the device renders stably at the loop's rate. A sampled spring is passive only for
  /// K < 2 b / T with b the device's own damping (Colgate and Schenkel 1997); stiffer local models are scaled down.
  double max_stiffness_n_per_m = 0.0;
  /// Strongest damper that it renders stably; bounds what the passivity controller may add.
  double max_damping_n_s_per_m = 0.0;
};

/// Where the hand holds the tool, in the scene's frame. What is not finite, beyond limits::kMaxLength, or whose
/// quaternion is 1 % or more off unit length the loop takes for a fault of the device: no force and nothing sent.
struct DevicePose {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();
};

/// A haptic device: position in, force out. Called by one thread at a time (ForceGuard sees to it).
class Device {
 public:
  virtual ~Device() = default;
  /// Ready to read and write, with no force on the hand. The error says which device and what to check.
  virtual Result<void> open() = 0;
  /// Constant once open.
  virtual const DeviceInfo& info() const = 0;
  virtual Result<DevicePose> read() = 0;
  /// The force [N] on the hand, held until the next write.
  virtual Result<void> write_force(const Eigen::Vector3d& force_n) = 0;
  /// Without force, and released. May be called again.
  virtual void close() noexcept = 0;
};

}  // namespace tensormass::haptic
