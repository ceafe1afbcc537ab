#pragma once

#include <optional>
#include <string>
#include <string_view>

#include "core/names.h"

/// The keys of the data plane (stream.proto lists them), made and read here only.
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

/// What a pose's key names; views into the key.
struct PoseAddress {
  std::string_view scene;
  std::string_view tool;
};

/// Reads a key that came from outside: nothing unless it is exactly a pose's key of this server.
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
