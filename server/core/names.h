#pragma once

#include <algorithm>
#include <string_view>

#include "core/limits.h"

namespace tensormass {

/// Returns whether a name of a server, scene, body or tool is valid: 1 to limits::kMaxNameLength characters of
/// [A-Za-z0-9_-]. Such names need no escaping in keys, file names and logs.
constexpr bool is_valid_name(std::string_view name) {
  return !name.empty() && name.size() <= limits::kMaxNameLength && std::all_of(name.begin(), name.end(), [](char c) {
    return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_' || c == '-';
  });
}

}  // namespace tensormass
