#pragma once

// A device of Force Dimension (omega, delta, sigma, lambda) or a Novint Falcon, through the maker's library libdhd.
//
// Reasons:
// 1. The library is loaded when the device opens. This client is thus built and distributed without the maker's kit.
// 2. The library exchanges with the controller on its own and each call returns at once, so the loop's thread calls it.
// 3. The force is taken off by a zero force and then by switching forces off. The controller's brakes then damp a grip
//    that was let go.
// 4. The torque on the wrist and the force on the gripper go with the force, in the one call that takes all three. A
//    device that says it has no active wrist or gripper, or a library that cannot say it, gets zero.
//
// Functions, constants, units and axes are declared from the maker's public reference, "DHD - Haptic SDK Documentation"
// of SDK 3.17 (forcedimension.com): chapters "Axis Convention", "Device Modes" and the pages of the functions below.
// SDK 3.6 of 2015 already has them all.
//
// Units: m, N, N m, in the scene's frame. Untested on hardware: tests/haptic has a library that stands for the maker's.

#include <memory>
#include <string>

#include <Eigen/Core>

#include "haptic/device.h"
#include "haptic/workspace_map.h"

namespace tensormass::haptic {

/// Limits of all devices of the library, because it does not tell those of the one that is open.
///
/// Force 8 N: less than a Falcon's 9 N, the weakest of them. Stiffness 2000 N/m: an omega's data sheet states 14 500
/// N/m at the controller's own rate of 4 kHz or more; the loop runs at 1 kHz and its force waits for the next exchange.
/// Damping 5 N s/m: as for the other devices, because the velocity is a difference of sampled positions.
///
/// Torque 0.2 N m, and on the jaws 0.2 N m, a force of 4 N on the finger; stiffness of rotations 1 N m/rad, damping
/// 0.01 N m s. All are low on purpose: data sheets of the wrists were not at hand, and nobody has tried a device.
inline const DeviceInfo kForceDimensionLimits{"Force Dimension", 8.0, 2000.0, 5.0, 0.2, 1.0, 0.01, 0.2, 0.01};

/// From the gripper's hinge to the finger [m]: a gap of 25 mm at half a radian. The library takes a force on the
/// finger, positive if it opens, and the server sends a torque about the hinge. Another lever scales what the finger
/// feels; the sign of its work stays.
inline constexpr double kForceDimensionGripperLeverM = 0.05;

/// Buttons that the library tells apart (DHD_MAX_BUTTONS).
inline constexpr int kForceDimensionButtons = 8;

struct ForceDimensionOptions {
  /// The maker's library: a path, or a name that the system's loader finds.
  std::string library = "libdhd.so.3";
  /// Serial number of the device; empty: the first that is free.
  std::string serial;
  Workspace workspace;
  /// The tool has jaws, which follow the angle of the device's gripper.
  bool moves_jaws = false;
  /// The button that works the tool's power, 1 to kForceDimensionButtons; 0: none. The maker counts them from 0.
  int power_button = 0;
};

class ForceDimensionDevice final : public Device {
 public:
  explicit ForceDimensionDevice(ForceDimensionOptions options);
  ~ForceDimensionDevice() override;
  ForceDimensionDevice(const ForceDimensionDevice&) = delete;
  ForceDimensionDevice& operator=(const ForceDimensionDevice&) = delete;

  Result<void> open() override;
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override { return write({force_n}); }
  Result<void> write(const Wrench& wrench) override;
  void close() noexcept override;

 private:
  struct Functions;

  /// The pose in the device's frame.
  Result<DevicePose> read_device() const;
  /// The library's words for what failed, with the remedy.
  tl::unexpected<Error> failed(const char* what) const;

  ForceDimensionOptions options_;
  DeviceInfo info_;
  WorkspaceMap map_;
  std::unique_ptr<Functions> functions_;
  bool open_ = false;
  bool has_gripper_ = false;
  char id_ = -1;
};

}  // namespace tensormass::haptic
