#pragma once

#include "core/scalar.h"

namespace tensormass::physics {

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

}  // namespace tensormass::physics
