#pragma once

#include <string>
#include <vector>

#include "access/client_list.h"

namespace tensormass::bus {

/// Writes access/rules.h as zenoh's access control, for the clients of a server: by the common names of their
/// certificates, which are their ids. zenoh denies the rest.
///
///     in    put          keys that the client may put
///           subscribe, query    any; the answers are what counts
///     out   put, reply   keys that the client may subscribe to
///           the server's own declarations, so that the client sends it puts and queries
std::string zenoh_access_control(const std::string& server, const std::vector<access::ClientPtr>& clients);

}  // namespace tensormass::bus
