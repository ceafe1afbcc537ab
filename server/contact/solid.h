#pragma once

#include <cmath>

#include "contact/touch.h"

/// A solid tool (physics/tool/solid.h) touches a triangle at four points: at the corners, and at the centroid. A
/// triangle that is large for the solid has the point nearest to the solid's middle instead.
///
///           b              a..c  corners, which are points 1 to 3
///          . .               4     centroid, or the point of the triangle that is nearest to the middle of the solid
///         . 4 .
///        a.....c             Each point carries a quarter of the area that the triangle turns to the solid,
///                            −n·n_t A, with its normal n_t and its area A at rest.
///
/// 1. A flat solid touches a triangle with its whole area. A single point, the deepest, would jump from corner to
///    corner while the triangle tilts, and the triangle would rock for ever. The corners carry a pressure that changes
///    linearly over the triangle exactly.
/// 2. On a large triangle point 4 finds what the corners miss: an edge or a tip of the solid between them. It moves
///    when the triangle tilts, so there tissue may rock.
/// 3. Contacts are decided where a step begins. A point that would fall more than a quarter of the solid's thickness in
///    the step could come out on its other side before any step has seen it inside. Such a point touches the face that
///    its way enters, across the gap.
/// 4. A side of the tissue that stands on a table touches it with its lower corners, but carries nothing. Therefore the
///    area towards the solid counts.
/// 5. The default penalty of a box or a mesh hardens with depth (hardened_solid). A stiffness that the scene gives does
///    not.
namespace tensormass::contact {

/// Legs of a triangle up to which its corners and its centroid suffice, in depths of the solid's middle.
inline constexpr double kSmallInMiddles = 1.5;
/// Depth at which the default contact of a box or a mesh is twice as stiff as at its surface, in thicknesses.
inline constexpr double kDoublesAt = 0.02;
/// The stiffest that the default contact of a solid becomes with depth: so many times the element behind it.
inline constexpr double kStiffest = 100;
/// A box or a mesh that keeps its forces is at least so many times as stiff as the element behind it. With 10 tissue
/// under an edge rocks; with 50 a block that a platen strikes bounces for ever.
inline constexpr double kKeptStiffness = 20;

/// Returns the direction in which a solid pushes tissue at a point: the gradient of its distance over a stencil of a
/// quarter of the way to its middle. Near a sharp edge the gradient itself jumps from one face to the other when the
/// point moves by a hair, and tissue under the edge would never come to rest.
template <class Kind, class Real>
TM_HOST_DEVICE Vec3<Real> way_out(const physics::PlacedTool<Real>& tool, const Vec3<Real>& x) {
  const Real reach = Kind::middle_m(tool) / 4;
  if (!(reach > 0)) return Kind::gradient(tool, x);
  Vec3<Real> slope = Vec3<Real>::Zero();
  for (int c = 0; c < 3; ++c) {
    const Vec3<Real> axis = tool.axis(c), aside = axis * reach;
    slope += axis * (Kind::distance(tool, Vec3<Real>(x + aside)) - Kind::distance(tool, Vec3<Real>(x - aside)));
  }
  const Real squared = slope.dot(slope);
  return squared > 0 ? unit<Real>(slope) : Kind::gradient(tool, x);
}

/// Returns the point of a triangle that is nearest to the middle of a solid, found by steepest descent from the
/// centroid. Flat on flat it is the centroid.
template <class Kind, class Real>
TM_HOST_DEVICE Vec3<Real> nearest_to_middle(const physics::PlacedTool<Real>& tool, const Corners<Real>& corners) {
  constexpr int kDescents = 8;
  const Vec3<Real> centroid = Vec3<Real>::Constant(Real(1) / 3);
  Vec3<Real> weights = centroid, best = centroid;
  Real distance = Kind::distance(tool, corners.at(centroid)), least = distance;
  for (int i = 0; i < kDescents; ++i) {
    const Vec3<Real> x = corners.at(weights);
    const Vec3<Real> way = Kind::gradient(tool, x) * (distance + Kind::middle_m(tool));
    weights = physics::closest_point_on_triangle<Real>(x - way, corners.x[0], corners.x[1], corners.x[2]).weights;
    distance = Kind::distance(tool, corners.at(weights));
    if (!(distance < least)) continue;
    least = distance;
    best = weights;
  }
  return best;
}

/// Returns how a point that is outside a solid touches the face through which it falls into it.
///
///   x, way    the point, and how it moves to the end of the step if nothing touches it [m]
///   facing    unit normal of its triangle
template <class Kind, class Real>
TM_HOST_DEVICE Touch<Real> entered_face(const physics::PlacedTool<Real>& tool, const Vec3<Real>& x,
                                        const Vec3<Real>& way, const Vec3<Real>& facing) {
  using std::sqrt;
  constexpr int kSteps = 16;
  Touch<Real> touch;
  const Real middle = Kind::middle_m(tool), length = sqrt(way.dot(way));
  if (!(middle > 0 && length > middle / 2)) return touch;  // nothing passes through a plane
  Real along = 0;                                          // a distance changes by at most the way
  for (int i = 0; i < kSteps; ++i) {
    const Real distance = Kind::distance(tool, Vec3<Real>(x + way * (along / length)));
    if (!(distance > middle / 64)) break;
    along += distance;
    if (along > length) return touch;
  }
  const Vec3<Real> entry = x + way * (along / length);
  touch.normal = way_out<Kind>(tool, entry);
  touch.share = -touch.normal.dot(facing) / Kind::kContactPoints;
  touch.depth_m = touch.normal.dot(entry - x);
  return touch;
}

/// Returns where a box or a mesh touches with the pressure k p(depth) in place of k depth, as its tangent: k is p'
/// times as large, and the depth is that at which a spring of this k has the pressure.
///
///   p = depth + depth² / (2 d0)     d0 = kDoublesAt of the thickness: there the slope is 2
///
/// Tissue under an edge carries several times the pressure that it carries elsewhere, the more the finer the mesh is.
/// With a constant k it would come to the middle of the solid and out on the other side. From the slope `steepest` on p
/// is continued by its tangent.
///
///   steepest   largest slope, at least 1
template <class Kind, class Real>
TM_HOST_DEVICE Touch<Real> hardened_solid(Touch<Real> touch, const physics::PlacedTool<Real>& tool, Real steepest) {
  const Real depth = touch.depth_m, middle = Kind::middle_m(tool);
  if (!(depth > 0 && middle > 0)) return touch;
  const Real doubles_at = Real(kDoublesAt) * 2 * middle;
  const Real begun = minimum(depth, doubles_at * (steepest - 1));  // the part of the depth over which p hardens
  const Real slope = 1 + begun / doubles_at;
  const Real pressure = depth + begun * begun / (2 * doubles_at) + (slope - 1) * (depth - begun);
  touch.depth_m = pressure / slope;
  touch.share *= slope;
  return touch;
}

/// Visits the contact points of a solid on a triangle.
///
///   ahead                 how the corners move to the end of the step if nothing touches them [m]
///   area                  the triangle's, at rest [m²]
///   remembered(point)     what a contact with all of the triangle's area remembers
///   visit(point, touch)   is called once for each of them, in order; touch.depth_m is positive where it touches. Where
///                         it has pressed, it may be negative; touch.normal is zero where nothing acts
template <class Kind, class Real, class Last, class Visit>
TM_HOST_DEVICE void for_each_touch_of_solid(const physics::PlacedTool<Real>& tool, const Corners<Real>& corners,
                                            const Corners<Real>& ahead, Real area, const Last& remembered,
                                            const Visit& visit) {
  using std::sqrt;
  static_assert(Kind::kContactPoints == 4);
  const Vec3<Real> centroid = corners.at(Vec3<Real>::Constant(Real(1) / 3));
  Real size_squared = 0;
  for (const Vec3<Real>& x : corners.x) size_squared = maximum(size_squared, (x - centroid).dot(x - centroid));
  Real way_squared = 0;
  for (const Vec3<Real>& way : ahead.x) way_squared = maximum(way_squared, way.dot(way));
  // A distance changes by at most the way.
  const bool far = Kind::distance(tool, centroid) > sqrt(size_squared) + sqrt(way_squared);
  const Vec3<Real> facing = far ? Vec3<Real>(Vec3<Real>::Zero()) : unit<Real>(corners.normal());
  const auto touch_at = [&](std::uint32_t point, const Vec3<Real>& weights) {
    Touch<Real> touch;
    if (far) return touch;
    const Vec3<Real> x = corners.at(weights);
    const Real depth = -Kind::distance(tool, x);
    const Remembered<Real> last = remembered(point);
    if (!(depth > 0 || last.pressed_n > 0)) {
      touch = entered_face<Kind>(tool, x, ahead.at(weights), facing);
      touch.weights = weights;
      return touch;
    }
    touch.normal = way_out<Kind>(tool, x);
    touch.share = -touch.normal.dot(facing) / Kind::kContactPoints;
    if (!(touch.share > 0)) return touch;
    touch.depth_m = depth + last.depth_m / touch.share;
    touch.weights = weights;
    return touch;
  };
  for (int c = 0; c < 3; ++c) {
    Vec3<Real> corner = Vec3<Real>::Zero();
    corner[c] = 1;
    const auto point = static_cast<std::uint32_t>(c);
    visit(point, touch_at(point, corner));
  }
  if (far) return visit(std::uint32_t{3}, Touch<Real>{});
  const Real middle = Kind::middle_m(tool);
  const bool small = middle == 0 || sqrt(2 * area) <= Real(kSmallInMiddles) * middle;
  visit(std::uint32_t{3},
        touch_at(3, small ? Vec3<Real>(Vec3<Real>::Constant(Real(1) / 3)) : nearest_to_middle<Kind>(tool, corners)));
}

}  // namespace tensormass::contact
