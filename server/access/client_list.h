#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <string_view>

#include "access/rules.h"
#include "core/result.h"

namespace tensormass::access {

/// A client that has a key.
struct Client {
  /// Name of its certificate: NAME.KEY. Each key has another one, so a removed key never becomes valid again.
  std::string id;
  Role role = Role::kViewer;
  std::string scene, tool;     ///< a hand's
  std::string curve_public;    ///< its public key of ZeroMQ, 40 characters of Z85
  std::int64_t expires_s = 0;  ///< seconds since 1970

  Subject subject() const { return {role, scene, tool}; }
  bool operator==(const Client&) const = default;
};

using ClientPtr = std::shared_ptr<const Client>;

/// The clients that a daemon knows, by id.
using ClientList = std::map<std::string, ClientPtr, std::less<>>;

/// Characters of a key of ZeroMQ, in Z85 (rfc.zeromq.org/spec/32).
inline constexpr std::size_t kCurveCharacters = 40;
bool is_curve_key(std::string_view text);

/// Reads the text of clients.json. `path` is for messages. Fails with kInvalidArgument, and names file, client and
/// remedy.
Result<ClientList> read_client_list(std::string_view text, const std::string& path);

}  // namespace tensormass::access
