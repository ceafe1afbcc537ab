#pragma once

#include "physics/tool/tool.h"

namespace tensormass::physics {

/// What all solids have in common. A solid states its signed distance and the gradient of that; see
/// physics/tool/tool.h.
///
/// A solid needs no core: its signed distance says for each point of the tissue how deep it is inside, and which way
/// leads out. Contact takes it at several points of each triangle (contact/solid.h), because a flat solid touches a
/// triangle with its whole area.
template <class Kind>
struct Solid {
  static constexpr bool kIsSolid = true;
  static constexpr std::uint32_t kCorePoints = 0;
  static constexpr std::uint32_t kContactPoints = 4;
  static constexpr std::array<ToolParameter, 0> kJoints{};

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> joint_motion(const PlacedTool<Real>&, std::size_t, const Vec3<Real>&,
                                                const Vec3<Real>&) {
    return Vec3<Real>::Zero();
  }
  template <class Real>
  TM_HOST_DEVICE static Real middle_m(const PlacedTool<Real>& tool) {
    return tool.radius_m;
  }
};

}  // namespace tensormass::physics
