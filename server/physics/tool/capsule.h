#pragma once

#include <array>

#include "physics/contact/closest_point.h"
#include "physics/tool/tool.h"

namespace tensormass::physics {

/// A cylinder with round ends: the shaft of an instrument. Its core is a segment from the tip, at the origin of the
/// shape's frame, along that frame's z axis.
struct Capsule : ThinCore<Capsule> {
  static constexpr std::string_view kName = "capsule";
  static constexpr std::array<ToolParameter, 1> kParameters{{{"length_m", 1e-6, 1e3}}};  // between the ends' centres
  static constexpr std::size_t kJoints = 0;
  static constexpr std::uint32_t kCorePoints = 2;

  template <class Real>
  TM_HOST_DEVICE static Vec3<Real> core_point(const PlacedTool<Real>& tool, std::uint32_t i) {
    return at(tool, static_cast<Real>(i)).position;
  }
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> closest_core_point(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    const Real along = (x - tool.position()).dot(tool.axis(2)) / tool.parameters[0];
    return at(tool, minimum(maximum(along, Real(0)), Real(1)));
  }
  /// The least distance between a triangle and a segment is at an end of the segment, at an edge of the triangle, or
  /// where the segment crosses the triangle (Ericson, Real-Time Collision Detection, 2005, section 5.1.10). Where the
  /// segment crosses it with one end inside the tissue, contact takes the end, which is deeper.
  template <class Real, class Visit>
  TM_HOST_DEVICE static void for_each_candidate(const PlacedTool<Real>& tool, const Vec3<Real>& a, const Vec3<Real>& b,
                                                const Vec3<Real>& c, const Visit& visit) {
    const CorePoint<Real> tip = at(tool, Real(0)), end = at(tool, Real(1));
    visit(closest_point_on_triangle(tip.position, a, b, c).weights, tip);
    visit(closest_point_on_triangle(end.position, a, b, c).weights, end);
    const SegmentPair<Real> ab = closest_on_segments(a, b, tip.position, end.position);
    visit(Vec3<Real>(1 - ab.first, ab.first, 0), at(tool, ab.second));
    const SegmentPair<Real> bc = closest_on_segments(b, c, tip.position, end.position);
    visit(Vec3<Real>(0, 1 - bc.first, bc.first), at(tool, bc.second));
    const SegmentPair<Real> ca = closest_on_segments(c, a, tip.position, end.position);
    visit(Vec3<Real>(ca.first, 0, 1 - ca.first), at(tool, ca.second));
    const SegmentCrossing<Real> crossing = segment_crosses_triangle(tip.position, end.position, a, b, c);
    if (crossing.crosses) visit(crossing.weights, at(tool, crossing.fraction));
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> at(const PlacedTool<Real>& tool, Real place) {
    return {tool.position() + tool.axis(2) * (tool.parameters[0] * place), place};
  }
};

}  // namespace tensormass::physics
