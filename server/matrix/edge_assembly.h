#pragma once

#include "matrix/edges.h"
#include "matrix/element_points.h"
#include "matrix/lagged_tangents.h"
#include "matrix/row_system.h"

/// Assembly of a matrix that stores edges (edges.h). One CPU thread assembles each patch:
///
///   begin_edges ──> A = mass, constant and kept tensors, b = inertia and the forces of these tensors
///   element_pass ─> for each group: A += h (β + h) K_kl, b += h (f − K (β v + d))
///
/// row_system.h derives the terms of A and b and defines the symbols. Other stages add gravity, loads and contact.
namespace tensormass::matrix {

/// Writes the part of A and b that no element pass computes: mass, and the constant tensors of linear laws. The element
/// passes then add theirs.
/// HasConstant: the scene has linear laws.
/// Reads constant tensors, displacement, velocity, base fields; writes edges, diagonal, rhs, internal_force.
template <bool HasConstant, class Team, class Real>
void begin_edges(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                 const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton) {
  const Patch patch = patch_of(patches, team.patch());
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const RowTerms<Real> terms(state, row);
    store_symmetric<Real>(matrix.diagonal, row, Mat3<Real>::Identity() * (terms.mass * terms.mass_share()));
    store3<Real>(matrix.rhs, row, terms.momentum_gap(row) * terms.mass);
    if (newton.internal_force != nullptr) store3<Real>(newton.internal_force, row, Vec3<Real>::Zero());
  }
  if (!HasConstant && matrix.mass_edges == nullptr) {
    if (matrix.kept_edges == nullptr) clear_edges(matrix, patch, matrix.edges);
    return;
  }
  for_each_edge(matrix, patch, [&](std::size_t slot, std::uint32_t local, std::uint32_t column, bool both) {
    const std::size_t row = std::size_t{patch.row_begin} + local, other = global_row(patches, patch, column);
    const RowTerms<Real> terms(state, row);
    Mat3<Real> block = Mat3<Real>::Zero();
    if constexpr (HasConstant) {
      const Mat3<Real> edge = load_edge(matrix.constant_edges, slot);
      block = edge * terms.stiffness_share();
      const Vec3<Real> stretch = load3<Real>(state.displacement, other) - load3<Real>(state.displacement, row);
      const Vec3<Real> ahead = stretch + terms.stretch_ahead(other) - terms.stretch_ahead(row);
      const auto add = [&](std::size_t to, const Mat3<Real>& of, Real sign) {
        store3<Real>(matrix.rhs, to, load3<Real>(matrix.rhs, to) - of * ahead * (sign * terms.h));
        Real* d = matrix.diagonal + 8 * to;
        for (int i = 0, c = 0; i < 3; ++i) {
          for (int j = i; j < 3; ++j, ++c) d[c] -= of(i, j) * terms.stiffness_share();
        }
        if (newton.internal_force == nullptr) return;
        store3<Real>(newton.internal_force, to, load3<Real>(newton.internal_force, to) - of * stretch * sign);
      };
      add(row, edge, 1);
      if (both) add(other, edge.transpose(), -1);
    }
    if (matrix.mass_edges != nullptr) {
      const Real shared = matrix.mass_edges[slot];
      block += Mat3<Real>::Identity() * (shared * terms.mass_share());
      const auto add = [&](std::size_t to, std::size_t from) {
        store3<Real>(matrix.rhs, to, load3<Real>(matrix.rhs, to) + terms.momentum_gap(from) * shared);
      };
      add(row, other);
      if (both) add(other, row);
    }
    store_edge<Real>(matrix.edges, slot, block);
  });
}

/// Writes that part with or without constant tensors, as the scene has them, and adds the kept tensors.
template <class Team, class Real>
void begin_edges(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                 const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton) {
  if (matrix.constant_edges != nullptr) {
    begin_edges<true>(team, patches, state, matrix, newton);
  } else {
    begin_edges<false>(team, patches, state, matrix, newton);
  }
  if (matrix.kept_edges == nullptr) return;
  using Lanes = typename Team::template Lanes<Real>;
  const Patch patch = patch_of(patches, team.patch());
  if (matrix.constant_edges == nullptr && matrix.mass_edges == nullptr) {
    add_kept<Lanes, false>(patches, state, matrix, patch);
  } else {
    add_kept<Lanes, true>(patches, state, matrix, patch);
  }
}

/// Evaluates the elements of a group that touch a patch and adds them to its rows and edges. Of a group with lagged
/// tangents it evaluates those that are due, before begin_edges, and changes what is kept of them.
/// Reads displacement, velocity, base fields, internal variables, kept tensors; adds to edges, diagonal, rhs,
/// internal_force; writes internal variables, kept tensors.
template <class Shape, class Law, class Team, class Real>
TM_FLATTEN void element_pass(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                             const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton,
                             const ElementView<Real>& e) {
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const ElementRange range = element_range(patches, e, team.patch());
  const Patch patch = patch_of(patches, team.patch());
  const Real internal_dt_s = internal_step(state, newton);
  const physics::Stiffness kind = stiffness_kind(state, newton);
  const bool lags = e.kept != nullptr;
  if (lags && e.begins_kept != 0 && state.control->refreshes_all != 0) clear_kept(matrix, patch);
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    if (!lags) prefetch_elements<Lanes, Shape>(matrix, e, first);
    Vec3<T> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(state, e, first, u);
    T due(0);
    if (lags) {
      due = elements_due<Lanes, Shape>(state, matrix, e, first, u);
      if (Lanes::largest(due) == 0) return;
    }
    physics::ElementTensors<Shape, T> tensors;
    for_each_point<Lanes, Shape, Law>(
        e, first, u, [&](const auto& gradients, const auto& f, auto& point, std::uint32_t q) {
          with_viscous_stress<Lanes, Law>(state, e, q, first, point, internal_dt_s, [&](const auto* memory) {
            physics::add_point<Shape, Law>(gradients, f, point, memory, kind, q == 0, tensors);
          });
        });
    const std::uint32_t count = minimum(range.end - first, std::uint32_t{Lanes::kWidth});
    if (lags) {
      keep_tensors<Lanes, Shape>(state, matrix, e, patch, first, count, due, u, tensors);
    } else {
      add_to_edges<Lanes, Shape>(state, matrix, newton, e, patch, first, count, tensors);
    }
  });
}

}  // namespace tensormass::matrix
