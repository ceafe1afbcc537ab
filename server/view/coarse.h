#pragma once

#include <cstdint>

/// The coarse level of the linear solve (solver/coarse_level.h): six rigid modes of each aggregate of rows.
namespace tensormass::view {

/// Rigid modes of an aggregate: three translations, then three rotations about its centre.
inline constexpr std::uint32_t kRigidModes = 6;
/// Most aggregates of a scene. E then has 192 unknowns: its factorization takes about as long as ten iterations.
inline constexpr std::uint32_t kMaxAggregates = 32;
/// An aggregate that stands for none: the row has no rigid modes.
inline constexpr std::uint32_t kNoAggregate = 0xFFFFFFFFu;
/// Reals of a row that the modes need: L as (00, 10, 11, 20, 21, 22) and two of padding, then its place relative to the
/// aggregate's centre, in units of the aggregate's size, and five of padding.
inline constexpr std::uint32_t kCoarseRowReals = 16;
/// Reals of one aggregate in a coarse vector: its six modes, and two of padding.
inline constexpr std::uint32_t kCoarseStride = 8;

/// Reals of a row's δ (solver/row_sums.h), row by row, and three of padding.
inline constexpr std::uint32_t kRowLossReals = 12;

/// Stands beside the scene, as element groups do: only a solve with a coarse level reads it. All pointers are null
/// without aggregates.
///
///   n   unknowns of the coarse system: kRigidModes · aggregate_count
template <class Real>
struct CoarseView {
  std::uint32_t aggregate_count;       // 0: the scene has no coarse level
  const std::uint32_t* row_aggregate;  // [row_count] aggregate, or kNoAggregate
  const std::uint32_t* center_rows;    // [aggregate] row nearest to its centroid at rest: centre of its rotations
  const Real* inverse_sizes;           // [aggregate] 1/m; makes rotations as large as translations

  double* sums;          // [patch_count, n, n] part of E that the rows of a patch contribute; block triangle I ≥ J
  double* factor;        // [n, n] E, then its Cholesky factor C
  Real* lower;           // [n, n] C, row by row, with zeros above the diagonal
  Real* upper;           // [n, n] Cᵀ, row by row
  Real* inverse_pivots;  // [n] 1 / C_kk; 0: the mode is left out
  Real* rows;            // [own + halo of every patch, kCoarseRowReals]
  Real* exchanged;   // [2, patch_count, kCoarseExchanged, kCoarseStride · aggregate_count] by parity of the iteration
  double* row_sums;  // [row_count, 9] sums of blocks, row by row (solver/row_sums.h)
  Real* row_errors;  // [row_count, 9] e
  Real* row_losses;  // [row_count, kRowLossReals] δ
  Real* vectors;     // [patch_count, kCoarseVectors, kCoarseStride · aggregate_count] solver/coarse_level.h
};
/// Coarse vectors that patches exchange in an iteration: their parts of Ẑᵀ r and Ẑᵀ q.
inline constexpr std::uint32_t kCoarseExchanged = 2;
/// Coarse vectors of a patch: c, y, d, and one to solve in.
inline constexpr std::uint32_t kCoarseVectors = 4;

}  // namespace tensormass::view
