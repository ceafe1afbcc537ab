#pragma once

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
  /// float32 [vertex_count, 3] m, all bodies.
  std::string surface_positions;
};

/// Asks the server at `control` (host:port) for a tool of a scene. Waits up to `timeout_s` for it to answer. Errors
/// name the server, scene or tool that was not found, and for a tool those that the scene has.
Result<DiscoveredTool> discover_tool(const std::string& control, const std::string& scene, const std::string& tool,
                                     double timeout_s);

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
  /// Diagonal of the surface's bounding box: a scale for a press.
  double extent_m = 0.0;
};

/// At the surface vertex nearest to the tool's sphere. Refuses a scene without a surface, and a tool so close that it
/// has no direction.
Result<Aim> aim_at_nearest_surface(const DiscoveredTool& tool);

}  // namespace tensormass::haptic
