#pragma once

// Finds a tool of a running scene: asks the server's control plane (gRPC) where the tool's streams are, where the tool
// is, and which tissue is nearest.
//
// Lengths are in m, in the scene's frame. Every call blocks for up to its Patience, so none belongs in the loop; calls
// may come from any thread. Errors: kUnavailable if no server answers, kCancelled after `stop`, kNotFound for the scene
// or the tool, kFailedPrecondition if the scene cannot answer. The messages name the remedy.

#include <atomic>
#include <cstdint>
#include <string>
#include <string_view>

#include <Eigen/Core>

#include "core/result.h"
#include "haptic/client_keys.h"
#include "haptic/link.h"
#include "tensormass/v1/control.pb.h"

namespace tensormass::haptic {

/// Server, streams and geometry of one tool.
struct DiscoveredTool {
  v1::GetVersionResponse server;
  LinkAddress address;
  /// The tool's origin at the time of the call.
  Eigen::Vector3d tool_position_m = Eigen::Vector3d::Zero();
  double radius_m = 0.0;
  /// Vector from the tool's origin to the centre of its sphere.
  Eigen::Vector3d tip_offset_m = Eigen::Vector3d::Zero();
  /// The tool has one joint, which opens its jaws.
  bool has_jaws = false;
  /// The tool burns tissue (Tool.cautery), so its poses may have a level.
  bool has_power = false;
  /// The scene's count of rejected poses at the time of the call.
  std::uint64_t poses_rejected = 0;
};

/// How to call a server, and how long to wait for it: `timeout_s`, or less if `stop` is set. `stop` must outlive the
/// call.
struct Patience {
  double timeout_s;
  const std::atomic<bool>& stop;
  /// Keys of this client; empty if the server asks for none.
  ClientKeys keys = {};
};

/// Asks the server at `control` (host:port) for a tool of a scene. If the scene lacks the tool, the error lists the
/// tools that it has.
Result<DiscoveredTool> discover_tool(const std::string& control, const std::string& scene, const std::string& tool,
                                     Patience patience);

/// Visible surface of all bodies of a scene at the time of the call.
struct Surface {
  /// float32 [vertex_count, 3] m; empty if the scene publishes no frames.
  std::string positions;
  /// The server's reason for an empty surface; may be empty.
  std::string absence;
};

/// Fetches the surface. Returns an empty one, not an error, if the scene publishes no frames.
Result<Surface> fetch_surface(const std::string& control, const std::string& scene, Patience patience);

/// Fetches the newest status of a scene.
Result<v1::SceneStatus> fetch_status(const std::string& control, const std::string& scene, Patience patience);

/// Turns a server's data endpoint (tcp://host:port or tcp/host:port) into one that a client can connect to. A wildcard
/// host (0.0.0.0, [::], *) becomes the host of `control` (host:port), where the client has reached the server. Returns
/// every other endpoint unchanged.
std::string reached_endpoint(const std::string& endpoint, const std::string& control);

/// A press that meets the nearest tissue.
struct Aim {
  /// The tool's origin at the first touch of its sphere.
  Eigen::Vector3d contact_m = Eigen::Vector3d::Zero();
  /// Unit vector from the tool to the tissue.
  Eigen::Vector3d direction = -Eigen::Vector3d::UnitZ();
};

/// Aims at the surface vertex nearest to the tool's sphere. Fails if the surface is empty or not finite, or if the
/// sphere's centre lies on the vertex, which gives no direction.
Result<Aim> aim_at_nearest_surface(const DiscoveredTool& tool, const Surface& surface);

/// Size of the tissue [m]: the diagonal of the surface's bounding box. Without a surface the size is estimated from the
/// tool's radius. Fails if the surface is not finite.
Result<double> extent_of(const Surface& surface, const DiscoveredTool& tool);

}  // namespace tensormass::haptic
