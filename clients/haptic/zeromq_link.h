#pragma once

#include <memory>

#include "core/result.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// Over ZeroMQ: PUSH for poses, SUB for feedback, both with CONFLATE so that the newest wins (a high-water mark bounds
/// a queue but keeps its oldest messages). A message is one frame: key, zero byte, protobuf; CONFLATE would silently
/// break multipart.
Result<std::unique_ptr<Link>> connect_zeromq(const LinkAddress& address);

}  // namespace tensormass::haptic
