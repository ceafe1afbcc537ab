#pragma once

#include <cmath>

#include "matrix/edges.h"
#include "physics/contact/closest_point.h"
#include "view/scene.h"

/// A rigid sphere against the tissue's surface: penalty pressure, without friction, implicit in time.
///
///                   ___
///                 /     \       c     centre of the sphere
///                |   c   |      n     direction in which the tissue is pushed, from c to the contact point
///                 \__│__/       w_a   weight of the contact point at corner a of the triangle
///    tissue ─────── n↓ ──────   d_a   motion of corner a to the end of the step, û + h v − u (view/state.h) [m]
///                               k     stiffness, penalty · area of the triangle [N/m]
///                               depth   radius − distance from c to the contact point [m]
///
/// 1. Each surface triangle has one contact point with a tool: its point closest to the sphere's centre. The triangle
///    is in contact if its depth is positive.
/// 2. The force at the *end* of the step is k (depth − n·Σ w_a d_a) along n. It enters the same linear system as the
///    tissue. Its derivative has three diagonal blocks and the edge tensors between the three corners. The mesh has
///    those edges anyway.
/// 3. Each step decides once whether the centre is inside the tissue: at the closest point of the whole surface, by the
///    angle-weighted pseudonormal there (Bærentzen, Aanæs 2005).
/// 4. A centre inside pushes the tissue back over itself: n is reversed, and the depth grows by twice the depth of the
///    centre. This concerns only triangles that face away from the centre. Another body beside the one that contains
///    the centre is pushed as usual.
namespace tensormass::contact {

template <class Real>
TM_HOST_DEVICE Vec3<Real> cross(const Vec3<Real>& a, const Vec3<Real>& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

/// Current positions of a triangle's corners.
template <class Real>
struct Corners {
  Vec3<Real> x[3];
  TM_HOST_DEVICE Vec3<Real> at(const Vec3<Real>& weights) const {
    return x[0] * weights[0] + x[1] * weights[1] + x[2] * weights[2];
  }
  /// The outward normal, not normalized: its length is twice the area.
  TM_HOST_DEVICE Vec3<Real> normal() const { return cross<Real>(x[1] - x[0], x[2] - x[0]); }
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
  for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_begin[vertex + 1]; ++i) {
    const Corners<Real> around = corners_of(state, contact, contact.incidence[4 * i]);
    const std::uint32_t c = contact.incidence[4 * i + 1];
    const Vec3<Real> to_next = unit<Real>(around.x[(c + 1) % 3] - around.x[c]);
    const Vec3<Real> to_previous = unit<Real>(around.x[(c + 2) % 3] - around.x[c]);
    const Real angle = acos(minimum(maximum(to_next.dot(to_previous), Real(-1)), Real(1)));
    sum += unit<Real>(around.normal()) * angle;
  }
  return sum;
}

template <class Real>
TM_HOST_DEVICE Vec3<Real> center_of(const view::ToolState<Real>& tool) {
  return {tool.center_m[0], tool.center_m[1], tool.center_m[2]};
}

/// Stage 1, closest-point query: finds the closest triangle of each patch to each tool, and on which side of it the
/// centre lies.
/// Reads displacement, tools; writes closest.
template <class Team, class Real>
TM_HOST_DEVICE void detect(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                           const view::ContactView<Real>& contact) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const Vec3<Real> center = center_of(contact.tools[t]);
    Real best = Real(1e30);
    std::uint32_t best_triangle = view::kNoTriangle;
    team.for_each(
        contact.patch_triangles[team.patch()], contact.patch_triangles[team.patch() + 1], [&](std::uint32_t triangle) {
          const Corners<Real> corners = corners_of(state, contact, triangle);
          const auto closest = physics::closest_point_on_triangle(center, corners.x[0], corners.x[1], corners.x[2]);
          const Vec3<Real> offset = center - corners.at(closest.weights);
          const Real squared = offset.dot(offset);
          if (squared < best) {
            best = squared;
            best_triangle = triangle;
          }
        });
    team.patch_argmin(best, best_triangle);
    if (team.leads_patch()) {
      Real side = 1;
      if (best_triangle != view::kNoTriangle) {
        const Corners<Real> corners = corners_of(state, contact, best_triangle);
        const auto closest = physics::closest_point_on_triangle(center, corners.x[0], corners.x[1], corners.x[2]);
        const Vec3<Real> outward = pseudonormal(state, contact, best_triangle, closest.feature);
        side = outward.dot(center - corners.at(closest.weights)) < 0 ? Real(-1) : Real(1);
      }
      contact.closest[std::size_t{t} * patches.patch_count + team.patch()] = {best, side};
    }
  }
}

/// Stage 2, contact generation: computes each triangle's contact with each tool.
/// Reads displacement, tools, closest; writes contacts.
template <class Team, class Real>
TM_HOST_DEVICE void respond(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                            const view::ContactView<Real>& contact) {
  using std::sqrt;
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const view::ToolState<Real> tool = contact.tools[t];
    view::ClosestTriangle<Real> nearest = contact.closest[std::size_t{t} * patches.patch_count];
    for (std::uint32_t patch = 1; patch < patches.patch_count; ++patch) {
      const auto other = contact.closest[std::size_t{t} * patches.patch_count + patch];
      if (other.distance_squared < nearest.distance_squared) nearest = other;
    }
    const Vec3<Real> center = center_of(tool);
    // Depth of the centre inside the tissue. With it, depth continues radius − distance continuously to the inside.
    const Real inside = nearest.side < 0 ? sqrt(nearest.distance_squared) : Real(0);
    team.for_each(
        contact.patch_triangles[team.patch()], contact.patch_triangles[team.patch() + 1], [&](std::uint32_t triangle) {
          view::TriangleContact<Real>& touch = contact.contacts[std::size_t{t} * contact.triangle_count + triangle];
          const Corners<Real> corners = corners_of(state, contact, triangle);
          const auto closest = physics::closest_point_on_triangle(center, corners.x[0], corners.x[1], corners.x[2]);
          const Vec3<Real> away = corners.at(closest.weights) - center;
          const Real distance = sqrt(away.dot(away));
          const bool behind = nearest.side < 0 && corners.normal().dot(away) > 0;
          const Real depth = tool.radius_m + (behind ? 2 * inside : Real(0)) - distance;
          touch.depth_m = maximum(depth, Real(0));
          if (!(depth > 0)) return;
          const Vec3<Real> normal = distance > Real(1e-6) * tool.radius_m
                                        ? Vec3<Real>(away * ((behind ? -1 : 1) / distance))
                                        : Vec3<Real>(-unit<Real>(corners.normal()));
          for (int c = 0; c < 3; ++c) {
            touch.weight[c] = closest.weights[c];
            touch.normal[c] = normal[c];
          }
          touch.stiffness = tool.penalty_pa_per_m * contact.triangle_area[triangle];
        });
  }
}

/// Stage 3: adds contacts to the linear system. Each surface node gathers from the triangles around it.
/// Reads contacts, velocity; adds to edges, diagonal, rhs.
template <class Team, class Real>
TM_HOST_DEVICE void assemble(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                             const view::MatrixView<Real>& matrix, const view::ContactView<Real>& contact) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  const Real h = view::step_size(state);
  team.for_each(contact.patch_surface[patch.index], contact.patch_surface[patch.index + 1], [&](std::uint32_t vertex) {
    const std::uint32_t row = contact.surface_rows[vertex];
    for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
      for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_begin[vertex + 1]; ++i) {
        const std::uint32_t* incidence = contact.incidence + std::size_t{4} * i;
        const std::uint32_t triangle = incidence[0], corner = incidence[1];
        const view::TriangleContact<Real>& touch = contact.contacts[std::size_t{t} * contact.triangle_count + triangle];
        if (!(touch.depth_m > 0)) continue;
        const Vec3<Real> n(touch.normal[0], touch.normal[1], touch.normal[2]);
        Real retreat = 0;  // n · Σ w d, how far the contact point moves away
        for (int c = 0; c < 3; ++c) {
          retreat +=
              touch.weight[c] * n.dot(view::change_ahead(state, contact.triangle_rows[std::size_t{3} * triangle + c]));
        }
        const Real weight = touch.weight[corner];
        const Vec3<Real> impulse = n * (h * weight * touch.stiffness * (touch.depth_m - retreat));
        view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + impulse);

        const Mat3<Real> stiffness = n * n.transpose() * (h * h * touch.stiffness * weight);
        Real* d = matrix.diagonal + std::size_t{8} * row;
        d[0] += weight * stiffness(0, 0);
        d[1] += weight * stiffness(0, 1);
        d[2] += weight * stiffness(0, 2);
        d[3] += weight * stiffness(1, 1);
        d[4] += weight * stiffness(1, 2);
        d[5] += weight * stiffness(2, 2);
        for (std::uint32_t k = 1; k <= 2; ++k) {
          const std::uint32_t slot = incidence[1 + k];
          const Real other = touch.weight[(corner + k) % 3];
          if (slot != view::kNoPlace) matrix::add_to_block<Real>(matrix, slot, stiffness * other);
        }
      }
    }
  });
}

/// Stage 4, after the solve: measures the force and torque of the tissue on each tool at the end of the step.
/// Reads contacts, displacement, velocity; writes tool_loads.
template <class Team, class Real>
TM_HOST_DEVICE void measure(Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                            const view::ContactView<Real>& contact) {
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const view::ToolState<Real> tool = contact.tools[t];
    Vec3<Real> force = Vec3<Real>::Zero(), torque = Vec3<Real>::Zero();
    team.for_each(
        contact.patch_triangles[team.patch()], contact.patch_triangles[team.patch() + 1], [&](std::uint32_t triangle) {
          const view::TriangleContact<Real>& touch =
              contact.contacts[std::size_t{t} * contact.triangle_count + triangle];
          if (!(touch.depth_m > 0)) return;
          const Vec3<Real> n(touch.normal[0], touch.normal[1], touch.normal[2]);
          Vec3<Real> change = Vec3<Real>::Zero(), point = Vec3<Real>::Zero();
          for (int c = 0; c < 3; ++c) {
            const std::uint32_t row = contact.triangle_rows[std::size_t{3} * triangle + c];
            // With base fields, contacts are generated again at the end of the step: nothing has moved since.
            if (state.base_displacement == nullptr) {
              change += view::load3<Real>(state.velocity, row) * (view::step_size(state) * touch.weight[c]);
            }
            point += view::position(state, row) * touch.weight[c];
          }
          point -= change;  // back to where the normal was taken: tissue that slides exerts no torque on a sphere
          // Penalty contact only pushes: a point that left the sphere within the step carries no force.
          const Real pressure = touch.stiffness * maximum(touch.depth_m - n.dot(change), Real(0));
          force -= n * pressure;
          torque -= cross<Real>(point - center_of(tool), n) * pressure;
        });
    Real sums[6] = {force[0], force[1], force[2], torque[0], torque[1], torque[2]};
    team.patch_sum(sums);
    if (team.leads_patch()) {
      contact.tool_loads[std::size_t{t} * patches.patch_count + team.patch()] = {{sums[0], sums[1], sums[2]},
                                                                                 {sums[3], sums[4], sums[5]}};
    }
  }
}

}  // namespace tensormass::contact
