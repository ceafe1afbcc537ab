#pragma once

#include "core/scalar.h"

namespace tensormass::physics {

template <class Real>
TM_HOST_DEVICE Vec3<Real> cross(const Vec3<Real>& a, const Vec3<Real>& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

/// The part of a triangle that a point is closest to.
enum class TriangleFeature : std::uint8_t { kFace, kEdge01, kEdge12, kEdge20, kVertex0, kVertex1, kVertex2 };

template <class Real>
struct ClosestPoint {
  Vec3<Real> weights;  // barycentric coordinates
  TriangleFeature feature;
};

/// Returns the point of triangle abc closest to p (Ericson, Real-Time Collision Detection, 2005, section 5.1.5). For a
/// degenerate triangle it may be any of its vertices.
template <class Real>
TM_HOST_DEVICE ClosestPoint<Real> closest_point_on_triangle(const Vec3<Real>& p, const Vec3<Real>& a,
                                                            const Vec3<Real>& b, const Vec3<Real>& c) {
  const Vec3<Real> ab = b - a, ac = c - a, ap = p - a, bp = p - b, cp = p - c;
  const Real d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0 && d2 <= 0) return {{1, 0, 0}, TriangleFeature::kVertex0};
  const Real d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0 && d4 <= d3) return {{0, 1, 0}, TriangleFeature::kVertex1};
  const Real vc = d1 * d4 - d3 * d2;
  if (vc <= 0 && d1 >= 0 && d3 <= 0) {
    const Real t = d1 / (d1 - d3);
    return {{1 - t, t, 0}, TriangleFeature::kEdge01};
  }
  const Real d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0 && d5 <= d6) return {{0, 0, 1}, TriangleFeature::kVertex2};
  const Real vb = d5 * d2 - d1 * d6;
  if (vb <= 0 && d2 >= 0 && d6 <= 0) {
    const Real t = d2 / (d2 - d6);
    return {{1 - t, 0, t}, TriangleFeature::kEdge20};
  }
  const Real va = d3 * d6 - d5 * d4;
  if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
    const Real t = (d4 - d3) / ((d4 - d3) + (d5 - d6));
    return {{0, 1 - t, t}, TriangleFeature::kEdge12};
  }
  const Real sum = va + vb + vc;
  if (!(sum > 0)) return {{1, 0, 0}, TriangleFeature::kVertex0};
  return {{va / sum, vb / sum, vc / sum}, TriangleFeature::kFace};
}

/// Places on two segments: 0 at the first end, 1 at the second.
template <class Real>
struct SegmentPair {
  Real first, second;
};

/// Returns the points of the segments ab and cd that are closest to each other (Ericson, Real-Time Collision Detection,
/// 2005, section 5.1.9). Parallel segments have many such pairs; one of them is returned. A segment may have no length.
template <class Real>
TM_HOST_DEVICE SegmentPair<Real> closest_on_segments(const Vec3<Real>& a, const Vec3<Real>& b, const Vec3<Real>& c,
                                                     const Vec3<Real>& d) {
  const auto clamped = [](Real value) { return minimum(maximum(value, Real(0)), Real(1)); };
  const auto quotient = [](Real numerator, Real denominator) {
    return denominator > 0 ? numerator / denominator : Real(0);
  };
  const Vec3<Real> ab = b - a, cd = d - c, ca = a - c;
  const Real ab_ab = ab.dot(ab), cd_cd = cd.dot(cd), ab_cd = ab.dot(cd), ab_ca = ab.dot(ca), cd_ca = cd.dot(ca);
  Real first = clamped(quotient(ab_cd * cd_ca - ab_ca * cd_cd, ab_ab * cd_cd - ab_cd * ab_cd));
  const Real second = clamped(quotient(ab_cd * first + cd_ca, cd_cd));
  first = clamped(quotient(ab_cd * second - ab_ca, ab_ab));
  return {first, second};
}

/// The point in which a segment crosses a triangle.
template <class Real>
struct SegmentCrossing {
  bool crosses;
  Vec3<Real> weights;  // barycentric coordinates in the triangle
  Real fraction;       // place on the segment: 0 at p, 1 at q
};

/// Finds where the segment pq crosses the triangle abc (Möller, Trumbore 1997). A segment in the triangle's plane does
/// not cross it.
/// slack: the triangle is larger by this fraction, so that a segment through an edge does not slip between two
/// triangles.
template <class Real>
TM_HOST_DEVICE SegmentCrossing<Real> segment_crosses_triangle(const Vec3<Real>& p, const Vec3<Real>& q,
                                                              const Vec3<Real>& a, const Vec3<Real>& b,
                                                              const Vec3<Real>& c, Real slack = 0) {
  const Vec3<Real> pq = q - p, ab = b - a, ac = c - a, ap = p - a;
  const Vec3<Real> pq_ac = cross<Real>(pq, ac), ap_ab = cross<Real>(ap, ab);
  const Real determinant = ab.dot(pq_ac);
  const Real u = ap.dot(pq_ac) / determinant, v = pq.dot(ap_ab) / determinant, t = ac.dot(ap_ab) / determinant;
  const bool crosses = determinant != 0 && u >= -slack && v >= -slack && u + v <= 1 + slack && t >= 0 && t <= 1;
  return {crosses, {1 - u - v, u, v}, t};
}

}  // namespace tensormass::physics
