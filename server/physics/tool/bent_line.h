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
    Vec3<Real> end = Kind::core_point(tool, 0);
    CorePoint<Real> closest{end, 0};
    Real least = squared<Real>(x - end);
    for (std::uint32_t i = 0; i + 1 < Kind::kCorePoints; ++i) {
      const Vec3<Real> start = end;
      end = Kind::core_point(tool, i + 1);
      const Vec3<Real> way = end - start;
      const Real length = squared<Real>(way), along = length > 0 ? (x - start).dot(way) / length : Real(0);
      const CorePoint<Real> candidate = between(start, end, i, minimum(maximum(along, Real(0)), Real(1)));
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
    Vec3<Real> end = Kind::core_point(tool, 0);
    visit(closest_point_on_triangle(end, a, b, c).weights, CorePoint<Real>{end, Real(0)});
    for (std::uint32_t i = 0; i + 1 < Kind::kCorePoints; ++i) {
      const Vec3<Real> start = end;
      end = Kind::core_point(tool, i + 1);
      const auto at = [&](Real fraction) { return between(start, end, i, fraction); };
      visit(closest_point_on_triangle(end, a, b, c).weights, at(Real(1)));
      const SegmentPair<Real> ab = closest_on_segments(a, b, start, end);
      visit(Vec3<Real>(1 - ab.first, ab.first, 0), at(ab.second));
      const SegmentPair<Real> bc = closest_on_segments(b, c, start, end);
      visit(Vec3<Real>(0, 1 - bc.first, bc.first), at(bc.second));
      const SegmentPair<Real> ca = closest_on_segments(c, a, start, end);
      visit(Vec3<Real>(ca.first, 0, 1 - ca.first), at(ca.second));
      const SegmentCrossing<Real> crossing = segment_crosses_triangle(start, end, a, b, c);
      if (crossing.crosses) visit(crossing.weights, at(crossing.fraction));
    }
  }

 private:
  template <class Real>
  TM_HOST_DEVICE static Real squared(const Vec3<Real>& v) {
    return v.dot(v);
  }
  /// Returns the point at a fraction of the way from core point i, `start`, to the next.
  template <class Real>
  TM_HOST_DEVICE static CorePoint<Real> between(const Vec3<Real>& start, const Vec3<Real>& end, std::uint32_t i,
                                                Real fraction) {
    return {start + (end - start) * fraction, static_cast<Real>(i) + fraction};
  }
};

}  // namespace tensormass::physics
