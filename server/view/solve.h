#pragma once

#include <cstdint>

/// Vectors and communication of conjugate gradients on Â x = b̂ (solver/conjugate_gradients.h).
namespace tensormass::view {

/// Distance between the sums of two patches [reals], at most. Every patch polls the sums of all others. Values that lie
/// close together would come from few of a GPU's memory channels.
inline constexpr std::uint32_t kPatchSums = 16;

/// Report of the last solve.
template <class Real>
struct SolveReport {
  Real relative_residual;
  std::uint32_t iterations;
  std::uint32_t negative_curvature;  // 1 if the iteration stopped on it
  // x·Âx that the solve had gained [J] after a half and three quarters of the iterations that it may take, and at its
  // end. The first two are not written before (solver/missing_energy.h).
  Real gained_energy[3];
};

template <class Real>
struct SolveView {
  Real cg_tolerance;
  Real* solution;     // [row_count, 4] x
  Real* kept;         // [2, row_count, 4] x of the last good step and of a later one; nullptr: Newton's method iterates
  Real* residual;     // [own + halo of every patch, 4]
  Real* direction;    // [own + halo of every patch, 4]
  Real* product;      // [2, row_count, 4] Â p by parity of the iteration; patches exchange at least the boundary rows
  Real* own_product;  // [row_count, 4] Â p of a matrix that stores edges, zero between iterations; else nullptr
  Real* reduction;    // partial sums of patches, room for [2, patch_count, kPatchSums]
  std::uint32_t* exchange_tags;  // [patch_count] number of exchanges so far (backend/cuda/exchange.cuh)
  SolveReport<Real>* report;     // [1]
};

}  // namespace tensormass::view
