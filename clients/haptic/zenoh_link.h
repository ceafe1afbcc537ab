#pragma once

#include <memory>

#include "core/result.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// Connects over zenoh, as a client of the server's locator. Poses go ahead of other traffic and are dropped, not
/// queued, when the network is busy. Feedback arrives on zenoh's threads. Fails if the server has zenoh off, or
/// if the session or the subscription fails.
Result<std::unique_ptr<Link>> connect_zenoh(const LinkAddress& address);

}  // namespace tensormass::haptic
