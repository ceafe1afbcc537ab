#pragma once

#include <memory>

#include "core/result.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// Over ZeroMQ: SUB for feedback with CONFLATE, so that the newest wins (a high-water mark bounds a queue but keeps its
/// oldest messages); CONFLATE would silently break multipart, so a message is one frame: key, zero byte, protobuf.
///
/// PUSH for poses without it: at its close a socket with CONFLATE may drop the message that it holds. Here the queue
/// has room for one, exists only while the server is there, and the newest pose waits outside of it. The last pose
/// counts: the server holds it until the next one, and it may be what lifts the tool off.
Result<std::unique_ptr<Link>> connect_zeromq(const LinkAddress& address);

}  // namespace tensormass::haptic
