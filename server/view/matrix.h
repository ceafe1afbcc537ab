#pragma once

#include "view/patches.h"

/// The linear system of a step, A Δv = b, as a sliced ELLPACK matrix (Kreutzer et al. 2014).
///
/// kSliceRows neighbouring rows form a slice that is as wide as its longest row. A GPU warp and a CPU vector register
/// both walk a slice along its rows, column by column:
///
///              column 0   column 1   column 2
///   row  0        .          .          .       slot = column · kSliceRows + row within the slice
///   row  1        .          .       padding    each slot holds a 3×3 block and names a patch-local column
///   ...
///   row 31        .       padding    padding
///
/// Three storages share this structure (matrix/layout.h chooses): whole rows, whole rows ordered by tiles
/// (matrix/tiles.h), and edges that are stored once (matrix/edges.h, with slices of only kEdgeSliceRows rows).
namespace tensormass::view {

inline constexpr std::uint32_t kNoPlace = 0xFFFFFFFFu;

template <class Real>
struct MatrixView {
  const std::uint32_t* slice_begin;  // [slices + 1], in columns of slots
  const std::uint32_t* columns;      // [slot] patch-local: own rows, then halo; padding slots name the row itself

  // Tiles; nullptr otherwise.
  std::uint32_t tile_rows;
  const std::uint32_t* slice_read;  // [slices] end of the columns that a solve must read
  const std::uint32_t* used_twice;  // [column] bit of each lane whose block also serves the row that it names

  // Edges; nullptr otherwise.
  const std::uint32_t* slice_halo;      // [slices] where the halo of a slice starts
  const std::uint32_t* patch_boundary;  // [patch_count + 1] into boundary
  const std::uint32_t* boundary;        // patch-local rows in the halo of another patch

  // Constant parts, computed when the scene is compiled.
  const Real* constant_edges;        // [slot] 3×3 tensors of the linear laws
  const Real* mass_edges;            // [slot] kg, consistent mass off the diagonal; nullptr: lumped
  const std::uint8_t* begun_slices;  // [row_count / kSliceRows] 1: edges hold K, rhs holds forces of elements

  // Lagged tangents (matrix/lagged_tangents.h); nullptr: every element is evaluated in each step.
  Real lag_strain;              // an element is evaluated again once its F has changed by more
  Real* kept_edges;             // [slot] 3×3 tensors K_kl of the lagged groups [N/m]
  Real* kept_force;             // [row_count, 4] their forces if nothing were displaced [N]
  Real* kept_diagonal;          // [row_count, 8] K_kk, as `diagonal`; with edges only
  Real* kept_ahead;             // [own rows and halo of each patch, 4] for the product with them [m]; with edges only
  std::uint32_t* kept_touched;  // [slice] 1: an element at its rows was evaluated in this step; without edges only

  // The system. Scaling turns it into Â x = b̂ with Â = L⁻¹ A L⁻ᵀ, b̂ = s L⁻¹ b (solver/jacobi_scaling.h).
  Real* edges;     // [slot] 3×3
  Real* diagonal;  // [row_count, 8]: upper triangle of A_ii, after `factorize` L⁻¹; 6 used
  Real* rhs;       // [row_count, 4]
};

/// Index of the first component of a slot's 3×3 block. Its nine components lie kSliceRows apart. A matrix that stores
/// edges has edge_begin instead.
TM_HOST_DEVICE constexpr std::size_t block_begin(std::size_t slot) {
  return slot / kSliceRows * (9 * kSliceRows) + slot % kSliceRows;
}
template <class Real>
TM_HOST_DEVICE Mat3<Real> load_block(const Real* blocks, std::size_t slot) {
  const Real* p = blocks + block_begin(slot);
  Mat3<Real> m;
  for (int c = 0; c < 9; ++c) m(c / 3, c % 3) = p[c * kSliceRows];
  return m;
}
/// Loads a block that the step reads only once, past the cache.
template <class Real>
TM_HOST_DEVICE Mat3<Real> load_block_once(const Real* blocks, std::size_t slot) {
  const Real* p = blocks + block_begin(slot);
  Mat3<Real> m;
  for (int c = 0; c < 9; ++c) m(c / 3, c % 3) = read_once(p + c * kSliceRows);
  return m;
}
template <class Real>
TM_HOST_DEVICE void store_block(Real* blocks, std::size_t slot, const Mat3<Real>& m) {
  Real* p = blocks + block_begin(slot);
  for (int c = 0; c < 9; ++c) p[c * kSliceRows] = m(c / 3, c % 3);
}

/// Calls visit(slot, column) for each slot of a row.
template <class Real, class Visit>
TM_HOST_DEVICE void for_each_slot(const MatrixView<Real>& matrix, std::uint32_t row, Visit&& visit) {
  const std::uint32_t slice = row / kSliceRows;
  for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
    const std::size_t slot = std::size_t{j} * kSliceRows + row % kSliceRows;
    visit(slot, matrix.columns[slot]);
  }
}

/// Stores the upper triangle of a symmetric block, 8 reals a row: xx xy xz yy yz zz.
template <class Real>
TM_HOST_DEVICE void store_symmetric(Real* diagonal, std::uint32_t row, const Mat3<Real>& m) {
  Real* p = diagonal + std::size_t{8} * row;
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(Real) == 4) {
    reinterpret_cast<float4*>(p)[0] = {m(0, 0), m(0, 1), m(0, 2), m(1, 1)};
    reinterpret_cast<float2*>(p)[2] = {m(1, 2), m(2, 2)};
    return;
  }
#endif
  p[0] = m(0, 0);
  p[1] = m(0, 1);
  p[2] = m(0, 2);
  p[3] = m(1, 1);
  p[4] = m(1, 2);
  p[5] = m(2, 2);
}

}  // namespace tensormass::view
