#pragma once

// The transport between a client and one tool, as an interface: zeromq_link.h and zenoh_link.h implement it.
//
// Threading: the loop's thread calls a link; each implementation receives on its own thread. No call blocks. A broken
// network is not an error: send() returns false and receive() returns nothing.

#include <cstdint>
#include <optional>
#include <string>

#include "haptic/client_keys.h"
#include "haptic/feedback.h"

namespace tensormass::haptic {

/// Poses to one tool and feedback from it. In both directions a newer message replaces an older one that still waits.
class Link {
 public:
  virtual ~Link() = default;
  /// Returns false if the transport did not take the pose at once, for example without a server. A later call may still
  /// send it, unless a newer pose has replaced it.
  virtual bool send(const OutgoingPose& pose) = 0;
  /// The newest feedback since the last call, if one came.
  virtual std::optional<Feedback> receive() = 0;
  /// Number of messages that could not be decoded.
  virtual std::uint64_t malformed() const = 0;
};

/// Endpoints and keys of a tool's streams. discover_tool() fills them from GetVersion and bus/keys.h.
struct LinkAddress {
  std::string pose_key;
  std::string feedback_key;
  /// Empty if the server has ZeroMQ off.
  std::string zeromq_pose_endpoint;
  std::string zeromq_publish_endpoint;
  /// Empty if the server has zenoh off.
  std::string zenoh_locator;
  ClientKeys keys = {};
};

}  // namespace tensormass::haptic
