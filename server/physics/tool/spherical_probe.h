#pragma once

#include <array>

#include "physics/contact/closest_point.h"
#include "physics/tool/tool.h"

namespace tensormass::physics {

/// A sphere about the origin of the shape's frame.
struct SphericalProbe : ThinCore<SphericalProbe> {
  static constexpr std::string_view kName = "spherical_probe";
  static constexpr std::array<ToolParameter, 0> kParameters{};
  static constexpr std::uint32_t kCorePoints = 1;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t) {
    return tool.position();
  }
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> closest_core_point(const PlacedTool<Real>& tool, const Vec3<Real>&) {
    return {tool.position(), 0};
  }
  template <class Real, class Visit>
  TM_HOST_DEVICE static void for_each_candidate(const PlacedTool<Real>& tool, const Vec3<Real>& a, const Vec3<Real>& b,
                                                const Vec3<Real>& c, const Visit& visit) {
    visit(closest_point_on_triangle(tool.position(), a, b, c).weights, CorePoint<Real>{tool.position(), 0});
  }
};

}  // namespace tensormass::physics
