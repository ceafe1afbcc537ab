#pragma once

#include <cmath>

#include "matrix/edges.h"
#include "view/scene.h"

/// Block-Jacobi preconditioning, folded into the matrix.
///
///   A, b, Δv         the system of the step, A Δv = b (matrix/row_system.h)
///   D_i = L_i L_iᵀ   Cholesky factorization of the diagonal block of row i
///   s_i              weight of the body of row i, see 3
///
///   Â_ij = L_i⁻¹ A_ij L_j⁻ᵀ,   b̂_i = s_i L_i⁻¹ b_i,   Δv_i = L_i⁻ᵀ x_i / s_i
///
///   diagonal ── factorize ───> L⁻¹
///   rhs ─────── factorize ───> b̂ ──┐
///   edges ───── scale_edges ─> Â ──┴─> conjugate_gradients ──> x ── unscaled ──> Δv
///
/// 1. Â has unit diagonal blocks, so the iteration needs neither a diagonal nor a preconditioned residual.
/// 2. A fixed direction of a row gets zeros in L⁻¹. That takes its row, its column and its right-hand side out of the
///    system without a branch.
/// 3. s is one number for each body. The matrix couples no rows of two bodies, so Â does not depend on s. The iteration
///    ends at a fraction of ‖b̂‖. With s = 1 that is the residual's D⁻¹ norm, in which a body counts by its mass. A
///    light body beside a heavy one would then stay unsolved. With s² = (largest density of the scene) / (the body's
///    density), a body counts by its volume. Without inertia s = 1. Links couple rows of two bodies (link_product.h),
///    so a scene with links has s = 1 as well.
namespace tensormass::solver {

/// Computes L⁻¹ of a block.
/// d: the block's upper triangle, xx xy xz yy yz zz.
/// out: L⁻¹ as (00, 10, 11, 20, 21, 22). A pivot that is not above 1e-7 of the block's trace, for example because of
/// rounding, is replaced by that bound.
template <class Real>
TM_HOST_DEVICE void inverse_cholesky(const Real* d, Real* out) {
  const Real floor = (d[0] + d[3] + d[5]) * Real(1e-7);
  const auto pivot = [&](Real value) {
    return inverse_square_root(value > floor ? value : (floor > 0 ? floor : Real(1)));
  };
  const Real i0 = pivot(d[0]);
  const Real l10 = d[1] * i0, l20 = d[2] * i0;
  const Real i1 = pivot(d[3] - l10 * l10);
  const Real l21 = (d[4] - l20 * l10) * i1;
  const Real i2 = pivot(d[5] - l20 * l20 - l21 * l21);
  const Real m10 = -l10 * i0 * i1;
  out[0] = i0;
  out[1] = m10;
  out[2] = i1;
  out[3] = -(l20 * i0 + l21 * m10) * i2;
  out[4] = -l21 * i1 * i2;
  out[5] = i2;
}

/// The 3×3 matrix L⁻¹ from the six reals that inverse_cholesky writes.
template <class Real>
TM_HOST_DEVICE Mat3<Real> lower(const Real* p) {
  Mat3<Real> m;
  m << p[0], 0, 0, p[1], p[2], 0, p[3], p[4], p[5];
  return m;
}
template <class Real>
TM_HOST_DEVICE Mat3<Real> load_lower(const Real* diagonal, std::size_t row) {
  return lower(diagonal + 8 * row);
}

/// s of a row.
template <class Real>
TM_HOST_DEVICE Real body_weight(const view::StateView<Real>& state, std::size_t row) {
  return state.inertia[4 * row + 3];
}

/// Computes L⁻¹ of a row whose diagonal block has the upper triangle `d`, with zeros in the directions that are not
/// free.
template <class Real>
TM_HOST_DEVICE void inverse_factor(const Real* d, std::uint32_t free_bits, Real* out) {
  const Real x = free_bits & 1, y = free_bits >> 1 & 1, z = free_bits >> 2 & 1;       // 1 in the free directions
  const Real free[6] = {d[0], x * y * d[1], x * z * d[2], d[3], y * z * d[4], d[5]};  // fixed ones decoupled
  inverse_cholesky(free, out);
  out[0] *= x;
  out[1] *= x * y;
  out[2] *= y;
  out[3] *= x * z;
  out[4] *= y * z;
  out[5] *= z;
}

/// b̂ of a row. factor: its L⁻¹.
template <class Real>
TM_HOST_DEVICE Vec3<Real> scaled_rhs(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                     std::size_t row, const Mat3<Real>& factor) {
  return factor * view::load3<Real>(matrix.rhs, row) * body_weight(state, row);
}

/// Δv of a row from its x. factor: its L⁻¹.
template <class Real>
TM_HOST_DEVICE Vec3<Real> unscaled(const view::StateView<Real>& state, std::size_t row, const Mat3<Real>& factor,
                                   const Vec3<Real>& x) {
  const Real weight = body_weight(state, row);
  const Vec3<Real> weighted = factor.transpose() * x;
  return {quotient(weighted[0], weight), quotient(weighted[1], weight), quotient(weighted[2], weight)};
}

/// Replaces diagonal by L⁻¹ and rhs by b̂.
template <class Team, class Real>
TM_HOST_DEVICE void factorize(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                              const view::MatrixView<Real>& matrix) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    Real* d = matrix.diagonal + std::size_t{8} * row;
    Real inverse[6];
    inverse_factor(d, view::free_bits(state, row), inverse);
    for (int c = 0; c < 6; ++c) d[c] = inverse[c];
    view::store3<Real>(matrix.rhs, row, scaled_rhs(state, matrix, row, lower(inverse)));
  });
}

/// Replaces A_ij by L_i⁻¹ A_ij L_j⁻ᵀ. block: row by row; l_i, l_j: the six reals of L⁻¹.
template <class T>
TM_HOST_DEVICE void scale_block(const T* l_i, T* block, const T* l_j) {
  for (int c = 0; c < 3; ++c) {
    const T x = block[c], y = block[3 + c], z = block[6 + c];
    block[c] = l_i[0] * x;
    block[3 + c] = l_i[1] * x + l_i[2] * y;
    block[6 + c] = l_i[3] * x + l_i[4] * y + l_i[5] * z;
  }
  for (int r = 0; r < 9; r += 3) {
    const T x = block[r], y = block[r + 1], z = block[r + 2];
    block[r] = x * l_j[0];
    block[r + 1] = x * l_j[1] + y * l_j[2];
    block[r + 2] = x * l_j[3] + y * l_j[4] + z * l_j[5];
  }
}

/// Replaces the edges of a patch by Â_ij and moves the components of a block apart, as multiply_edges reads them.
template <class Lanes, class Real>
TM_FLATTEN void scale_edge_slices(const view::PatchesView& patches, const view::MatrixView<Real>& matrix,
                                  const view::Patch& patch) {
  using T = typename Lanes::Scalar;
  using matrix::kEdgeSliceRows;
  constexpr std::uint32_t kTile = 9 * kEdgeSliceRows;
  for (std::uint32_t slice = patch.row_begin / kEdgeSliceRows; slice < patch.row_end / kEdgeSliceRows; ++slice) {
    for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
      Real blocks[kTile];
      Real* tile = matrix.edges + std::size_t{j} * kTile;
      std::memcpy(blocks, tile, sizeof blocks);
      for (std::uint32_t first = 0; first < kEdgeSliceRows; first += Lanes::kWidth) {
        const std::uint32_t* columns = matrix.columns + std::size_t{j} * kEdgeSliceRows + first;
        T own[8], other[8], block[9];
        Lanes::gather_records(own, [&](std::uint32_t lane) {
          return matrix.diagonal + std::size_t{8} * (slice * kEdgeSliceRows + first + lane);
        });
        Lanes::gather_records(other, [&](std::uint32_t lane) {
          return matrix.diagonal + std::size_t{8} * view::global_row(patches, patch, columns[lane]);
        });
        Lanes::gather_records(block, [&](std::uint32_t lane) { return blocks + 9 * (first + lane); });
        scale_block(own, block, other);
        for (std::uint32_t c = 0; c < 9; ++c) Lanes::store(tile + c * kEdgeSliceRows + first, block[c]);
      }
    }
  }
}

/// Replaces edges by Â_ij.
template <class Team, class Real>
TM_HOST_DEVICE void scale_edges(const Team& team, const view::PatchesView& patches,
                                const view::MatrixView<Real>& matrix) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  if constexpr (requires { Team::kOneThread; }) {
    if (matrix::stores_edges(matrix))
      return scale_edge_slices<typename Team::template Lanes<Real>>(patches, matrix, patch);
  }
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Mat3<Real> own = load_lower<Real>(matrix.diagonal, row);
    view::for_each_slot(matrix, row, [&](std::size_t slot, std::uint32_t column) {
      const Mat3<Real> other = load_lower<Real>(matrix.diagonal, view::global_row(patches, patch, column));
      const Mat3<Real> left = own * view::load_block<Real>(matrix.edges, slot);
      view::store_block<Real>(matrix.edges, slot, left * other.transpose());
    });
  });
}

}  // namespace tensormass::solver
