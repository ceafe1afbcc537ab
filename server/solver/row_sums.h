#pragma once

#include <algorithm>
#include <cstdint>

#include "matrix/edges.h"
#include "matrix/row_system.h"
#include "solver/jacobi_scaling.h"
#include "view/coarse.h"
#include "view/scene.h"

/// Row sums of the matrix, which rounding must not change.
///
///   S_i   Σ_j A_ij: what row i feels if all rows move alike. Elements contribute nothing to it, only mass and contact
///   do e_i   what rounding adds to S_i during the assembly of elements [kg] R_i   Σ_j A_ij P_j − e_i, the exact sum
///   over free directions (P_j is 1 in these, else 0) δ_i   L_i⁻¹ R_i L_i⁻ᵀ − Σ_j Â_ij L_jᵀ L_i⁻ᵀ: what the rounded
///   blocks of Â lack
///
///   elements ──> measure_row_errors ──> contact ──> sum_free_rows ──> factorize, scale ──> measure_row_losses
///                e                                  R                                      δ
///
/// Why: a row is the difference of blocks that are larger than its sum by dt² E / (ρ h²), 10⁵ to 10⁷ in a ligament. In
/// float their rounding errors resist rigid motion as springs to the ground would. A solve to the last digit is then
/// half off. With δ_i added to row i of Â, rows that move alike feel what they should.
///
/// All sums are in double precision. Only for a matrix that stores edges; one CPU thread runs a patch.
namespace tensormass::solver {

namespace detail {

/// Adds the blocks of all rows of a patch. to: [row_count, 9] row by row. free_only: leaves out columns of directions
/// that are not free.
template <class Real>
void sum_rows(const view::PatchesView& patches, const view::Patch& patch, const view::StateView<Real>& state,
              const view::MatrixView<Real>& matrix, bool free_only, double* to) {
  const auto bits_of = [&](std::uint32_t row) { return free_only ? view::free_bits(state, row) : 7u; };
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const Real* d = matrix.diagonal + std::size_t{8} * row;
    const int place[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
    const std::uint32_t bits = bits_of(row);
    for (int c = 0; c < 9; ++c) to[std::size_t{9} * row + c] = (bits >> (c % 3) & 1) != 0 ? d[place[c]] : Real(0);
  }
  matrix::for_each_edge(matrix, patch, [&](std::size_t slot, std::uint32_t local, std::uint32_t column, bool both) {
    if (column == local) return;  // padding
    const std::uint32_t row = patch.row_begin + local, other = view::global_row(patches, patch, column);
    const Real* block = matrix.edges + matrix::edge_begin(slot);
    const std::uint32_t bits = bits_of(row), other_bits = bits_of(other);
    for (int c = 0; c < 9; ++c) {
      if ((other_bits >> (c % 3) & 1) != 0) to[std::size_t{9} * row + c] += static_cast<double>(block[c]);
      const int transposed = c % 3 * 3 + c / 3;
      if (both && (bits >> (c / 3) & 1) != 0) to[std::size_t{9} * other + transposed] += static_cast<double>(block[c]);
    }
  });
}

/// Returns L as a matrix from the six reals of L⁻¹. Fixed directions have zeros in both.
template <class Real>
TM_HOST_DEVICE Mat3<double> lower_factor(const Real* inverse) {
  const auto reciprocal = [](Real value) { return value != 0 ? 1 / static_cast<double>(value) : 0.0; };
  const double m1 = inverse[1], m3 = inverse[3], m4 = inverse[4];
  const double l0 = reciprocal(inverse[0]), l2 = reciprocal(inverse[2]), l5 = reciprocal(inverse[5]);
  const double l1 = -m1 * l0 * l2, l4 = -m4 * l2 * l5;
  Mat3<double> l;
  l << l0, 0, 0, l1, l2, 0, -(m3 * l0 + m4 * l1) * l5, l4, l5;
  return l;
}

}  // namespace detail

/// Computes e of the rows of a patch. Must run after the elements and before anything else adds to the matrix.
/// Reads edges, diagonal, inertia, mass_edges; writes row_sums, row_errors.
template <class Team, class Real>
void measure_row_errors(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                        const view::MatrixView<Real>& matrix, const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  double* const sums = coarse.row_sums;
  detail::sum_rows(patches, patch, state, matrix, false, sums);
  const auto take_mass = [&](std::uint32_t row, double mass) {
    for (int c = 0; c < 9; c += 4) sums[std::size_t{9} * row + c] -= mass;
  };
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const matrix::RowTerms<Real> terms(state, row);
    take_mass(row, static_cast<double>(terms.mass * terms.mass_share()));
  }
  if (matrix.mass_edges != nullptr) {
    matrix::for_each_edge(matrix, patch, [&](std::size_t slot, std::uint32_t local, std::uint32_t column, bool both) {
      const std::uint32_t row = patch.row_begin + local;
      const matrix::RowTerms<Real> terms(state, row);
      const auto mass = static_cast<double>(matrix.mass_edges[slot] * terms.mass_share());
      take_mass(row, mass);
      if (both) take_mass(view::global_row(patches, patch, column), mass);
    });
  }
  for (std::size_t i = std::size_t{9} * patch.row_begin; i < std::size_t{9} * patch.row_end; ++i) {
    coarse.row_errors[i] = static_cast<Real>(sums[i]);
  }
}

/// Computes R of the rows of a patch, before the matrix is scaled. Reads edges, diagonal, row_errors; writes row_sums.
template <class Team, class Real>
void sum_free_rows(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                   const view::MatrixView<Real>& matrix, const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  detail::sum_rows(patches, patch, state, matrix, true, coarse.row_sums);
  for (std::size_t i = std::size_t{9} * patch.row_begin; i < std::size_t{9} * patch.row_end; ++i) {
    coarse.row_sums[i] -= static_cast<double>(coarse.row_errors[i]);
  }
}

/// Computes δ of the rows of a patch, after the matrix is scaled. Reads edges, diagonal, row_sums; writes row_sums,
/// row_losses.
template <class Team, class Real>
void measure_row_losses(const Team& team, const view::PatchesView& patches, const view::MatrixView<Real>& matrix,
                        const view::CoarseView<Real>& coarse) {
  using matrix::kEdgeSliceRows;
  using RowMajor = Eigen::Matrix<double, 3, 3, Eigen::RowMajor>;
  const view::Patch patch = view::patch_of(patches, team.patch());
  const auto sum = [&](std::uint32_t row) { return Eigen::Map<RowMajor>(coarse.row_sums + std::size_t{9} * row); };
  const auto factor = [&](std::uint32_t row) { return detail::lower_factor(matrix.diagonal + std::size_t{8} * row); };
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const Mat3<double> inverse = load_lower<Real>(matrix.diagonal, row).template cast<double>();
    sum(row) = (inverse * sum(row) - factor(row).transpose()).eval();
  }
  matrix::for_each_edge(matrix, patch, [&](std::size_t slot, std::uint32_t local, std::uint32_t column, bool both) {
    if (column == local) return;  // padding
    const std::uint32_t row = patch.row_begin + local, other = view::global_row(patches, patch, column);
    const Real* block = matrix.edges + slot / kEdgeSliceRows * (9 * kEdgeSliceRows) + slot % kEdgeSliceRows;
    Mat3<double> scaled;
    for (int c = 0; c < 9; ++c) scaled(c / 3, c % 3) = static_cast<double>(block[c * static_cast<int>(kEdgeSliceRows)]);
    sum(row) -= scaled * factor(other).transpose();
    if (both) sum(other) -= scaled.transpose() * factor(row).transpose();
  });
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const Mat3<double> inverse = load_lower<Real>(matrix.diagonal, row).template cast<double>();
    const Mat3<double> loss = sum(row) * inverse.transpose();
    Real* const to = coarse.row_losses + std::size_t{view::kRowLossReals} * row;
    for (int c = 0; c < 9; ++c) to[c] = static_cast<Real>(loss(c / 3, c % 3));
  }
}

}  // namespace tensormass::solver
