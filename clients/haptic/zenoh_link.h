#pragma once

#include <memory>

#include "core/result.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// Over zenoh, as a client of the server's locator: urgent, and dropped rather than waited for when the network is
/// busy.
Result<std::unique_ptr<Link>> connect_zenoh(const LinkAddress& address);

}  // namespace tensormass::haptic
