#pragma once

#include <string>

#include "core/result.h"

namespace tensormass::haptic {

/// Keys of this client, from the file that `tensormass keys add` writes. All texts are empty without keys.
struct ClientKeys {
  std::string authority, certificate, private_key;       ///< PEM
  std::string curve_public, curve_secret, curve_server;  ///< Z85

  explicit operator bool() const { return !certificate.empty(); }
};

/// Fails with kInvalidArgument, and names file and remedy, if the file is missing, damaged, expired, or readable by
/// every user of this machine.
Result<ClientKeys> read_client_keys(const std::string& path);

}  // namespace tensormass::haptic
