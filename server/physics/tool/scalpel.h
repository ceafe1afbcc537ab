#pragma once

#include <array>

#include "physics/tool/edge.h"

namespace tensormass::physics {

/// A blade with a straight edge. It touches tissue by points of its edge alone, which cut (contact/blades.h).
///
///        y ⊙──▶ x   cuts this way       the edge runs from the tip, at the origin of the shape's frame, along that
///        ·          ·                   frame's z axis. Its flat lies in the plane of x and z.
///        ▼ z
struct Scalpel {
  static constexpr std::string_view kName = "scalpel";
  static constexpr std::array<ToolParameter, 3> kParameters{
      {{"length_m", 1e-4, 1}, {"thickness_m", 1e-6, 0.01}, {"spacing_m", 1e-5, 1}}};
  static constexpr std::array<ToolParameter, 0> kJoints{};
  static constexpr bool kIsSolid = true;  // it has no core that pushes
  static constexpr std::uint32_t kCorePoints = 0;
  static constexpr std::uint32_t kContactPoints = 0;
  static constexpr std::uint32_t kEdges = 1;

  static double length_m(const ToolParameters& parameters) { return parameters[1] / 2; }
  static double reach_m(const ToolParameters& parameters) { return parameters[0]; }
  static std::uint32_t edge_points(const ToolParameters& parameters) { return points_of_edge(parameters); }

  /// Points are counted from the tip.
  template <class Real>
  TM_HOST_DEVICE static EdgePoint<Real> edge_point(const PlacedTool<Real>& tool, std::uint32_t, std::uint32_t i,
                                                   std::uint32_t last) {
    EdgePoint<Real> out;
    out.cuts = tool.axis(0);
    out.along = tool.axis(2);
    const Real spacing = tool.parameters[0] / static_cast<Real>(last);
    out.position = tool.position() + out.along * (spacing * static_cast<Real>(i));
    out.is_past = false;
    return out;
  }

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> joint_motion(const PlacedTool<Real>&, std::size_t, const Vec3<Real>&,
                                                const Vec3<Real>&) {
    return Vec3<Real>::Zero();
  }
  template <class Real>
  TM_HOST_DEVICE static Real middle_m(const PlacedTool<Real>&) {
    return 0;
  }
  template <class Real>
  TM_HOST_DEVICE static Real distance(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> away = from_edge(tool, x);
    return sqrt(away.dot(away)) - tool.radius_m;
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> gradient(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> away = from_edge(tool, x);
    const Real squared = away.dot(away);
    return squared > 0 ? Vec3<Real>(away * (1 / sqrt(squared))) : Vec3<Real>(Vec3<Real>::Zero());
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> from_edge(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    const Vec3<Real> from_tip = x - tool.position();
    const Real along = minimum(maximum(from_tip.dot(tool.axis(2)), Real(0)), tool.parameters[0]);
    return from_tip - tool.axis(2) * along;
  }
};

}  // namespace tensormass::physics
