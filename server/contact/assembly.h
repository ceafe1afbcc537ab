#pragma once

#include <cmath>

#include "contact/friction.h"
#include "contact/line.h"
#include "contact/surface.h"
#include "contact/tilt.h"
#include "matrix/edges.h"
#include "view/scene.h"

/// Contacts of tools in the linear system (tools.h). Rows gather what the triangles around them feel, so no two threads
/// write to the same place:
///
///   outer triangle     row a is corner a          f_a = F_a              A_ab += K_ab
///   carried triangle   corner c is Σ W_ck x_k     f_k = Σ_c W_ck F_c     A_kl += Σ_c Σ_d W_ck K_cd W_dl
///
///   F, K   force on a corner of the triangle, and stiffness between two corners;  W: view::CarriedView::weights
namespace tensormass::contact {

/// What a contact does at its point.
template <class Real>
struct PointForce {
  Vec3<Real> force;      // on the tissue [N]
  Mat3<Real> stiffness;  // [N/m]
};

/// change: ContactPoint::change_ahead
template <class Real>
TM_HOST_DEVICE PointForce<Real> force_at_point(const view::StateView<Real>& state,
                                               const view::ContactView<Real>& contact, std::size_t place,
                                               const ContactPoint<Real>& at, const Corners<Real>& change,
                                               bool has_friction) {
  const Vec3<Real> n = at.normal();
  Vec3<Real> force = n * at.pressure_after(change);
  Mat3<Real> stiffness = n * n.transpose() * at.touch.stiffness;
  if (has_friction) {
    const view::TriangleFriction<Real>& friction = contact.frictions[place];
    const Vec3<Real> stretch = stretch_of(at, friction);
    force += stretch * friction.stiffness;
    Mat3<Real> across = Mat3<Real>::Identity() - n * n.transpose();
    if (state.iterates != 0 && friction.stiffness < at.touch.stiffness) {
      const Vec3<Real> slip = unit<Real>(stretch);
      across -= slip * slip.transpose() * Real(kIteratedSlip);
    }
    stiffness += across * friction.stiffness;
  }
  return {force, stiffness};
}

/// Adds a force, and a block of the diagonal, to a row of the system.
template <class Real>
TM_HOST_DEVICE void add_to_row(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                               std::uint32_t row, const Vec3<Real>& force, const Mat3<Real>& own) {
  const Real h = view::step_size(state);
  view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + force * h);
  Real* d = matrix.diagonal + std::size_t{8} * row;
  for (int i = 0, c = 0; i < 3; ++i) {
    for (int j = i; j < 3; ++j, ++c) d[c] += own(i, j);
  }
}

/// Adds to one row of the system what a contact does to one corner of its triangle.
///
///   place       index of the contact
///   incidence   the corner's entry of ContactView::incidence
///   row         row of the corner
template <class Real>
TM_HOST_DEVICE void assemble_contact(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                     const view::ContactView<Real>& contact, std::size_t place,
                                     const std::uint32_t* incidence, std::uint32_t row, bool has_friction) {
  const view::TriangleContact<Real>& touch = contact.contacts[place];
  if (!touches(touch)) return;
  const std::uint32_t triangle = incidence[0], corner = incidence[1];
  const Real weight = touch.weight[corner];
  // Otherwise the contact is at another corner or edge, and tilt does not concern this one.
  const auto concerns = [&](std::uint32_t c) {
    return touch.weight[c] != 0 || touch.line_stiffness * touch.line[c] != 0;
  };
  if (!concerns(corner)) return;
  const ContactPoint<Real> at(state, contact, triangle, touch);
  const Real factor = view::contact_factor(state);
  const Corners<Real> change = at.change_ahead();
  const PointForce<Real> push = force_at_point(state, contact, place, at, change, has_friction);
  const Tilt<Real> tilt(corners_of(state, contact, triangle), touch);
  const LineTilt<Real> line(touch);
  const auto own_corner = static_cast<int>(corner);
  const Vec3<Real> force =
      push.force * weight + tilt.force(own_corner, tilt.of(change)) + line.force(own_corner, line.of(change));
  const auto block = [&](std::uint32_t other) {
    const auto of = static_cast<int>(other);
    const Mat3<Real> tilted = tilt.block(own_corner, of) + line.block(own_corner, of);
    return Mat3<Real>((push.stiffness * (weight * touch.weight[other]) + tilted) * factor);
  };
  add_to_row<Real>(state, matrix, row, force, block(corner));
  for (std::uint32_t k = 1; k <= 2; ++k) {
    const std::uint32_t slot = incidence[1 + k], other = (corner + k) % 3;
    if (slot != view::kNoPlace && concerns(other)) matrix::add_to_block<Real>(matrix, slot, block(other));
  }
}

/// Adds to one row of the system what a contact with a carried triangle does to it.
/// entry: the row's entry of view::CarriedView::entries
template <class Real>
TM_HOST_DEVICE void assemble_carried_contact(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                             const view::ContactView<Real>& contact, std::size_t place,
                                             const std::uint32_t* entry, bool has_friction) {
  const view::TriangleContact<Real>& touch = contact.contacts[place];
  if (!touches(touch)) return;
  const std::uint32_t triangle = entry[0], own = entry[1];
  const ContactPoint<Real> at(state, contact, triangle, touch);
  const TriangleRows<Real> of(contact, triangle);
  const Real factor = view::contact_factor(state);
  const Corners<Real> change = at.change_ahead();
  const PointForce<Real> push = force_at_point(state, contact, place, at, change, has_friction);
  const Tilt<Real> tilt(corners_of(state, contact, triangle), touch);
  const LineTilt<Real> line(touch);
  const auto weight_at = [&](std::uint32_t k, int corner) { return of.weights[4 * corner + static_cast<int>(k)]; };
  const Real weight = of.share(own, at.weights());
  Vec3<Real> force = push.force * weight;
  const Vec3<Real> turned = tilt.of(change);
  const Real shifted = line.of(change);
  for (int c = 0; c < 3; ++c) force += (tilt.force(c, turned) + line.force(c, shifted)) * weight_at(own, c);
  const auto block = [&](std::uint32_t other) {
    Mat3<Real> sum = push.stiffness * (weight * of.share(other, at.weights()));
    for (int c = 0; c < 3; ++c) {
      for (int d = 0; d < 3; ++d) {
        sum += (tilt.block(c, d) + line.block(c, d)) * (weight_at(own, c) * weight_at(other, d));
      }
    }
    return Mat3<Real>(sum * factor);
  };
  add_to_row<Real>(state, matrix, of.rows[own], force, block(own));
  for (std::uint32_t k = 1; k <= 3; ++k) {
    const std::uint32_t slot = entry[1 + k];
    if (slot != view::kNoPlace) matrix::add_to_block<Real>(matrix, slot, block((own + k) % 4));
  }
}

/// Adds to a row the contacts of the triangles that its elements carry.
/// place: of the row, in view::CarriedView::entry_begin
template <class Real>
TM_HOST_DEVICE void assemble_carried(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                     const view::ContactView<Real>& contact, std::uint32_t place) {
  const view::CarriedView<Real>& carried = contact.carried;
  for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
    const physics::PlacedTool<Real>& tool = contact.tools[t];
    const std::uint32_t points = tool.contact_points;
    for (std::uint32_t i = carried.entry_begin[place]; i < carried.entry_begin[place + 1]; ++i) {
      const std::uint32_t* entry = carried.entries + std::size_t{5} * i;
      for (std::uint32_t point = 0; point < points; ++point) {
        assemble_carried_contact(state, matrix, contact, contact_place(contact, tool, point, entry[0]), entry,
                                 tool.friction > 0);
      }
    }
  }
}

/// Stage 3: adds contacts to the linear system. Each row gathers from the triangles around it.
/// Reads contacts, frictions, velocity; adds to edges, diagonal, rhs.
template <class Team, class Real>
TM_HOST_DEVICE void assemble(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                             const view::MatrixView<Real>& matrix, const view::ContactView<Real>& contact) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  const bool carries = contact.carried.first < contact.triangle_count;
  team.for_each(contact.patch_surface[patch.index], contact.surface_end[patch.index], [&](std::uint32_t vertex) {
    const std::uint32_t row = contact.surface_rows[vertex];
    for (std::uint32_t t = 0; t < contact.tool_count; ++t) {
      const physics::PlacedTool<Real>& tool = contact.tools[t];
      const std::uint32_t points = tool.contact_points;
      for (std::uint32_t i = contact.incidence_begin[vertex]; i < contact.incidence_end[vertex]; ++i) {
        const std::uint32_t* incidence = contact.incidence + std::size_t{4} * i;
        for (std::uint32_t point = 0; point < points; ++point) {
          const std::size_t place = contact_place(contact, tool, point, incidence[0]);
          assemble_contact(state, matrix, contact, place, incidence, row, tool.friction > 0);
        }
      }
    }
    if (carries) assemble_carried(state, matrix, contact, vertex);
  });
  if (!carries) return;
  team.for_each(contact.carried.patch_rows[patch.index], contact.carried.patch_rows[patch.index + 1],
                [&](std::uint32_t i) { assemble_carried(state, matrix, contact, contact.vertex_count + i); });
}

}  // namespace tensormass::contact
