#pragma once

#include <cmath>

#include "contact/friction.h"
#include "contact/link.h"
#include "contact/surface.h"
#include "view/scene.h"

/// Contact of bodies with each other, and of a body with itself: nodes of one surface against triangles of another.
///
///          x               x     node of a surface
///          ↑ n             p     point of the other surface that is closest to x
///     ─────p──────         n     outward normal at p, in which the node is pushed
///       triangle           s     signed distance from p to x; negative inside the other body
///
///   depth = r − s          r     distance at which surfaces begin to push each other
///   force = k (depth − n·(d_x − Σ w_a d_a)) n, on the node; the corners of the triangle receive the opposite
///
///   k = penalty · half the node's part of its surface. Both surfaces have nodes that touch the other, and share the
///   load; so a pressure p is carried at a depth of p / penalty. Unless the scene gives it, the penalty follows from
///   the softer of the elements behind node and triangle.
///
/// 1. p is searched in two levels of boxes that are refitted in each step: groups of leaves, leaves of triangles. The
///    boxes' members are chosen once, at rest.
/// 2. The sign of s is that of the angle-weighted pseudonormal at the closest point (Bærentzen, Aanæs 2005).
/// 3. A node deeper than `reach` is not found.
/// 4. For contact of a body with itself, triangles that lie within two reaches of the node at rest are left out. So a
///    node touches neither its own neighbourhood nor the other side of a thin part.
/// 5. p is the closest point of the triangles that face the node. At the rim of two blocks that rest on each other, the
///    closest triangle may be a side, which would push the node the wrong way.
/// 6. Friction is that of tools (friction.h): a spring across n that yields. Its stretch belongs to the node.
/// 7. A node that comes to its own body's surface from within does not touch it: a tool has pressed the tissue so thin
///    that the node is closer to the other side than the reach, or through it. Contact would push the node out there
///    and hold it. A node touches only what it was seen outside of before (NodeSide).
/// 8. A node that pushed another body in the last step and is behind the facing triangle has sunk in, even where it is
///    out on the other side of a thin body (remembers_side). It is pushed back to where it entered.
/// 9. A node that comes through a face in this step touches that face across the gap, if it would end deeper than the
///    reach or nearer to the opposite face (passed_face). The next step would not find it at that face. The
///    node searches along its own way, so the other body must move less than the reach in a step.
namespace tensormass::contact {

/// Cosine of the angle up to which two triangles count as parts of one smooth surface: 45°.
inline constexpr double kSmoothCosine = 0.7;

/// Distance from a triangle up to which a node that comes past its edge still passes through it, in reaches: rounding.
inline constexpr double kOnFace = 1e-4;

/// Width of the rim in is_inside, as a part of the reach.
inline constexpr double kRimInReaches = 0.1;

/// Side on which a node was in the last step, as to its own body's surface: the 4th number of LinksView::slips while
/// the node does not push, and Link::across of a link without stiffness. A node that was outside, or pushed, has 0 or a
/// force.
struct NodeSide {
  /// Nothing faced it within the reach. It is in the open, or deep in the body.
  static constexpr int kUnseen = -1;
  /// The node came to the surface from within, and has not been out of reach since.
  static constexpr int kFromWithin = -2;
};

template <class Real>
TM_HOST_DEVICE Real distance_squared(const view::AxisBox<Real>& box, const Vec3<Real>& point) {
  Real sum = 0;
  for (int c = 0; c < 3; ++c) {
    const Real beyond = maximum(maximum(box.least[c] - point[c], point[c] - box.most[c]), Real(0));
    sum += beyond * beyond;
  }
  return sum;
}

/// Puts the boxes around the present surface. Each patch takes a part of all boxes.
template <class Team, class Real>
TM_HOST_DEVICE void refit_boxes(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                const view::ContactView<Real>& contact, const view::LinksView<Real>& links) {
  const std::uint32_t groups = links.leaf_count / view::kGroupLeaves, boxes = links.leaf_count + groups;
  const auto first_of = [&](std::uint32_t patch) {
    return static_cast<std::uint32_t>(std::uint64_t{boxes} * patch / patches.patch_count);
  };
  team.for_each(first_of(team.patch()), first_of(team.patch() + 1), [&](std::uint32_t b) {
    const std::uint32_t leaves = b < links.leaf_count ? 1 : view::kGroupLeaves;
    const std::uint32_t leaf = b < links.leaf_count ? b : (b - links.leaf_count) * view::kGroupLeaves;
    constexpr Real kFar = Real(1e30);
    view::AxisBox<Real> box{{kFar, kFar, kFar}, {-kFar, -kFar, -kFar}};
    for (std::uint32_t i = leaf * view::kLeafTriangles; i < (leaf + leaves) * view::kLeafTriangles; ++i) {
      if (links.leaf_triangles[i] == view::kNoTriangle) continue;
      const Corners<Real> corners = outer_corners_of(state, contact, links.leaf_triangles[i]);
      for (const auto& corner : corners.x) {
        for (int c = 0; c < 3; ++c) {
          box.least[c] = minimum(box.least[c], corner[c]);
          box.most[c] = maximum(box.most[c], corner[c]);
        }
      }
    }
    links.boxes[b] = box;
  });
}

/// Returns whether a triangle is so close to a node at rest that the two never count as touching (4. above).
template <class Real>
TM_HOST_DEVICE bool are_neighbours(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                   std::uint32_t row, std::uint32_t triangle, Real reach) {
  const std::uint32_t* rows = contact.triangle_rows + std::size_t{3} * triangle;
  const Vec3<Real> x = view::load3<Real>(state.rest, row);
  const Corners<Real> corners{{view::load3<Real>(state.rest, rows[0]), view::load3<Real>(state.rest, rows[1]),
                               view::load3<Real>(state.rest, rows[2])}};
  const Vec3<Real> way =
      x - corners.at(physics::closest_point_on_triangle(x, corners.x[0], corners.x[1], corners.x[2]).weights);
  return way.dot(way) < 4 * reach * reach;
}

/// Returns the outward normal at a surface vertex, weighted by area; its length says nothing.
template <class Real>
TM_HOST_DEVICE Vec3<Real> vertex_normal(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                        std::uint32_t vertex) {
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
    sum += outer_corners_of(state, contact, contact.incidence[4 * i]).normal();
  }
  return sum;
}

/// Returns the outward normal at a point of a triangle, unit length: linear between normals of its corners, each a mean
/// over the triangles around the corner that are smooth with this one. It is continuous where the surface is smooth,
/// and that of the face where the surface has an edge.
template <class Real>
TM_HOST_DEVICE Vec3<Real> smooth_normal(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                                        std::uint32_t triangle, const Vec3<Real>& weights) {
  const Vec3<Real> own = unit<Real>(outer_corners_of(state, contact, triangle).normal());
  Vec3<Real> sum = Vec3<Real>::Zero();
  for (std::size_t corner = 0; corner < 3; ++corner) {
    const std::uint32_t vertex = contact.vertex_of_corner[std::size_t{3} * triangle + corner];
    Vec3<Real> around = Vec3<Real>::Zero();
    for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
      const Vec3<Real> area = outer_corners_of(state, contact, contact.incidence[4 * i]).normal();
      if (unit<Real>(area).dot(own) > Real(kSmoothCosine)) around += area;
    }
    sum += unit<Real>(around) * weights[static_cast<Eigen::Index>(corner)];
  }
  return unit<Real>(sum);
}

/// A point of a surface.
template <class Real>
struct SurfacePoint {
  std::uint32_t triangle = view::kNoTriangle;  // none lies within the reach
  physics::TriangleFeature feature{};
  Vec3<Real> weights, way;  // way: from the point to the node
};

/// The points of a surface that are closest to a node: of all its triangles, and of those that face the node.
template <class Real>
struct NearestPoints {
  SurfacePoint<Real> any, facing;
};

/// Calls visit(triangle) for the triangles of a side's surface, without those of boxes that skips(box) leaves out.
template <class Real, class Skips, class Visit>
TM_HOST_DEVICE void for_each_triangle(const view::LinksView<Real>& links, const std::uint32_t* side_groups,
                                      const Skips& skips, const Visit& visit) {
  for (std::uint32_t group = side_groups[0]; group < side_groups[1]; ++group) {
    if (skips(links.boxes[links.leaf_count + group])) continue;
    for (std::uint32_t leaf = group * view::kGroupLeaves; leaf < (group + 1) * view::kGroupLeaves; ++leaf) {
      if (skips(links.boxes[leaf])) continue;
      for (std::uint32_t i = leaf * view::kLeafTriangles; i < (leaf + 1) * view::kLeafTriangles; ++i) {
        if (links.leaf_triangles[i] != view::kNoTriangle) visit(links.leaf_triangles[i]);
      }
    }
  }
}

template <class Real>
TM_HOST_DEVICE NearestPoints<Real> nearest_points(const view::StateView<Real>& state,
                                                  const view::ContactView<Real>& contact,
                                                  const view::LinksView<Real>& links, std::uint32_t vertex,
                                                  const std::uint32_t* side_groups, Real reach) {
  const std::uint32_t row = contact.surface_rows[vertex];
  const Vec3<Real> x = view::position(state, row);
  const bool own = side_groups[2] != 0;
  Vec3<Real> of_vertex = Vec3<Real>::Zero();
  bool has_normal = false;
  const auto normal = [&]() -> const Vec3<Real>& {  // most nodes have nothing in reach, and need none
    if (!has_normal) of_vertex = vertex_normal(state, contact, vertex);
    has_normal = true;
    return of_vertex;
  };
  NearestPoints<Real> nearest;
  Real any = reach * reach, facing = any;  // any ≤ facing
  const auto consider = [&](std::uint32_t triangle) {
    const Corners<Real> corners = outer_corners_of(state, contact, triangle);
    const auto closest = physics::closest_point_on_triangle(x, corners.x[0], corners.x[1], corners.x[2]);
    const Vec3<Real> way = x - corners.at(closest.weights);
    const Real squared = way.dot(way);
    if (!(squared < facing) || (own && are_neighbours(state, contact, row, triangle, reach))) return;
    const SurfacePoint<Real> point{triangle, closest.feature, closest.weights, way};
    if (squared < any) {
      any = squared;
      nearest.any = point;
    }
    if (!(corners.normal().dot(normal()) < 0)) return;
    facing = squared;
    nearest.facing = point;
  };
  const auto is_farther = [&](const view::AxisBox<Real>& box) { return distance_squared(box, x) >= facing; };
  for_each_triangle(links, side_groups, is_farther, consider);
  return nearest;
}

/// Returns whether a node is inside a body. A node that is hardly outside a triangle that does not face it counts as
/// inside if it is behind the one that does: rims of blocks that rest on each other do not slip past.
///
///   normal   of the facing triangle
template <class Real>
TM_HOST_DEVICE bool is_inside(const view::StateView<Real>& state, const view::ContactView<Real>& contact,
                              const NearestPoints<Real>& nearest, const Vec3<Real>& normal, Real reach) {
  const SurfacePoint<Real>& any = nearest.any;
  if (pseudonormal(state, contact, any.triangle, any.feature).dot(any.way) < 0) return true;
  const Real margin = Real(kRimInReaches) * reach;
  return any.way.dot(any.way) < margin * margin && normal.dot(nearest.facing.way) < 0;
}

/// Returns whether a node that pushed another body in the last step is still on the side of the facing triangle from
/// which it came. Beside that body's rim it is not.
///
///   face   outward normal at the facing point, unit length;  way: from there to the node
template <class Real>
TM_HOST_DEVICE bool remembers_side(const Vec3<Real>& face, const Vec3<Real>& way) {
  using std::sqrt;
  return -face.dot(way) > Real(kSmoothCosine) * sqrt(way.dot(way));
}

template <class Real>
TM_HOST_DEVICE bool overlap(const view::AxisBox<Real>& a, const view::AxisBox<Real>& b) {
  for (int c = 0; c < 3; ++c) {
    if (!(a.least[c] <= b.most[c] && b.least[c] <= a.most[c])) return false;
  }
  return true;
}

/// Places of rows at the start and at the end of the step, at the velocities as they are stored.
template <class Real>
struct StepWay {
  const view::StateView<Real>& state;

  TM_HOST_DEVICE Vec3<Real> end_of(std::uint32_t row) const {
    return view::position(state, row) + view::change_ahead_to_end(state, row);
  }
  TM_HOST_DEVICE Vec3<Real> start_of(std::uint32_t row) const { return end_of(row) - view::motion_to_end(state, row); }
  /// Returns the box around the ways of some rows, larger by `margin` [m]. ahead: ways that they go on from the end.
  TM_HOST_DEVICE view::AxisBox<Real> box_of(const std::uint32_t* rows, int count, Real margin, Real ahead = 0) const {
    view::AxisBox<Real> box;
    for (int r = 0; r < count; ++r) {
      const Vec3<Real> end = end_of(rows[r]) + view::motion_to_end(state, rows[r]) * ahead;
      const Vec3<Real> places[3] = {view::position(state, rows[r]), start_of(rows[r]), end};
      for (int i = 0; i < 3; ++i) {
        for (int c = 0; c < 3; ++c) {
          const bool first = r == 0 && i == 0;
          box.least[c] = first ? places[i][c] - margin : minimum(box.least[c], Real(places[i][c] - margin));
          box.most[c] = first ? places[i][c] + margin : maximum(box.most[c], Real(places[i][c] + margin));
        }
      }
    }
    return box;
  }
};

/// Returns the first point at which a node comes through the surface of another body in this step, if it would not be
/// found there in the next one: because it gets deeper than `reach`, or nearer to the opposite face. Else no triangle:
/// a contact across a gap may pull in a step that another contact ends early, so it is the exception. way: from there
/// to the node, now. The face must face the node, because a thin body's far side comes through behind its near side. A
/// triangle counts as moving with the mean of its corners.
///
///   margin   depth up to which the node is not taken as inside [m]
template <class Real>
TM_HOST_DEVICE SurfacePoint<Real> passed_face(const view::StateView<Real>& state,
                                              const view::ContactView<Real>& contact,
                                              const view::LinksView<Real>& links, std::uint32_t vertex,
                                              const std::uint32_t* side_groups, Real margin, Real reach) {
  SurfacePoint<Real> found;
  const std::uint32_t row = contact.surface_rows[vertex];
  const StepWay<Real> ways{state};
  const Vec3<Real> own = view::motion_to_end(state, row);
  if (!(own.dot(own) > margin * margin)) return found;
  const Vec3<Real> start = ways.start_of(row), x = view::position(state, row);
  Real first = 2, out = 3, deepest = 0;  // part of the way to the entry and to the exit; depth at the end
  Vec3<Real> normal_in = Vec3<Real>::Zero(), normal_out = Vec3<Real>::Zero();
  const auto consider = [&](std::uint32_t triangle) {
    const std::uint32_t* rows = contact.triangle_rows + std::size_t{3} * triangle;
    const Corners<Real> corners{{ways.start_of(rows[0]), ways.start_of(rows[1]), ways.start_of(rows[2])}};
    Vec3<Real> motion = own;
    for (int c = 0; c < 3; ++c) motion -= view::motion_to_end(state, rows[c]) / 3;
    const Vec3<Real> normal = unit<Real>(corners.normal());
    const Real ahead = normal.dot(motion), gap = normal.dot(start - corners.x[0]);
    const bool enters = gap >= 0 && gap + ahead < -margin, leaves = gap < 0 && gap + 2 * ahead > 0;
    if (!enters && !leaves) return;
    const Real part = -gap / ahead;
    if (!(part < (enters ? first : out))) return;
    // Late, because few come so far.
    if (enters && !(normal.dot(vertex_normal(state, contact, vertex)) < 0)) return;
    const Vec3<Real> there = start + motion * part;
    const auto closest = physics::closest_point_on_triangle(there, corners.x[0], corners.x[1], corners.x[2]);
    const Vec3<Real> beside = there - corners.at(closest.weights);
    if (beside.dot(beside) > Real(kOnFace * kOnFace) * reach * reach) return;
    if (leaves) {
      out = part;
      normal_out = normal;
      return;
    }
    first = part;
    normal_in = normal;
    deepest = -gap - ahead;
    found = {triangle, closest.feature, closest.weights,
             x - outer_corners_of(state, contact, triangle).at(closest.weights)};
  };
  const view::AxisBox<Real> near = ways.box_of(&row, 1, reach, 1);
  for_each_triangle(
      links, side_groups, [&](const view::AxisBox<Real>& box) { return !overlap(box, near); }, consider);
  // The way through is short beside a sharp edge, too, where both faces meet; there the edge has its own contact.
  const bool is_thin = out - 1 < 1 - first && normal_in.dot(normal_out) < -Real(kSmoothCosine);
  if (!(deepest > reach || is_thin)) found.triangle = view::kNoTriangle;
  return found;
}

/// Returns the stretch of a contact's spring of friction at the velocities as they are stored: the one with which the
/// step started, less the relative motion across n.
template <class Real>
TM_HOST_DEVICE Vec3<Real> contact_stretch(const view::StateView<Real>& state, const view::Link<Real>& link,
                                          const Real* slip) {
  const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
  const Vec3<Real> moved = relative(link, kAllRows, [&](std::uint32_t row) { return view::motion_to_end(state, row); });
  const Vec3<Real> stretch = Vec3<Real>(slip[0], slip[1], slip[2]) - moved;
  return stretch - n * n.dot(stretch);
}

/// Adds friction to the link of a contact: predicts whether it sticks or slides, as predict_friction does for tools.
template <class Real>
TM_HOST_DEVICE void add_friction(const view::StateView<Real>& state, Real coefficient, const Real* slip,
                                 view::Link<Real>& link) {
  const Vec3<Real> n(link.normal[0], link.normal[1], link.normal[2]);
  const Vec3<Real> ahead =
      relative(link, kAllRows, [&](std::uint32_t row) { return view::change_ahead_to_end(state, row); });
  const Vec3<Real> depth_force(link.force[0], link.force[1], link.force[2]);
  const Real predicted = n.dot(depth_force) - link.stiffness * n.dot(ahead);
  const Real most = coefficient * (state.iterates == 0 ? slip[3] : predicted);
  if (!(most > 0)) return;
  const Vec3<Real> stretch = contact_stretch(state, link, slip);
  link.across = link.stiffness * yield_factor(link.stiffness, stretch, most);
  // The force of a link is counted from where the rows are now, the stretch to where they will be.
  const Vec3<Real> now = stretch + (ahead - n * n.dot(ahead));
  for (int c = 0; c < 3; ++c) link.force[c] += link.across * now[c];
}

/// Returns the link of a candidate in this step.
template <class Real>
TM_HOST_DEVICE view::Link<Real> link_of_candidate(const view::StateView<Real>& state,
                                                  const view::ContactView<Real>& contact,
                                                  const view::LinksView<Real>& links, std::uint32_t candidate) {
  using std::sqrt;
  const std::uint32_t vertex = links.candidates[std::size_t{2} * candidate], row = contact.surface_rows[vertex];
  const std::uint32_t side = links.candidates[std::size_t{2} * candidate + 1];
  const Real* numbers = links.side_numbers + std::size_t{view::kSideNumbers} * side;
  view::Link<Real> link{{row, row, row, row}, {1, 0, 0, 0}, {}, {}, 0, 0};
  const Real reach = numbers[view::kSideReach];
  const std::uint32_t* side_groups = links.side_groups + std::size_t{3} * side;
  const NearestPoints<Real> nearest = nearest_points(state, contact, links, vertex, side_groups, reach);
  SurfacePoint<Real> point = nearest.facing;
  const bool own = side_groups[2] != 0;
  const Real before = links.slips[std::size_t{4} * candidate + 3], begins = numbers[view::kSideDistance];
  Real depth = 0;
  Vec3<Real> n = Vec3<Real>::Zero();
  if (point.triangle != view::kNoTriangle) {
    const Vec3<Real> face = smooth_normal(state, contact, point.triangle, point.weights);
    bool inside = is_inside(state, contact, nearest, face, reach);
    if (own) {
      if (before == Real(NodeSide::kFromWithin) || (before == Real(NodeSide::kUnseen) && inside)) {
        link.across = Real(NodeSide::kFromWithin);
        return link;
      }
    } else if (before > 0) {
      inside = inside || remembers_side(face, point.way);
    }
    const Real distance = sqrt(point.way.dot(point.way));
    depth = begins - (inside ? face.dot(point.way) : distance);
    const bool has_direction = !inside && distance > Real(1e-4) * reach;
    n = has_direction ? Vec3<Real>(point.way / distance) : face;
  } else if (own) {
    link.across = Real(NodeSide::kUnseen);
    return link;
  }
  if (!(depth > 0)) {
    if (own) return link;
    point = passed_face(state, contact, links, vertex, side_groups, begins, reach);
    if (point.triangle == view::kNoTriangle) return link;
    n = smooth_normal(state, contact, point.triangle, point.weights);
    depth = begins - n.dot(point.way);
  }
  const Real softer =
      minimum(links.candidate_modulus[candidate], contact.triangle_moduli[std::size_t{2} * point.triangle]);
  link.stiffness =
      (numbers[view::kSidePenalty] + numbers[view::kSidePenaltyPerM] * softer) * links.candidate_area[candidate];
  for (int c = 0; c < 3; ++c) {
    link.rows[1 + c] = contact.triangle_rows[std::size_t{3} * point.triangle + static_cast<std::size_t>(c)];
    link.weight[1 + c] = -point.weights[c];
    link.normal[c] = n[c];
    link.force[c] = link.stiffness * depth * n[c];
  }
  if (numbers[view::kSideFriction] > 0) {
    add_friction(state, numbers[view::kSideFriction], links.slips + std::size_t{4} * candidate, link);
  }
  return link;
}

/// Takes a contact's spring of friction to the end of the step, as end_contact does for tools.
///
///   friction           coefficient
///   pressure           normal force at the end of the step; not positive: the contact has ended, and its stretch is
///                      forgotten
///   slip, checkpoint   stretch and normal force of the contact; checkpoint: the same before the step, if it
///                      saves one; nullptr: the caller does
template <class Real>
TM_HOST_DEVICE void end_contact_friction(const view::StateView<Real>& state, const view::Link<Real>& link,
                                         Real friction, Real pressure, Real* slip, Real* checkpoint) {
  if (checkpoint != nullptr && state.control->saves_checkpoint != 0) {
    for (std::size_t c = 0; c < 4; ++c) checkpoint[c] = slip[c];
  }
  Vec3<Real> next = Vec3<Real>::Zero();
  if (pressure > 0 && friction > 0) {
    const Vec3<Real> stretch = contact_stretch(state, link, slip);
    next = stretch * yield_factor(link.stiffness, stretch, friction * pressure);
  }
  for (int c = 0; c < 3; ++c) slip[c] = next[c];
  slip[3] = link.stiffness > 0 ? maximum(pressure, Real(0)) : link.across;
}

/// Returns the coefficient of friction of a side.
template <class Real>
TM_HOST_DEVICE Real friction_of(const view::LinksView<Real>& links, std::uint32_t side) {
  return links.side_numbers[std::size_t{view::kSideNumbers} * side + view::kSideFriction];
}

}  // namespace tensormass::contact
