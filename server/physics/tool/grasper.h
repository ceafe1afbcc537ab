#pragma once

#include <array>
#include <cmath>

#include "physics/tool/bent_line.h"

namespace tensormass::physics {

/// Two straight jaws that open about a hinge.
///
///         1          0, 2   tips; both at the origin of the shape's frame while the jaws are closed
///        / \         1      hinge, at (0, 0, jaw_length_m)
///    z  / θ \        θ      joint opening_rad: angle between the jaws, half of it on each side of the z axis
///    ↑ 0     2
///    └→x
struct Grasper : BentLine<Grasper> {
  static constexpr std::string_view kName = "grasper";
  static constexpr std::array<ToolParameter, 1> kParameters{{{"jaw_length_m", 1e-6, 1e3}}};
  static constexpr std::array<ToolParameter, 1> kJoints{{{"opening_rad", 0, 2.5}}};
  static constexpr std::uint32_t kCorePoints = 3;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t i) {
    using std::cos;
    using std::sin;
    if (i == 1) return hinge(tool);
    const Real half = tool.joint_values[0] / 2, aside = i == 0 ? -sin(half) : sin(half);
    return hinge(tool) + (tool.axis(0) * aside - tool.axis(2) * cos(half)) * tool.parameters[0];
  }

  /// The jaws turn about the y axis through the hinge, one against the other.
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> joint_motion(const PlacedTool<Real>& tool, std::size_t, const Vec3<Real>& core,
                                                const Vec3<Real>& x) {
    const bool first = tool.axis(0).dot(core - hinge(tool)) < 0;
    return cross<Real>(tool.axis(1), x - hinge(tool)) * Real(first ? 0.5 : -0.5);
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> hinge(const PlacedTool<Real>& tool) {
    return tool.position() + tool.axis(2) * tool.parameters[0];
  }
};

}  // namespace tensormass::physics
