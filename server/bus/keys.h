#pragma once

#include <optional>
#include <string>
#include <string_view>

#include "core/names.h"

/// Builds and parses the keys of the data plane, which stream.proto lists. No other file spells a key out.
///
///     tensormass/<server>/<scene>/topology
///     tensormass/<server>/<scene>/frame
///     tensormass/<server>/<scene>/changes
///     tensormass/<server>/<scene>/status
///     tensormass/<server>/<scene>/events
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

inline std::string changes_key(std::string_view server, std::string_view scene) {
  return scene_key(server, scene, "changes");
}

inline std::string events_key(std::string_view server, std::string_view scene) {
  return scene_key(server, scene, "events");
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

namespace detail {

/// Reads a key from its start.
class KeyReader {
 public:
  explicit KeyReader(std::string_view key) : rest_(key) {}
  bool take(std::string_view expected) {
    if (!rest_.starts_with(expected)) return false;
    rest_.remove_prefix(expected.size());
    return true;
  }
  /// Returns what is before the next slash; it may be no valid name.
  std::string_view take_name() {
    const std::string_view name = rest_.substr(0, rest_.find('/'));
    rest_.remove_prefix(name.size());
    return name;
  }
  bool take_root(std::string_view server) { return take(kKeyRoot) && take("/") && take(server) && take("/"); }
  std::string_view rest() const { return rest_; }

 private:
  std::string_view rest_;
};

}  // namespace detail

/// Parses a key from an untrusted client. Returns nullopt unless it is a pose key of `server` with valid names and
/// nothing after it.
inline std::optional<PoseAddress> parse_pose_key(std::string_view server, std::string_view key) {
  detail::KeyReader reader(key);
  if (!reader.take_root(server)) return std::nullopt;
  const std::string_view scene = reader.take_name();
  if (!reader.take("/tool/")) return std::nullopt;
  const std::string_view tool = reader.take_name();
  if (reader.rest() != "/pose" || !is_valid_name(scene) || !is_valid_name(tool)) return std::nullopt;
  return PoseAddress{scene, tool};
}

/// The names in a stream's key. `stream` is as in access::kStreams; `tool` is empty unless the stream is a tool's.
/// Views point into the key that was parsed.
struct StreamAddress {
  std::string_view scene, stream, tool;
};

/// Parses a key from an untrusted client. Returns nullopt unless it is that of a stream which `server` publishes,
/// whether or not the scene is loaded.
inline std::optional<StreamAddress> parse_stream_key(std::string_view server, std::string_view key) {
  detail::KeyReader reader(key);
  if (!reader.take_root(server)) return std::nullopt;
  const std::string_view scene = reader.take_name();
  if (!is_valid_name(scene)) return std::nullopt;
  if (reader.take("/tool/")) {
    const std::string_view tool = reader.take_name();
    if (!is_valid_name(tool) || reader.rest() != "/feedback") return std::nullopt;
    return StreamAddress{scene, "tool/*/feedback", tool};
  }
  for (const std::string_view stream : {"topology", "frame", "changes", "status", "events"}) {
    if (reader.rest().starts_with('/') && reader.rest().substr(1) == stream) return StreamAddress{scene, stream, {}};
  }
  return std::nullopt;
}

inline bool is_stream_key(std::string_view server, std::string_view key) {
  return parse_stream_key(server, key).has_value();
}

}  // namespace tensormass::bus
