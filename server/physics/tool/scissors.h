#pragma once

#include <array>
#include <cmath>

#include "physics/tool/bent_line.h"
#include "physics/tool/edge.h"

namespace tensormass::physics {

/// Two straight edges that turn about a pivot. They touch tissue by points of their edges alone, which cut
/// (contact/blades.h). Shut, they have a core along both blades, by which they dissect (contact/severing.h).
///
///         P          P      pivot, at (0, 0, L) in the shape's frame; L: blade_length_m
///        /θ\         e, c   along an edge from the pivot, and where it cuts: towards the other edge
///    z  X   X        θ      joint opening_rad, half of it on each side of the z axis
///    ↑ e↙ c ↘e       d      edge_offset_m: point r of an edge is at P + r e + d c
///    └→x
///
/// Both lines pass the pivot on its far side, so they cross at s = d / sin(θ/2) from it, and at r = d cot(θ/2) along
/// each. Edges have passed each other up to there; beyond, they cut. Closing moves the crossing to the tips.
struct Scissors : BentLine<Scissors> {
  static constexpr std::string_view kName = "scissors";
  static constexpr std::array<ToolParameter, 4> kParameters{
      {{"blade_length_m", 1e-4, 1}, {"thickness_m", 1e-6, 0.01}, {"spacing_m", 1e-5, 1}, {"edge_offset_m", 1e-5, 0.5}}};
  static constexpr std::array<ToolParameter, 1> kJoints{{{"opening_rad", 0, 2.5}}};
  static constexpr std::uint32_t kCorePoints = 3;
  static constexpr std::uint32_t kContactPoints = 0;
  static constexpr std::uint32_t kEdges = 2;

  static std::uint32_t edge_points(const ToolParameters& parameters) { return points_of_edge(parameters); }

  /// Edge 0 is on the side of −x. Points are counted from the pivot.
  template <class Real>
  TM_HOST_DEVICE static EdgePoint<Real> edge_point(const PlacedTool<Real>& tool, std::uint32_t edge, std::uint32_t i,
                                                   std::uint32_t last) {
    using std::cos;
    using std::sin;
    const Real side = edge == 0 ? Real(-1) : Real(1), half = tool.joint_values[0] / 2;
    const Real sine = sin(half), cosine = cos(half);
    const Real r = tool.parameters[0] / static_cast<Real>(last) * static_cast<Real>(i), offset = tool.parameters[3];
    EdgePoint<Real> out;
    out.along = tool.axis(0) * (side * sine) - tool.axis(2) * cosine;
    out.cuts = tool.axis(0) * (-side * cosine) - tool.axis(2) * sine;
    out.position = pivot(tool) + out.along * r + out.cuts * offset;
    out.is_past = !(r * sine > offset * cosine);
    return out;
  }

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t i) {
    using std::cos;
    using std::sin;
    if (i == 1) return pivot(tool);
    const Real half = tool.joint_values[0] / 2, aside = i == 0 ? -sin(half) : sin(half);
    return pivot(tool) + (tool.axis(0) * aside - tool.axis(2) * cos(half)) * tool.parameters[0];
  }

  /// Blades turn about the y axis through the pivot, one against the other.
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> joint_motion(const PlacedTool<Real>& tool, std::size_t, const Vec3<Real>& core,
                                                const Vec3<Real>& x) {
    return motion_of_edge(tool, tool.axis(0).dot(core - pivot(tool)) < 0 ? 0 : 1, x);
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> motion_of_edge(const PlacedTool<Real>& tool, std::uint32_t edge,
                                                  const Vec3<Real>& x) {
    return cross<Real>(tool.axis(1), x - pivot(tool)) * Real(edge == 0 ? 0.5 : -0.5);
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> pivot(const PlacedTool<Real>& tool) {
    return tool.position() + tool.axis(2) * tool.parameters[0];
  }
};

}  // namespace tensormass::physics
