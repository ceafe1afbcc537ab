#pragma once

// A Touch, Touch X or Phantom of 3D Systems through OpenHaptics, by its low-level HD interface.
//
//      loop, 1 kHz                          scheduler of OpenHaptics, 1 kHz
//
//      write_force() --> newest force -->  begin frame, read pose, set force, end frame --> device
//      read() <--------- newest pose <---
//
// Reasons:
// 1. The library is loaded when the device opens. This client is thus built and distributed without the maker's kit.
// 2. OpenHaptics allows forces only in its own scheduler's thread. The loop exchanges values with it under a lock that
//    is held for a copy. A pose is at most 1 ms old, and a force waits for at most 1 ms.
// 3. A scheduler that stops holds the last force. read() fails after kMaxOpenHapticsSilenceS, which ends the loop;
//    close() then stops the scheduler and gives the device back, which takes the force off.
//
// Functions, constants, units and axes are declared from the maker's public documents: "OpenHaptics Toolkit Version
// 3.5.0 API Reference Guide", chapters 2 (device routines), 3 (calibration), 4 (scheduler) and the appendix of HDAPI
// parameters; "OpenHaptics Toolkit Programmer's Guide", chapter "HDAPI Programming".
//
// Units: m, N, in the scene's frame. Untested on hardware: tests/haptic has a library that stands for the maker's.

#include <memory>
#include <string>

#include <Eigen/Core>

#include "haptic/device.h"
#include "haptic/workspace_map.h"

namespace tensormass::haptic {

/// Longest time from the scheduler's start to its first frame [s].
inline constexpr double kOpenHapticsOpenTimeoutS = 3.0;
/// Longest time without a frame [s]. Longer than a pause of a busy machine, shorter than a person takes to let go.
inline constexpr double kMaxOpenHapticsSilenceS = 0.25;
/// Longest time for the last frame, zero force, to reach the device [s].
inline constexpr double kOpenHapticsCloseTimeoutS = 0.25;

/// Bounds of the limits that the device states itself, and the limits if it states none.
///
/// Force 8 N: a Phantom Premium may state more than a hand expects. Stiffness 1000 N/m and damping 5 N s/m: the
/// statements hold inside the scheduler, and this loop adds a period to its delay.
inline const DeviceInfo kOpenHapticsBounds{"OpenHaptics device", 8.0, 1000.0, 5.0};

struct OpenHapticsOptions {
  /// The maker's library: a path, or a name that the system's loader finds.
  std::string library = "libHD.so";
  /// Name of the device in the maker's setup program; empty: the default device.
  std::string name;
  Workspace workspace;
  /// The tool has jaws: the first button closes them.
  bool moves_jaws = false;
  /// The button that works the tool's power, 1 to kOpenHapticsButtons; 0: none. Not 1 with jaws.
  int power_button = 0;
};

/// Buttons that the library tells apart.
inline constexpr int kOpenHapticsButtons = 4;

/// Angle of open jaws, with the button up [rad].
inline constexpr double kButtonJawAngleRad = 0.5;

class OpenHapticsDevice final : public Device {
 public:
  explicit OpenHapticsDevice(OpenHapticsOptions options);
  ~OpenHapticsDevice() override;
  OpenHapticsDevice(const OpenHapticsDevice&) = delete;
  OpenHapticsDevice& operator=(const OpenHapticsDevice&) = delete;

  /// Blocks for up to kOpenHapticsOpenTimeoutS, until the first frame.
  Result<void> open() override;
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override;
  /// Blocks for up to kOpenHapticsCloseTimeoutS.
  void close() noexcept override;

 private:
  class Session;

  OpenHapticsOptions options_;
  DeviceInfo info_;
  WorkspaceMap map_;
  std::unique_ptr<Session> session_;
};

}  // namespace tensormass::haptic
