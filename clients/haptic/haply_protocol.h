#pragma once

// The messages of Haply's Inverse service: JSON over WebSocket, one text message each.
//
//      this client                        Inverse service
//
//          <------ snapshot of all devices ------      once, after connecting
//          ------- force on one device --------->
//          <------ state of all devices ---------      exactly one for each message of the client
//
// Source: docs.haply.co, Inverse SDK 3.5, "WebSocket Protocol" and "Simulation Channel"; 3.4, "Simulation Channel".
//
// Reasons:
// 1. The service is another program, so nothing it sends is trusted. A message that is not JSON, lacks a field, or has
//    a value of the wrong type is an error that names the device, the field and the remedy. It is never a pose.
// 2. Service 3.5 calls the force of `set_cursor_force` "vector", older ones call it "values". No message carries the
//    service's version, but only 3.5 puts `preset`, `mount`, `filters` or `home_return` into a device's configuration.
//
// Units: m, N, in the device's frame: right-handed, x to the right, y forward, z up. Pure functions, for any thread.

#include <string>
#include <string_view>

#include <Eigen/Core>

#include "core/result.h"
#include "haptic/device.h"

namespace tensormass::haptic {

/// Which devices to use. Empty: the only one; several are then an error that lists them.
struct HaplyChoice {
  std::string device_id;
  /// Id of a VerseGrip, wired, wireless or custom.
  std::string grip_id;
  /// The grip's button that works the tool's power, 1 to kHaplyButtons; 0: none.
  int power_button = 0;
};

/// Buttons of a wireless VerseGrip: a, b and c. A wired one has the first only.
inline constexpr int kHaplyButtons = 3;

/// Name of the force vector in `set_cursor_force`.
enum class HaplyForceField {
  kVector,  ///< Service 3.5.
  kValues,  ///< Older services.
};

/// The devices that a session uses, from the snapshot.
struct HaplyDevices {
  std::string inverse_id;
  /// Empty: no grip, the orientation is then the identity.
  std::string grip_id;
  HaplyForceField force_field = HaplyForceField::kVector;
  /// As in HaplyChoice.
  int power_button = 0;
};

/// Reads the snapshot and chooses the devices. Fails if the Inverse3 is missing, ambiguous, without power or not
/// calibrated, or if there is no grip for the button.
Result<HaplyDevices> parse_haply_snapshot(std::string_view message, const HaplyChoice& choice);

/// Reads the pose, in the device's frame, from a state. Every number of it is finite. Fails if the Inverse3 or the grip
/// is no longer among the devices, or if the grip lacks the button.
Result<DevicePose> parse_haply_state(std::string_view message, const HaplyDevices& devices);

/// The message that sets the force on the hand [N], in the device's frame. `force_n` must be finite.
std::string haply_force_command(const HaplyDevices& devices, const Eigen::Vector3d& force_n);

/// Returns an id of the service for a message to the user: quoted, escaped and of limited length.
std::string shown_haply_id(std::string_view id);

}  // namespace tensormass::haptic
