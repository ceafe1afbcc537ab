#pragma once

#include <cstdint>

/// Vectors and communication of conjugate gradients on Â x = b̂ (solver/conjugate_gradients.h).
namespace tensormass::view {

/// Reals from the sums of one patch to those of the next, at most. Every patch polls the sums of all others, and values
/// that lie close together come from few of a GPU's memory channels.
inline constexpr std::uint32_t kPatchSums = 16;

/// What the solve says of itself.
template <class Real>
struct SolveReport {
  Real relative_residual;
  std::uint32_t iterations;
  std::uint32_t negative_curvature;  // 1 if the iteration stopped on it
};

template <class Real>
struct SolveView {
  Real cg_tolerance;
  Real* solution;     // [row_count, 4] x
  Real* residual;     // [own + halo of every patch, 4]
  Real* direction;    // [own + halo of every patch, 4]
  Real* product;      // [2, row_count, 4] Â p by parity of the iteration; patches exchange at least the boundary rows
  Real* own_product;  // [row_count, 4] Â p of a matrix that stores edges, zero between iterations; else nullptr
  Real* reduction;    // partial sums of patches, room for [2, patch_count, kPatchSums]
  std::uint32_t* exchange_tags;  // [patch_count] exchanges so far; cells carry their number (backend/cuda)
  SolveReport<Real>* report;     // [1]
};

}  // namespace tensormass::view
