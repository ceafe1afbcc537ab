#pragma once

#include <atomic>
#include <cstdint>
#include <string>
#include <string_view>

#include <Eigen/Core>

#include "core/result.h"
#include "haptic/link.h"
#include "tensormass/v1/control.pb.h"

namespace tensormass::haptic {

/// What a haptic client needs to know of a running scene before it starts.
struct DiscoveredTool {
  v1::GetVersionResponse server;
  LinkAddress address;
  /// Where the tool stands.
  Eigen::Vector3d tool_position_m = Eigen::Vector3d::Zero();
  double radius_m = 0.0;
  /// From the tool's origin to the sphere's centre.
  Eigen::Vector3d tip_offset_m = Eigen::Vector3d::Zero();
  /// The scene's count, as it was then.
  std::uint64_t poses_rejected = 0;
};

/// How long a server is waited for: until the time is up or `stop` is set, which fails with kCancelled.
struct Patience {
  double timeout_s;
  const std::atomic<bool>& stop;
};

/// Asks the server at `control` (host:port) for a tool of a scene. Errors name the server, scene or tool that was not
/// found, and for a tool those that the scene has.
Result<DiscoveredTool> discover_tool(const std::string& control, const std::string& scene, const std::string& tool,
                                     Patience patience);

/// What of a scene can be pressed: the visible surface of all bodies, where it is now.
struct Surface {
  /// float32 [vertex_count, 3] m; empty if the scene has none.
  std::string positions;
  /// Why it has none, in the server's words; may be empty.
  std::string absence;
};

/// A scene that publishes no frames has no surface; that is no error.
Result<Surface> fetch_surface(const std::string& control, const std::string& scene, Patience patience);

Result<v1::SceneStatus> fetch_status(const std::string& control, const std::string& scene, Patience patience);

/// A data endpoint (tcp://host:port, tcp/host:port) as a client connects to it that reached the server at `control`
/// (host:port). A server that listens on every interface (0.0.0.0, [::], *) does not know which of them leads to the
/// client: it is reached where its control plane was. Every other endpoint stays as it is.
std::string reached_endpoint(const std::string& endpoint, const std::string& control);

/// Where and how to press so that the nearest tissue is hit.
struct Aim {
  /// The tool's origin when its sphere first touches.
  Eigen::Vector3d contact_m = Eigen::Vector3d::Zero();
  /// Unit vector from the tool to the tissue.
  Eigen::Vector3d direction = -Eigen::Vector3d::UnitZ();
};

/// At the surface vertex nearest to the tool's sphere. Refuses a scene without a surface, and a tool so close that it
/// has no direction.
Result<Aim> aim_at_nearest_surface(const DiscoveredTool& tool, const Surface& surface);

/// A scale for a press: the diagonal of the surface's bounding box. Without a surface it follows from the tool, which
/// is made for tissue of some size.
Result<double> extent_of(const Surface& surface, const DiscoveredTool& tool);

}  // namespace tensormass::haptic
