#pragma once

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

/// Adds the forces of pressure, which follow the surface. The matrix leaves out their derivative, which would make it
/// unsymmetric.
/// Reads displacement; adds to rhs.
template <class Team, class Real>
TM_HOST_DEVICE void add_pressure(const Team& team, const view::StateView<Real>& state,
                                 const view::MatrixView<Real>& matrix, const view::PressureView<Real>& pressure) {
  team.for_each(pressure.patch_begin[team.patch()], pressure.patch_begin[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t row = pressure.rows[i];
    Vec3<Real> force = Vec3<Real>::Zero();
    for (std::uint32_t c = pressure.corner_begin[i]; c < pressure.corner_begin[i + 1]; ++c) {
      const view::PressureFace<Real>& face = pressure.faces[pressure.corners[2 * c]];
      Vec3<Real> x[physics::kMaxFaceNodes];
      for (std::uint32_t k = 0; k < face.node_count; ++k) x[k] = view::position(state, face.rows[k]);
      force -= physics::face_area_vector(x, static_cast<int>(face.node_count),
                                         static_cast<int>(pressure.corners[2 * c + 1])) *
               face.pressure_pa;
    }
    view::store3<Real>(matrix.rhs, row, view::load3<Real>(matrix.rhs, row) + force * view::step_size(state));
  });
}

}  // namespace tensormass::step
