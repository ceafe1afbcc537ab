#pragma once

#include <algorithm>
#include <array>
#include <cmath>

#include "physics/tool/solid.h"

namespace tensormass::physics {

/// A box about the origin of the shape's frame, with rounded edges.
///
///   h   half of its size without the rounded part;  r: radius of the edges
///   q   |x| − h, direction by direction: positive outside of the box h
///
///   φ = |max(q, 0)| + min(max_i q_i, 0) − r       exact outside, and inside up to the middle
struct BoxSolid : Solid<BoxSolid> {
  static constexpr std::string_view kName = "box";
  static constexpr std::array<ToolParameter, 4> kParameters{
      {{"size_x_m", 1e-6, 1e3}, {"size_y_m", 1e-6, 1e3}, {"size_z_m", 1e-6, 1e3}, {"edge_radius_m", 0, 1e3}}};

  static double length_m(const ToolParameters& p) { return std::min({p[0], p[1], p[2]}) / 2; }
  static double reach_m(const ToolParameters& p) { return std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) / 2; }

  template <class Real>
  TM_HOST_DEVICE static Real distance(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> q = beyond(tool, tool.to_shape(x - tool.position()));
    const Vec3<Real> outside(maximum(q[0], Real(0)), maximum(q[1], Real(0)), maximum(q[2], Real(0)));
    return sqrt(outside.dot(outside)) + minimum(maximum(q[0], maximum(q[1], q[2])), Real(0)) - tool.parameters[3];
  }
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> gradient(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    using std::sqrt;
    const Vec3<Real> at = tool.to_shape(x - tool.position()), q = beyond(tool, at);
    Vec3<Real> away = Vec3<Real>::Zero();
    for (int c = 0; c < 3; ++c) away[c] = maximum(q[c], Real(0));
    const Real squared = away.dot(away);
    if (squared > 0) {
      away *= 1 / sqrt(squared);
    } else {  // inside: to the nearest face
      const int nearest = q[0] >= q[1] ? (q[0] >= q[2] ? 0 : 2) : (q[1] >= q[2] ? 1 : 2);
      for (int c = 0; c < 3; ++c) away[c] = c == nearest ? Real(1) : Real(0);
    }
    for (int c = 0; c < 3; ++c) away[c] = at[c] < 0 ? -away[c] : away[c];
    return tool.to_scene(away);
  }

 private:
  /// Returns q for a point of the shape's frame.
  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> beyond(const PlacedTool<Real>& tool, const Vec3<Real>& at) {
    Vec3<Real> q;
    for (int c = 0; c < 3; ++c) {
      q[c] = (at[c] < 0 ? -at[c] : at[c]) - (tool.parameters[c] / 2 - tool.parameters[3]);
    }
    return q;
  }
};

}  // namespace tensormass::physics
