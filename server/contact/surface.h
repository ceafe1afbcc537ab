#pragma once

#include <cmath>

#include "physics/contact/closest_point.h"
#include "view/scene.h"

/// The tissue's surface at the present displacement: corners and normals of the triangles that tools can touch.
namespace tensormass::contact {

/// A vector for each corner of a triangle: positions, or motions.
template <class Real>
struct Corners {
  Vec3<Real> x[3];
  TM_HOST_DEVICE Vec3<Real> at(const Vec3<Real>& weights) const {
    return x[0] * weights[0] + x[1] * weights[1] + x[2] * weights[2];
  }
  /// The outward normal, not normalized: its length is twice the area.
  TM_HOST_DEVICE Vec3<Real> normal() const { return physics::cross<Real>(x[1] - x[0], x[2] - x[0]); }
};

template <class Real>
TM_HOST_DEVICE Corners<Real> corners_of(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                        std::uint32_t triangle) {
  const std::uint32_t* rows = contact.triangle_rows + std::size_t{3} * triangle;
  return {{view::position(state, rows[0]), view::position(state, rows[1]), view::position(state, rows[2])}};
}

template <class Real>
TM_HOST_DEVICE Vec3<Real> unit(const Vec3<Real>& v) {
  using std::sqrt;
  const Real squared = v.dot(v);
  return squared > 0 ? Vec3<Real>(v / sqrt(squared)) : Vec3<Real>(Vec3<Real>::Zero());
}

/// Outward pseudonormal of the surface at a feature of a triangle, not normalized.
template <class Real>
TM_HOST_DEVICE Vec3<Real> pseudonormal(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                       std::uint32_t triangle, physics::TriangleFeature feature) {
  using physics::TriangleFeature;
  using std::acos;
  const Vec3<Real> own = unit<Real>(corners_of(state, contact, triangle).normal());
  if (feature == TriangleFeature::kFace) return own;
  if (feature < TriangleFeature::kVertex0) {
    const int edge = static_cast<int>(feature) - static_cast<int>(TriangleFeature::kEdge01);
    const std::uint32_t neighbour = contact.triangle_neighbours[std::size_t{3} * triangle + edge];
    if (neighbour == view::kNoTriangle) return own;
    return own + unit<Real>(corners_of(state, contact, neighbour).normal());
  }
  const int corner = static_cast<int>(feature) - static_cast<int>(TriangleFeature::kVertex0);
  const std::uint32_t vertex = contact.vertex_of_corner[std::size_t{3} * triangle + corner];
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
    const Corners<Real> around = corners_of(state, contact, contact.incidence[4 * i]);
    const std::uint32_t c = contact.incidence[4 * i + 1];
    const Vec3<Real> to_next = unit<Real>(around.x[(c + 1) % 3] - around.x[c]);
    const Vec3<Real> to_previous = unit<Real>(around.x[(c + 2) % 3] - around.x[c]);
    const Real angle = acos(minimum(maximum(to_next.dot(to_previous), Real(-1)), Real(1)));
    sum += unit<Real>(around.normal()) * angle;
  }
  return sum;
}

/// Returns whether a contact acts in this step.
template <class Real>
TM_HOST_DEVICE bool touches(const view::TriangleContact<Real>& touch) {
  return touch.stiffness > 0;
}

/// Returns the index of a contact in ContactView::contacts.
template <class Real>
TM_HOST_DEVICE std::size_t contact_place(const view::ContactView<Real>& contact, const physics::PlacedTool<Real>& tool,
                                         std::uint32_t point, std::uint32_t triangle) {
  return std::size_t{tool.first_contact_point + point} * contact.triangle_count + triangle;
}

/// The point at which a triangle of the tissue touches a tool.
///
///   n, w_a, d_a   as in tools.h;  D, P as in friction.h
template <class Real>
struct ContactPoint {
  const view::StateView<Real>& state;
  const std::uint32_t* rows;  // rows of the triangle's corners
  const view::TriangleContact<Real>& touch;

  TM_HOST_DEVICE ContactPoint(const view::StateView<Real>& of_state, const view::ContactView<Real>& contact,
                              std::uint32_t triangle, const view::TriangleContact<Real>& of_touch)
      : state(of_state), rows(contact.triangle_rows + std::size_t{3} * triangle), touch(of_touch) {}

  TM_HOST_DEVICE Vec3<Real> weights() const { return {touch.weight[0], touch.weight[1], touch.weight[2]}; }
  TM_HOST_DEVICE Vec3<Real> normal() const { return {touch.normal[0], touch.normal[1], touch.normal[2]}; }
  /// Returns P v.
  TM_HOST_DEVICE Vec3<Real> tangential(const Vec3<Real>& v) const { return v - normal() * normal().dot(v); }
  /// Returns d of the corners before the solve, up to the end of the step.
  TM_HOST_DEVICE Corners<Real> change_ahead() const {
    Corners<Real> change;
    for (int c = 0; c < 3; ++c) change.x[c] = view::change_ahead_to_end(state, rows[c]);
    return change;
  }
  /// Returns d of the corners after the solve, up to the end of the step.
  TM_HOST_DEVICE Corners<Real> change_made() const {
    Corners<Real> change;
    for (int c = 0; c < 3; ++c) change.x[c] = view::change_made_to_end(state, rows[c]);
    return change;
  }
  /// Returns the force along n after a motion of the corners; negative if it pulls [N].
  TM_HOST_DEVICE Real pressure_after(const Corners<Real>& motion) const {
    return touch.stiffness * (touch.depth_m - normal().dot(motion.at(weights())));
  }
  /// Returns where the contact was generated, after the solve.
  TM_HOST_DEVICE Corners<Real> corners_before() const {
    Corners<Real> corners;
    for (int c = 0; c < 3; ++c) corners.x[c] = view::position(state, rows[c]) - view::change_made(state, rows[c]);
    return corners;
  }
  /// Returns D: how far the point moves in the whole step [m].
  TM_HOST_DEVICE Vec3<Real> motion_in_step() const {
    Vec3<Real> sum = Vec3<Real>::Zero();
    for (int c = 0; c < 3; ++c) sum += view::motion_to_end(state, rows[c]) * touch.weight[c];
    return sum;
  }
};

}  // namespace tensormass::contact
