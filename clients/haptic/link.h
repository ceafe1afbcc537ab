#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "haptic/feedback.h"

namespace tensormass::haptic {

/// One tool's way to the server and back, over any transport: newest wins in both directions, nothing ever waits.
class Link {
 public:
  virtual ~Link() = default;
  /// False if the transport did not take it at once (no server yet). It may go with a later call then, unless a newer
  /// pose replaces it.
  virtual bool send(const OutgoingPose& pose) = 0;
  /// The newest feedback since the last call.
  virtual std::optional<Feedback> receive() = 0;
  /// Messages that could not be read.
  virtual std::uint64_t malformed() const = 0;
};

/// Where a tool's streams are: endpoints as GetVersion names them, keys as bus/keys.h makes them.
struct LinkAddress {
  std::string pose_key;
  std::string feedback_key;
  /// ZeroMQ; empty if the server has it off.
  std::string zeromq_pose_endpoint;
  std::string zeromq_publish_endpoint;
  /// zenoh; empty if the server has it off.
  std::string zenoh_locator;
};

}  // namespace tensormass::haptic
