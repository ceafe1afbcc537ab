#pragma once

#include "core/scalar.h"
#include "matrix/edges.h"
#include "matrix/element_points.h"
#include "view/boundary.h"
#include "view/matrix.h"
#include "view/state.h"

namespace tensormass::step {

/// Adds gravity and constant loads to the right-hand side, if the matrix stores edges. On a GPU the stage that forms
/// the rows adds them (matrix::RowAssembly::finish).
/// Reads external; adds to rhs.
template <class Team, class Real>
TM_HOST_DEVICE void add_external_forces(const Team& team, const view::PatchesView& patches,
                                        const view::StateView<Real>& state, const view::MatrixView<Real>& matrix) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    view::store3<Real>(
        matrix.rhs, row,
        view::load3<Real>(matrix.rhs, row) + view::load3<Real>(state.external, row) * view::step_size(state));
  });
}

/// Adds pressure, which follows the surface:
///
///   f_k = −p A_k             A_k: area vector of node k in the deformed face (physics/element/face.h)
///   −∂f_k/∂x_l = p [g_kl]×   [g]× d = g × d
///
/// The forces are those at the displacement ahead, f_k + Σ_l ∂f_k/∂x_l d_l.
///
/// Conjugate gradients need a symmetric matrix. The stiffness of pressure is symmetric if the pressed surface is closed
/// or its rim is fixed. Only bodies of that kind add it (model/boundary_conditions.cpp). At a free rim Newton's method
/// takes fewer iterations without it than with its symmetric part. It is not positive semi-definite, so a projected
/// stiffness leaves it out.
/// Reads displacement, velocity; adds to edges, rhs.
template <class Team, class Real>
TM_HOST_DEVICE void add_pressure(const Team& team, const view::StateView<Real>& state,
                                 const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton,
                                 const view::PressureView<Real>& pressure) {
  const Real h = view::step_size(state);
  const bool adds_stiffness = matrix::stiffness_kind(state, newton) == physics::Stiffness::kConsistent;
  team.for_each(pressure.patch_begin[team.patch()], pressure.patch_begin[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = pressure.rows[i];
    Vec3<Real> force = Vec3<Real>::Zero();
    for (std::uint32_t c = pressure.corner_begin[i]; c < pressure.corner_begin[i + 1]; ++c) {
      const view::PressureFace<Real>& face = pressure.faces[pressure.corners[2 * c]];
      const int nodes = static_cast<int>(face.node_count), corner = static_cast<int>(pressure.corners[2 * c + 1]);
      Vec3<Real> x[physics::kMaxFaceNodes];
      for (int k = 0; k < nodes; ++k) x[k] = view::position(state, face.rows[k]);
      force -= physics::face_area_vector(x, nodes, corner) * face.pressure_pa;
      for (int l = 0; l < nodes; ++l) {
        const Vec3<Real> change = physics::face_area_change(x, nodes, corner, l);
        force -= change.cross(view::change_ahead(state, face.rows[l])) * face.pressure_pa;
        const std::uint32_t slot =
            pressure.slots[std::size_t{physics::kMaxFaceNodes} * c + static_cast<std::size_t>(l)];
        if (!adds_stiffness || slot == view::kNoPlace) continue;
        const Vec3<Real> symmetric = change - physics::face_area_change(x, nodes, l, corner);
        matrix::add_to_block<Real>(matrix, slot, cross_matrix(symmetric) * (h * h * face.pressure_pa / 2));
      }
    }
    view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + force * h);
  });
}

}  // namespace tensormass::step
