#pragma once

// A Haply Inverse3, Inverse3x or Minverse through Haply's Inverse service, a program on the same machine.
//
//      loop, 1 kHz                          I/O thread, 2 kHz                     Inverse service
//
//      write_force() --> newest force -->  force on the device  -- WebSocket -->
//      read() <--------- newest pose <---  state of all devices <-- WebSocket --
//
// Reasons:
// 1. The service answers each message with one state, so somebody has to wait for it. The loop must not: the I/O thread
//    does, and the loop exchanges values with it under a lock that is held for a copy.
// 2. The exchange runs at twice the loop's rate. A pose is then at most 0.5 ms and a round trip old, and a force waits
//    at most 0.5 ms. A faster exchange would take a core from the simulation.
// 3. A service that falls silent holds the last force, and nobody can tell it to stop. read() fails after
//    kMaxHaplySilenceS, which ends the loop; close() sends a zero force even then.
//
// Units: m, N, in the scene's frame. The messages are in haply_protocol.h, the frames in workspace_map.h.
// Checked against a simulated service only, not on hardware.

#include <memory>
#include <string>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "haptic/device.h"
#include "haptic/haply_protocol.h"
#include "haptic/workspace_map.h"

namespace tensormass::haptic {

/// Longest time from connecting to the first state [s].
inline constexpr double kHaplyOpenTimeoutS = 3.0;
/// Longest time without a state [s]. Longer than a pause of a busy machine, shorter than a person takes to let go.
inline constexpr double kMaxHaplySilenceS = 0.25;
/// Longest time for the last message, zero force, to leave [s].
inline constexpr double kHaplyCloseTimeoutS = 0.25;
/// Largest message that is read. A state of one device has 1 kB.
inline constexpr std::size_t kMaxHaplyMessageBytes = 256 * 1024;

/// Limits of an Inverse3 in its own frame.
///
/// Force 3 N: the loop's own default. Haply's data sheet with peak and continuous force was not at hand, so the limit
/// is low on purpose. It serves the smaller Minverse too.
///
/// Stiffness 300 N/m: Haply's example of a wall (python_samples, 05_wall.py) renders 1000 N/m at 1 kHz through the
/// serial port. A spring of stiffness K needs the damping b > K (T/2 + d) for a period T and a delay d (Colgate and
/// Schenkel 1997). The service adds a delay of about 1 ms, so the same damping allows a third.
///
/// Damping 5 N s/m: Haply's example of damping inside the service (crate haply, dynamic_damping_demo.rs) goes to
/// 10 N s/m. The loop's damper acts a period later.
inline const DeviceInfo kInverse3Limits{"Haply Inverse3", 3.0, 300.0, 5.0};

struct HaplyOptions {
  /// ws://host[:port][/path]; the default port is 10001.
  std::string url = "ws://127.0.0.1:10001";
  HaplyChoice choice;
  Workspace workspace;
};

/// The address at which a service listens.
struct HaplyAddress {
  std::string host;
  std::string port;
  std::string path;
};

/// Splits a URL such as ws://127.0.0.1:10001 or ws://[::1]:10001/. Fails with kInvalidArgument on anything else.
Result<HaplyAddress> parse_haply_url(const std::string& url);

/// The device. Its thread runs from open() to close().
class HaplyDevice final : public Device {
 public:
  explicit HaplyDevice(HaplyOptions options);
  ~HaplyDevice() override;
  HaplyDevice(const HaplyDevice&) = delete;
  HaplyDevice& operator=(const HaplyDevice&) = delete;

  /// Blocks for up to kHaplyOpenTimeoutS, until the first state is there.
  Result<void> open() override;
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override;
  /// Blocks for up to kHaplyCloseTimeoutS.
  void close() noexcept override;

 private:
  class Session;

  HaplyOptions options_;
  DeviceInfo info_;
  WorkspaceMap map_;
  std::unique_ptr<Session> session_;
};

}  // namespace tensormass::haptic
