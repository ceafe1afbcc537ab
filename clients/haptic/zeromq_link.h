#pragma once

#include <memory>

#include "core/result.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// Connects over ZeroMQ. Returns before the server has answered, and reconnects by itself. Starts one receiving thread.
/// Fails if the server has ZeroMQ off (kUnavailable) or an endpoint is malformed (kInvalidArgument).
///
/// Feedback: a SUB socket with CONFLATE, which keeps the newest message. A high-water mark would keep the oldest.
/// CONFLATE silently breaks multipart messages, so a message is one frame: key, zero byte, protobuf.
///
/// Poses: a PUSH socket without CONFLATE, because a CONFLATE socket may drop its message when it closes. The socket's
/// queue holds one pose and exists only while the server is connected; the newest pose waits in the link. The last pose
/// matters: the server applies it until another comes, and it may be the one that lifts the tool off the tissue.
Result<std::unique_ptr<Link>> connect_zeromq(const LinkAddress& address);

}  // namespace tensormass::haptic
