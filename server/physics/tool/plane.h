#pragma once

#include <array>

#include "physics/tool/solid.h"

namespace tensormass::physics {

/// A half-space: all points below the plane through the origin of the shape's frame, across that frame's z axis.
struct Plane : Solid<Plane> {
  static constexpr std::string_view kName = "plane";
  static constexpr std::array<ToolParameter, 0> kParameters{};

  /// A plane has no thickness. The reader takes a tenth of the scene's size.
  static double length_m(const ToolParameters&) { return 0; }
  /// A plane that turns moves infinitely fast far away, so its speed is that of its origin.
  static double reach_m(const ToolParameters&) { return 0; }

  template <class Real>
  TM_HOST_DEVICE static Real middle_m(const PlacedTool<Real>&) {
    return 0;
  }
  template <class Real>
  TM_HOST_DEVICE static Real distance(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    return tool.axis(2).dot(x - tool.position());
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> gradient(const PlacedTool<Real>& tool, const Vec3<Real>&) {
    return tool.axis(2);
  }
};

}  // namespace tensormass::physics
