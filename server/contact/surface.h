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

/// Returns whether an element carries a triangle (view::CarriedView).
template <class Real>
TM_HOST_DEVICE bool is_carried(const view::ContactView<Real>& contact, std::uint32_t triangle) {
  return triangle >= contact.carried.first;
}

/// The rows whose motion a triangle follows: those of its three corners, or the four of the element that carries it.
template <class Real>
struct TriangleRows {
  const bool carried;  // false: corner k is row k
  const std::uint32_t* rows;
  const Real* weights;  // view::CarriedView::weights; not used of a triangle that no element carries

  /// `weights` can be read of that triangle, too: in double precision nvcc 13 reads ahead of `carried`.
  TM_HOST_DEVICE TriangleRows(const view::ContactView<Real>& contact, std::uint32_t triangle)
      : carried(is_carried(contact, triangle)),
        rows(contact.triangle_rows + std::size_t{3} * triangle),
        weights(contact.carried.weights) {
    if (!carried) return;
    const std::size_t place = triangle - contact.carried.first;
    rows = contact.carried.rows + 4 * place;
    weights += 12 * place;
  }
  TM_HOST_DEVICE std::uint32_t count() const { return carried ? 4 : 3; }
  /// Returns the share of the k-th row in a sum over the corners.
  TM_HOST_DEVICE Real share(std::uint32_t k, const Vec3<Real>& of_corners) const {
    if (!carried) return of_corners[static_cast<Eigen::Index>(k)];
    return weights[k] * of_corners[0] + weights[4 + k] * of_corners[1] + weights[8 + k] * of_corners[2];
  }
};

/// Returns a vector for each corner of a triangle. of_row(row): that of a row
template <class Real, class OfRow>
TM_HOST_DEVICE Corners<Real> at_corners(const view::ContactView<Real>& contact, std::uint32_t triangle,
                                        const OfRow& of_row) {
  const TriangleRows<Real> of(contact, triangle);
  if (!of.carried) return {{of_row(of.rows[0]), of_row(of.rows[1]), of_row(of.rows[2])}};
  Corners<Real> out{{Vec3<Real>::Zero(), Vec3<Real>::Zero(), Vec3<Real>::Zero()}};
  for (std::uint32_t k = 0; k < 4; ++k) {
    const Vec3<Real> v = of_row(of.rows[k]);
    for (std::uint32_t c = 0; c < 3; ++c) out.x[c] += v * of.weights[4 * c + k];
  }
  return out;
}

/// Returns the positions of the corners of a triangle.
template <class Real>
TM_HOST_DEVICE Corners<Real> corners_of(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                        std::uint32_t triangle) {
  return at_corners<Real>(contact, triangle, [&](std::uint32_t row) { return view::position(state, row); });
}

/// Does the same for a triangle that no element carries, without asking.
template <class Real>
TM_HOST_DEVICE Corners<Real> outer_corners_of(const view::StateView<Real>& state,
                                              const view::ContactView<Real>& contact, std::uint32_t triangle) {
  const std::uint32_t* rows = contact.triangle_rows + std::size_t{3} * triangle;
  return {{view::position(state, rows[0]), view::position(state, rows[1]), view::position(state, rows[2])}};
}

/// Calls body(triangle) for the triangles of the team's patch.
template <class Team, class Real, class Body>
TM_HOST_DEVICE void for_each_triangle(const Team& team, const view::ContactView<Real>& contact, const Body& body) {
  const std::uint32_t begin = contact.patch_triangles[team.patch()], end = contact.triangles_end[team.patch()];
  std::uint32_t first = 0, count = 0;  // carried triangles
  if (contact.carried.first < contact.triangle_count) {
    first = contact.carried.patch_triangles[team.patch()];
    count = contact.carried.patch_triangles[team.patch() + 1] - first;
  }
  team.for_each(begin, end + count, [&](std::uint32_t i) { body(i < end ? i : first + (i - end)); });
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
  const auto add = [&](std::uint32_t of, std::uint32_t c) {
    const Corners<Real> around = corners_of(state, contact, of);
    const Vec3<Real> to_next = unit<Real>(around.x[(c + 1) % 3] - around.x[c]);
    const Vec3<Real> to_previous = unit<Real>(around.x[(c + 2) % 3] - around.x[c]);
    const Real angle = acos(minimum(maximum(to_next.dot(to_previous), Real(-1)), Real(1)));
    sum += unit<Real>(around.normal()) * angle;
  };
  if (vertex < contact.vertex_count) {
    for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
      add(contact.incidence[4 * i], contact.incidence[4 * i + 1]);
    }
  }
  if (contact.carried.first < contact.triangle_count) {
    const view::CarriedView<Real>& carried = contact.carried;
    for (std::uint32_t i = carried.around_begin[vertex]; i < carried.around_begin[vertex + 1]; ++i) {
      add(carried.around[2 * i], carried.around[2 * i + 1]);
    }
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
  const view::ContactView<Real>& contact;
  const std::uint32_t triangle;
  const view::TriangleContact<Real>& touch;

  TM_HOST_DEVICE ContactPoint(const view::StateView<Real>& of_state, const view::ContactView<Real>& of_contact,
                              std::uint32_t of_triangle, const view::TriangleContact<Real>& of_touch)
      : state(of_state), contact(of_contact), triangle(of_triangle), touch(of_touch) {}

  TM_HOST_DEVICE Vec3<Real> weights() const { return {touch.weight[0], touch.weight[1], touch.weight[2]}; }
  TM_HOST_DEVICE Vec3<Real> normal() const { return {touch.normal[0], touch.normal[1], touch.normal[2]}; }
  /// Returns P v.
  TM_HOST_DEVICE Vec3<Real> tangential(const Vec3<Real>& v) const { return v - normal() * normal().dot(v); }
  /// Returns d of the corners before the solve, up to the end of the step.
  TM_HOST_DEVICE Corners<Real> change_ahead() const {
    return at_corners<Real>(contact, triangle,
                            [&](std::uint32_t row) { return view::change_ahead_to_end(state, row); });
  }
  /// Returns d of the corners after the solve, up to the end of the step.
  TM_HOST_DEVICE Corners<Real> change_made() const {
    return at_corners<Real>(contact, triangle, [&](std::uint32_t row) { return view::change_made_to_end(state, row); });
  }
  /// Returns the force along n after a motion of the corners; negative if it pulls [N].
  TM_HOST_DEVICE Real pressure_after(const Corners<Real>& motion) const {
    return touch.stiffness * (touch.depth_m - normal().dot(motion.at(weights())));
  }
  /// Returns where the contact was generated, after the solve.
  TM_HOST_DEVICE Corners<Real> corners_before() const {
    return at_corners<Real>(contact, triangle, [&](std::uint32_t row) -> Vec3<Real> {
      return view::position(state, row) - view::change_made(state, row);
    });
  }
  /// Returns D: how far the point moves in the whole step [m].
  TM_HOST_DEVICE Vec3<Real> motion_in_step() const {
    Vec3<Real> sum = Vec3<Real>::Zero();
    const TriangleRows<Real> of(contact, triangle);
    if (of.carried) {
      for (std::uint32_t k = 0; k < 4; ++k) sum += view::motion_to_end(state, of.rows[k]) * of.share(k, weights());
      return sum;
    }
    // Outer triangles without `share`, with which the compiler fuses the sum otherwise: they keep their bits.
    for (int c = 0; c < 3; ++c) sum += view::motion_to_end(state, of.rows[c]) * touch.weight[c];
    return sum;
  }
};

}  // namespace tensormass::contact
