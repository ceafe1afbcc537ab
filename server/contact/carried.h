#pragma once

#include <cmath>

#include "contact/solid.h"
#include "contact/surface.h"
#include "physics/tool/tool.h"

/// Faces of cuts against tools. Elements carry them (view::CarriedView): their corners are points of one element.
///
///        tool
///          __          A, B   the two faces of a cut. Each triangle of A has its twin in B: the same triangle of the
///         /  \                mesh at rest, seen from the other side
///         \__/         gap    distance of the centroids of twins
///     ─────╮  ╭─────   w      width from which a tool sees that a cut is open
///        A │  │ B
///          ╰╮╭╯ gap           openness = 0 up to w / 2, 1 from w on, linear in between
///           ╰╯
///
/// 1. A closed cut is not a surface. Whether a tool's core is inside tissue is decided at the closest triangle
///    (tools.h), and two faces at the same place say both. So triangles with an openness of zero neither touch nor are
///    asked, and tissue with a closed cut answers a tool as whole tissue does.
/// 2. The width grows with the tool, because a tool feels no slit that is much narrower than itself: a quarter of the
///    radius. For a solid it grows with the triangle.
/// 3. Faces of a cut push only a tool that they face: by 2 f of their stiffness, at most all of it, with the cosine f
/// of
///    the angle between the normal and the way to the tool. A thin tool would otherwise press with the full area of
///    both faces at the rim of a cut, and with the far side of a flap that is thinner than the tool. Solids have that
///    in the area that a triangle turns to them (solid.h).
/// 4. What a cut leaves of outer triangles touches as outer triangles do.
namespace tensormass::contact {

/// Widths of a cut that is open, in radii of a thin tool, and in sizes of the triangle.
inline constexpr double kSlitInRadii = 0.25, kSlitInSizes = 0.125;

/// Returns the width from which a thin tool sees that a cut is open [m].
template <class Real>
TM_HOST_DEVICE Real slit_width(const physics::PlacedTool<Real>& tool) {
  return Real(kSlitInRadii) * tool.radius_m;
}
/// The same of a solid. area: the triangle's [m²]
template <class Real>
TM_HOST_DEVICE Real slit_width(Real area) {
  using std::sqrt;
  return Real(kSlitInSizes) * sqrt(area);
}

template <class Real>
TM_HOST_DEVICE bool is_face_of_cut(const view::ContactView<Real>& contact, std::uint32_t triangle) {
  return is_carried(contact, triangle) && contact.carried.twins[triangle - contact.carried.first] != view::kNoTriangle;
}

/// Returns how far a triangle stands open, from 0 to 1; 1 if it is not the face of a cut. slit_m: width of an open cut
template <class Real>
TM_HOST_DEVICE Real openness(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                             std::uint32_t triangle, Real slit_m) {
  using std::sqrt;
  if (!is_face_of_cut(contact, triangle)) return 1;
  const Vec3<Real> centroid = Vec3<Real>::Constant(Real(1) / 3);
  const std::uint32_t twin = contact.carried.twins[triangle - contact.carried.first];
  const Vec3<Real> gap =
      corners_of(state, contact, twin).at(centroid) - corners_of(state, contact, triangle).at(centroid);
  return minimum(maximum(Real(2 * sqrt(gap.dot(gap)) / slit_m - 1), Real(0)), Real(1));
}

template <class Real>
TM_HOST_DEVICE bool stands_open(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                std::uint32_t triangle, Real slit_m) {
  return !is_carried(contact, triangle) || openness(state, contact, triangle, slit_m) > 0;
}

/// Returns how the face of a cut touches a thin tool.
///
///   touch    as an outer triangle would touch
///   kept_m   depth by which the contact counts as deeper than it is, if it carries all of its triangle
///   open     the triangle's openness, not zero
template <class Real>
TM_HOST_DEVICE Touch<Real> turned_to_tool(Touch<Real> touch, const Corners<Real>& corners, Real kept_m, Real open) {
  const Real facing = -touch.normal.dot(unit<Real>(corners.normal()));
  const Real part = open * minimum(Real(2 * facing), Real(1));
  if (!(part > 0)) return {};
  touch.depth_m += kept_m / touch.share * (1 / part - 1);  // a kept force stays what it is
  touch.share *= part;
  touch.line_share *= part;
  return touch;
}

}  // namespace tensormass::contact
