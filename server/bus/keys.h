#pragma once

#include <optional>
#include <string>
#include <string_view>

#include "core/names.h"

/// Builds and parses the keys of the data plane, which stream.proto lists. No other file spells a key out.
///
///     tensormass/<server>/<scene>/topology
///     tensormass/<server>/<scene>/frame
///     tensormass/<server>/<scene>/status
///     tensormass/<server>/<scene>/tool/<tool>/feedback
///     tensormass/<server>/<scene>/tool/<tool>/pose      the only one that clients send
///
/// The functions that build keys expect valid names (core/names.h) and do not check them.
namespace tensormass::bus {

inline constexpr std::string_view kKeyRoot = "tensormass";

inline std::string scene_key(std::string_view server, std::string_view scene, std::string_view stream) {
  std::string key;
  key.reserve(kKeyRoot.size() + server.size() + scene.size() + stream.size() + 3);
  key.append(kKeyRoot).append("/").append(server).append("/").append(scene).append("/").append(stream);
  return key;
}

inline std::string topology_key(std::string_view server, std::string_view scene) {
  return scene_key(server, scene, "topology");
}

inline std::string frame_key(std::string_view server, std::string_view scene) {
  return scene_key(server, scene, "frame");
}

inline std::string status_key(std::string_view server, std::string_view scene) {
  return scene_key(server, scene, "status");
}

inline std::string feedback_key(std::string_view server, std::string_view scene, std::string_view tool) {
  return scene_key(server, scene, "tool/").append(tool).append("/feedback");
}

inline std::string pose_key(std::string_view server, std::string_view scene, std::string_view tool) {
  return scene_key(server, scene, "tool/").append(tool).append("/pose");
}

/// The two names in a pose's key. Both views point into the key that was parsed.
struct PoseAddress {
  std::string_view scene;
  std::string_view tool;
};

/// Parses a key from an untrusted client. Returns nullopt unless it is a pose key of `server` with valid names and
/// nothing after it.
inline std::optional<PoseAddress> parse_pose_key(std::string_view server, std::string_view key) {
  const auto take = [&key](std::string_view expected) {
    if (!key.starts_with(expected)) return false;
    key.remove_prefix(expected.size());
    return true;
  };
  const auto take_name = [&key]() {
    const std::string_view name = key.substr(0, key.find('/'));
    key.remove_prefix(name.size());
    return name;
  };
  if (!take(kKeyRoot) || !take("/") || !take(server) || !take("/")) return std::nullopt;
  const std::string_view scene = take_name();
  if (!take("/tool/")) return std::nullopt;
  const std::string_view tool = take_name();
  if (key != "/pose" || !is_valid_name(scene) || !is_valid_name(tool)) return std::nullopt;
  return PoseAddress{scene, tool};
}

}  // namespace tensormass::bus
