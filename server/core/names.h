#pragma once

#include <algorithm>
#include <string>
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

/// Lists the names of some things for a message: "a, b", or "none". `name_of` returns the name of one.
template <typename Things, typename NameOf>
std::string list_names(const Things& things, NameOf name_of) {
  std::string out;
  for (const auto& thing : things) {
    if (!out.empty()) out += ", ";
    out += name_of(thing);
  }
  return out.empty() ? "none" : out;
}

}  // namespace tensormass
