#pragma once

// The interface that the author of a haptic device implements: position in, force out. A device that also has a torque
// or a driven gripper overrides one more function.
//
// Units: m, N, N/m, N s/m, rad, N m, in the scene's frame. Threading: ForceGuard calls a device from the loop and from
// the watchdog, one at a time. A call that fails ends the loop and reaches the user as the loop's error.

#include <cmath>
#include <optional>
#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "core/result.h"

namespace tensormass::haptic {

/// Limits of the device. The loop stays within them, whatever its options ask for.
struct DeviceInfo {
  std::string name;
  double max_force_n = 0.0;
  /// Stiffest spring that the device renders stably at the loop's rate; stiffer local models are scaled down to it.
  /// A sampled spring of stiffness K is passive only for K < 2 b / T (Colgate and Schenkel 1997): b is the device's
  /// own damping [N s/m], T the loop's period [s].
  double max_stiffness_n_per_m = 0.0;
  /// Strongest damper that the device renders stably. Bounds the damping that the passivity controller adds.
  double max_damping_n_s_per_m = 0.0;
  /// Largest torque on the hand. Zero: the device has none.
  double max_torque_n_m = 0.0;
  /// Stiffest torsional spring that the device renders stably, as max_stiffness_n_per_m. Stiffer contact is scaled down
  /// to it, so that zero leaves no torque.
  double max_angular_stiffness_n_m_per_rad = 0.0;
  /// Strongest damper of rotation that the device renders stably.
  double max_angular_damping_n_m_s = 0.0;
  /// Largest torque on the gripper, about the hinge of the tool's jaws. Zero: the device has none.
  double max_jaw_torque_n_m = 0.0;
  /// Strongest damper of the jaws' angle that the device renders stably.
  double max_jaw_damping_n_m_s = 0.0;
};

/// The widest angle of a tool's jaws that the protocol allows [rad]; the least is zero (message Grasper).
inline constexpr double kMaxJawAngleRad = 2.5;

/// Pose of the tool in the scene's frame. A pose is invalid in three cases: a coordinate is not finite or exceeds
/// limits::kMaxLength, the quaternion's length is off 1 by 1 % or more, or the jaws' angle is out of its range. For an
/// invalid pose the loop renders no force and sends nothing.
struct DevicePose {
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Quaterniond orientation = Eigen::Quaterniond::Identity();
  /// Angle between the tool's jaws, zero to kMaxJawAngleRad. Only for a tool that has jaws.
  std::optional<double> jaw_angle_rad = std::nullopt;
  /// The button or pedal that works the tool's power (Tool.cautery) is down. PowerSwitch decides what follows.
  bool pressed = false;
};

/// Everything that a device does to the hand.
struct Wrench {
  Eigen::Vector3d force_n = Eigen::Vector3d::Zero();
  /// About DevicePose::position_m.
  Eigen::Vector3d torque_n_m = Eigen::Vector3d::Zero();
  /// Torque that opens the jaws; a negative one closes them.
  double jaw_torque_n_m = 0.0;

  bool is_force_alone() const { return torque_n_m.isZero(0.0) && jaw_torque_n_m == 0.0; }
  bool is_zero() const { return force_n.isZero(0.0) && is_force_alone(); }
  bool is_finite() const { return force_n.allFinite() && torque_n_m.allFinite() && std::isfinite(jaw_torque_n_m); }
};

/// A haptic device. Called by one thread at a time, which need not always be the same one.
class Device {
 public:
  virtual ~Device() = default;
  /// Makes the device ready to read and write, with no force on the hand. The error names the device and the remedy.
  virtual Result<void> open() = 0;
  /// Must not change while the device is open. The reference lives as long as the device.
  virtual const DeviceInfo& info() const = 0;
  /// The pose now. Must return within a small part of the loop's period (1 ms at 1 kHz).
  virtual Result<DevicePose> read() = 0;
  /// Applies this force [N], without torque, to the hand until the next write.
  virtual Result<void> write_force(const Eigen::Vector3d& force_n) = 0;
  /// Applies force, torque and the jaws' torque until the next write. The loop calls this one, within the limits of
  /// info(). Override it only for a device whose info() states a torque: others get write_force().
  virtual Result<void> write(const Wrench& wrench) {
    if (wrench.is_force_alone()) return write_force(wrench.force_n);
    return fail(ErrorCode::kFailedPrecondition, info().name + ": its info() states a torque, but it lacks write()");
  }
  /// Takes the force off and releases the device. May be called again, and before open().
  virtual void close() noexcept = 0;
};

}  // namespace tensormass::haptic
