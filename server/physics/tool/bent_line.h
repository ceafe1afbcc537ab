#pragma once

#include "physics/contact/closest_point.h"
#include "physics/tool/tool.h"

namespace tensormass::physics {

/// A core of straight segments: the line through the core points of a kind, in their order. A kind states only
/// kCorePoints and core_point(tool, i).
template <class Kind>
struct BentLine : ThinCore<Kind> {
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> closest_core_point(const PlacedTool<Real>& tool, const Vec3<Real>& x) {
    CorePoint<Real> closest = at(tool, 0, Real(0));
    Real least = squared<Real>(x - closest.position);
    for (std::uint32_t i = 0; i + 1 < Kind::kCorePoints; ++i) {
      const Vec3<Real> start = Kind::core_point(tool, i), way = Kind::core_point(tool, i + 1) - start;
      const Real length = squared<Real>(way), along = length > 0 ? (x - start).dot(way) / length : Real(0);
      const CorePoint<Real> candidate = at(tool, i, minimum(maximum(along, Real(0)), Real(1)));
      const Real distance = squared<Real>(x - candidate.position);
      if (!(distance < least)) continue;
      least = distance;
      closest = candidate;
    }
    return closest;
  }

  /// The least distance between a triangle and a segment is at an end of the segment, at an edge of the triangle, or
  /// where the segment crosses the triangle (Ericson, Real-Time Collision Detection, 2005, section 5.1.10). Where the
  /// segment crosses it with one end inside the tissue, contact takes the end, which is deeper.
  template <class Real, class Visit>
  TM_HOST_DEVICE static void for_each_candidate(const PlacedTool<Real>& tool, const Vec3<Real>& a, const Vec3<Real>& b,
                                                const Vec3<Real>& c, const Visit& visit) {
    for (std::uint32_t i = 0; i < Kind::kCorePoints; ++i) {
      const CorePoint<Real> point{Kind::core_point(tool, i), static_cast<Real>(i)};
      visit(closest_point_on_triangle(point.position, a, b, c).weights, point);
    }
    for (std::uint32_t i = 0; i + 1 < Kind::kCorePoints; ++i) {
      const Vec3<Real> start = Kind::core_point(tool, i), end = Kind::core_point(tool, i + 1);
      const SegmentPair<Real> ab = closest_on_segments(a, b, start, end);
      visit(Vec3<Real>(1 - ab.first, ab.first, 0), at(tool, i, ab.second));
      const SegmentPair<Real> bc = closest_on_segments(b, c, start, end);
      visit(Vec3<Real>(0, 1 - bc.first, bc.first), at(tool, i, bc.second));
      const SegmentPair<Real> ca = closest_on_segments(c, a, start, end);
      visit(Vec3<Real>(ca.first, 0, 1 - ca.first), at(tool, i, ca.second));
      const SegmentCrossing<Real> crossing = segment_crosses_triangle(start, end, a, b, c);
      if (crossing.crosses) visit(crossing.weights, at(tool, i, crossing.fraction));
    }
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static Real squared(const Vec3<Real>& v) {
    return v.dot(v);
  }
  /// Returns the point at a fraction of the way from core point i to the next.
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> at(const PlacedTool<Real>& tool, std::uint32_t i, Real fraction) {
    const Vec3<Real> start = Kind::core_point(tool, i), end = Kind::core_point(tool, i + 1);
    return {start + (end - start) * fraction, static_cast<Real>(i) + fraction};
  }
};

}  // namespace tensormass::physics
