#pragma once

#include <cmath>

#include "contact/solid.h"
#include "contact/surface.h"
#include "physics/tool/tool.h"

/// A straight piece of a thin tool's core that lies along a triangle touches it along a line.
///
///        a ───────────── b     core, projected on the triangle
///     ___↓_______________↓___
///       D                 d    depths at the ends of that line, D ≥ d
///
/// The deepest point alone jumps from one end to the other by a hair of tilt: the load then has no place at which the
/// triangle could rest, and it rocks for ever. The contact therefore lies at a mean of both ends whose weights change
/// continuously, where their depths differ by less than kLineWidth:
///
///   depth   M = D φ(r),  r = d / D
///   force   k M ∇M: at end a with the weight φ − r φ', at end b with φ'
///   φ' = c t,  t = max(0, (r − 1 + w) / w),  c = 1/2 / (1 − w/4),  w = kLineWidth
///
/// 1. M is convex, so its second derivative is positive: k M φ'' / D (n·d_b − r n·d_a)², with the motions d of the
///    ends. It resists tilt, and the system contains it (LineTilt).
/// 2. At r = 1 both ends have the same weight, and M is larger than D: a core that lies flat on a triangle is 11 %
///    stiffer than one that touches it with its tip. No convex function has M = D both there and where d = 0.
/// 3. Elsewhere M = D, so a tip touches as a sphere does.
/// 4. A step that is linearized once has the stiffness of r = 1 already from r > 1 − kLineAhead on, without a force.
///    Otherwise it would step over the equilibrium, back again, and so on. Newton's iterations do not need that.
namespace tensormass::contact {

inline constexpr double kLineWidth = 0.2, kLineAhead = 0.5;
static_assert(kLineWidth <= kLineAhead);

/// Places on a segment: 0 at its first end, 1 at its last; first > last: none.
template <class Real>
struct Part {
  Real first, last;
};

/// The part of a segment from p to q whose projection along its normal lies in a triangle. Barycentric coordinates of
/// the projection are linear along the segment.
template <class Real>
struct Shadow {
  Part<Real> part{1, 0};
  Vec3<Real> start = Vec3<Real>::Zero(), slope = Vec3<Real>::Zero();  // weights at a place: start + slope · place
};

template <class Real>
TM_HOST_DEVICE Shadow<Real> shadow_on(const Corners<Real>& corners, const Vec3<Real>& p, const Vec3<Real>& q) {
  Shadow<Real> out;
  const Vec3<Real> normal = corners.normal();
  const Real squared = normal.dot(normal);
  if (!(squared > 0)) return out;
  const auto weights_at = [&](const Vec3<Real>& x) {
    Vec3<Real> weights;
    for (int c = 0; c < 3; ++c) {
      const Vec3<Real>& from = corners.x[(c + 1) % 3];
      weights[c] = normal.dot(physics::cross<Real>(corners.x[(c + 2) % 3] - from, x - from)) / squared;
    }
    return weights;
  };
  out.start = weights_at(p);
  out.slope = weights_at(q) - out.start;
  Real first = 0, last = 1;
  for (int c = 0; c < 3; ++c) {
    if (out.slope[c] > 0) {
      first = maximum(first, Real(-out.start[c] / out.slope[c]));
    } else if (out.slope[c] < 0) {
      last = minimum(last, Real(-out.start[c] / out.slope[c]));
    } else if (out.start[c] < 0) {
      return out;
    }
  }
  out.part = {first, last};
  return out;
}

/// Returns a contact at the deepest point of a triangle, moved along the line in which the core touches it.
///
///   deepest   the deepest point, not behind the surface
///   place     that of its point of the core
///   kept_m    depth by which the contact counts as deeper than it is
///   ahead     kLineAhead, or kLineWidth in Newton's iterations
template <class Kind, class Real>
TM_HOST_DEVICE Touch<Real> along_line(const physics::PlacedTool<Real>& tool, const Corners<Real>& corners,
                                      const Touch<Real>& deepest, Real place, Real kept_m, Real ahead) {
  using std::sqrt;
  std::uint32_t piece = 0;
  while (piece + 2 < Kind::kCorePoints && place > static_cast<Real>(piece + 1)) ++piece;
  const Vec3<Real> p = Kind::core_point(tool, piece), q = Kind::core_point(tool, piece + 1);
  const Shadow<Real> shadow = shadow_on(corners, p, q);
  if (!(shadow.part.first < shadow.part.last)) return deepest;
  // The end that is farther from the deepest point.
  const Real own = place - static_cast<Real>(piece);
  const bool first = own - shadow.part.first > shadow.part.last - own;
  const Real at = first ? shadow.part.first : shadow.part.last;
  Vec3<Real> weights = shadow.start + shadow.slope * at;
  for (int c = 0; c < 3; ++c) weights[c] = maximum(weights[c], Real(0));
  weights /= weights[0] + weights[1] + weights[2];
  const Vec3<Real> away = corners.at(weights) - (p + (q - p) * at);
  const Real distance = sqrt(away.dot(away)), depth = tool.radius_m - distance + kept_m;
  const Real r = minimum(depth / deepest.depth_m, Real(1)), width = Real(kLineWidth);
  const Real t = maximum(Real((r - 1 + width) / width), Real(0));
  if (!(r > 1 - ahead && distance > Real(1e-6) * tool.radius_m)) return deepest;
  const Real curvature = Real(0.5) / (1 - width / 4);
  const Real of_b = curvature * t, phi = 1 + curvature * width * t * t / 2, of_a = phi - r * of_b, sum = of_a + of_b;
  Touch<Real> out = deepest;
  out.weights = (deepest.weights * of_a + weights * of_b) / sum;
  out.normal = unit<Real>(deepest.normal * of_a + away * (of_b / distance));
  out.lever_m = (deepest.lever_m * of_a + distance * of_b) / sum;
  out.depth_m = (deepest.depth_m - kept_m) * phi / sum + kept_m / (sum * sum);  // a kept force stays what it is
  out.share = deepest.share * sum * sum;
  out.line = weights - deepest.weights * r;
  out.line_share = deepest.share * phi * curvature / width;
  return out;
}

/// How the force of a contact along a line follows its triangle when that tilts along the line.
///
///   y     Σ l_a (n·d_a), motion that shifts the load to the other end [m];  l_a: view::TriangleContact::line
template <class Real>
class LineTilt {
 public:
  TM_HOST_DEVICE explicit LineTilt(const view::TriangleContact<Real>& touch)
      : touch_(touch), normal_(touch.normal[0], touch.normal[1], touch.normal[2]) {}

  /// Returns y for a motion of the corners.
  TM_HOST_DEVICE Real of(const Corners<Real>& motion) const {
    Real sum = 0;
    for (int c = 0; c < 3; ++c) sum += touch_.line[c] * normal_.dot(motion.x[c]);
    return sum;
  }
  /// Returns the force on a corner of the triangle, for a value of `of` [N].
  TM_HOST_DEVICE Vec3<Real> force(int corner, Real tilt) const {
    return normal_ * (-touch_.line_stiffness * touch_.line[corner] * tilt);
  }
  /// Returns the stiffness between two corners [N/m].
  TM_HOST_DEVICE Mat3<Real> block(int a, int b) const {
    return normal_ * normal_.transpose() * (touch_.line_stiffness * touch_.line[a] * touch_.line[b]);
  }

 private:
  const view::TriangleContact<Real>& touch_;
  Vec3<Real> normal_;
};

}  // namespace tensormass::contact
