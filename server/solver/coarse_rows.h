#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>

#include "matrix/row_system.h"
#include "solver/coarse_level.h"
#include "solver/row_sums.h"
#include "view/coarse.h"
#include "view/scene.h"

/// The coarse level of coarse_level.h, with the row sums of row_sums.h, for a matrix that stores whole rows: on a GPU.
/// Those files define Z, Ẑ, E, c, y, d, e, R and δ. n: unknowns of the coarse system.
///
///   elements ──> e ──> contact ──> R, E ──> W ──> factorize, scale ──> δ ──> RowsCoarseLevel in conjugate_gradients.h
///
///   W    C⁻¹, the inverse of the Cholesky factor of E = C Cᵀ, a lower triangle of n × n
///   t    W c;  y = Wᵀ t,  c·y = t·t
///
/// Both triangles are stored row by row without gaps: W in `lower` and Wᵀ in `upper` of view::CoarseView.
///
/// 1. A row has all of its blocks, so each row forms its own sums, and no thread adds to another's.
/// 2. E has a team for each pair of aggregates that are coupled. Sums run in a fixed order: results repeat bitwise.
/// 3. A kernel of the GPU computes W from E. Triangular systems with C would take n steps, one after the other.
///    Products with W and Wᵀ take one each. M⁻¹ is positive definite whatever rounding does to W.
/// 4. Every patch computes t and y for itself, from the same sums in the same order. So an iteration communicates once.
namespace tensormass::solver {

/// Which rows and patches belong to an aggregate. An entry is a patch that has rows of an aggregate.
struct CoarseLists {
  std::uint32_t pair_count = 0;
  const std::uint32_t* pairs = nullptr;              // [pair, 2] coupled aggregates I ≥ J
  const std::uint32_t* aggregate_rows = nullptr;     // [aggregate + 1] into rows
  const std::uint32_t* rows = nullptr;               // rows by aggregate, ascending
  const std::uint32_t* slice_patch = nullptr;        // [slice] its patch
  const std::uint32_t* patch_entries = nullptr;      // [patch + 1] entries are grouped by patch
  const std::uint32_t* entry_aggregate = nullptr;    // [entry]
  const std::uint32_t* aggregate_entries = nullptr;  // [aggregate + 1] into entries
  const std::uint32_t* entries = nullptr;            // entries by aggregate, in the order of their patches
};

namespace detail {

/// Returns the upper triangle of a row's diagonal block as a matrix.
template <class Real>
TM_HOST_DEVICE Mat3<Real> diagonal_block(const view::MatrixView<Real>& matrix, std::uint32_t row) {
  const Real* d = matrix.diagonal + std::size_t{8} * row;
  Mat3<Real> block;
  block << d[0], d[1], d[2], d[1], d[3], d[4], d[2], d[4], d[5];
  return block;
}

/// Returns Σ_j A_ij of a row. free_only: leaves out columns of directions that are not free.
template <class Real>
TM_HOST_DEVICE Mat3<double> sum_of_row(const view::PatchesView& patches, const view::PatchColumns& patch,
                                       const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                       std::uint32_t row, bool free_only) {
  Mat3<double> sum = Mat3<double>::Zero();
  const auto add = [&](const Mat3<Real>& block, std::uint32_t other) {
    const std::uint32_t bits = free_only ? view::free_bits(state, other) : 7u;
    for (int j = 0; j < 3; ++j) {
      if ((bits >> j & 1) == 0) continue;
      for (int i = 0; i < 3; ++i) sum(i, j) += static_cast<double>(block(i, j));
    }
  };
  add(diagonal_block(matrix, row), row);
  view::for_each_slot(matrix, row, [&](std::size_t slot, std::uint32_t column) {
    const std::uint32_t other = view::global_row(patches, patch, column);
    if (other != row) add(view::load_block<Real>(matrix.edges, slot), other);  // else: padding
  });
  return sum;
}

}  // namespace detail

/// Computes e of the rows of a patch. Must run after the elements and before anything else adds to the matrix.
/// Reads edges, diagonal, inertia, mass_edges; writes row_errors.
template <class Team, class Real>
TM_HOST_DEVICE void measure_errors_of_rows(const Team& team, const view::PatchesView& patches,
                                           const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                           const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Mat3<double> sum = detail::sum_of_row(patches, patch, state, matrix, row, false);
    const matrix::RowTerms<Real> terms(state, row);
    auto mass = static_cast<double>(terms.mass * terms.mass_share());
    if (matrix.mass_edges != nullptr) {
      view::for_each_slot(matrix, row, [&](std::size_t slot, std::uint32_t) {
        mass += static_cast<double>(matrix.mass_edges[slot] * terms.mass_share());
      });
    }
    for (int c = 0; c < 9; ++c) {
      const double error = sum(c / 3, c % 3) - (c % 4 == 0 ? mass : 0);
      coarse.row_errors[std::size_t{9} * row + static_cast<std::size_t>(c)] = static_cast<Real>(error);
    }
  });
}

/// Computes R of the rows of a patch, before the matrix is scaled. Reads edges, diagonal, row_errors; writes row_sums.
template <class Team, class Real>
TM_HOST_DEVICE void sum_free_parts_of_rows(const Team& team, const view::PatchesView& patches,
                                           const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                           const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Mat3<double> sum = detail::sum_of_row(patches, patch, state, matrix, row, true);
    const std::size_t first = std::size_t{9} * row;
    for (int c = 0; c < 9; ++c) {
      const std::size_t at = first + static_cast<std::size_t>(c);
      coarse.row_sums[at] = sum(c / 3, c % 3) - static_cast<double>(coarse.row_errors[at]);
    }
  });
}

/// Computes δ of the rows of a patch, after the matrix is scaled. Reads edges, diagonal, row_sums; writes row_losses.
template <class Team, class Real>
TM_HOST_DEVICE void measure_losses_of_rows(const Team& team, const view::PatchesView& patches,
                                           const view::MatrixView<Real>& matrix, const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  const auto factor = [&](std::uint32_t row) { return detail::lower_factor(matrix.diagonal + std::size_t{8} * row); };
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Mat3<double> inverse = load_lower<Real>(matrix.diagonal, row).template cast<double>();
    Mat3<double> sum;
    for (int c = 0; c < 9; ++c) sum(c / 3, c % 3) = coarse.row_sums[std::size_t{9} * row + static_cast<std::size_t>(c)];
    Mat3<double> lost = inverse * sum;
    lost -= factor(row).transpose();
    view::for_each_slot(matrix, row, [&](std::size_t slot, std::uint32_t column) {
      const std::uint32_t other = view::global_row(patches, patch, column);
      if (other == row) return;  // padding
      const Mat3<double> block = view::load_block<Real>(matrix.edges, slot).template cast<double>();
      lost -= block * factor(other).transpose();
    });
    const Mat3<double> loss = lost * inverse.transpose();
    Real* const to = coarse.row_losses + std::size_t{view::kRowLossReals} * row;
    for (int c = 0; c < 9; ++c) to[c] = static_cast<Real>(loss(c / 3, c % 3));
  });
}

/// Computes the blocks of E of one pair of aggregates. Must run before the matrix is scaled.
/// Reads edges, diagonal, rest, displacement, row_errors; writes sums: [n, n], block triangle I ≥ J.
template <class Team, class Real>
TM_HOST_DEVICE void assemble_coarse_pair(const Team& team, std::uint32_t pair, const view::PatchesView& patches,
                                         const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                         const view::CoarseView<Real>& coarse, const CoarseLists& lists) {
  constexpr std::uint32_t kModes = view::kRigidModes;
  const std::uint32_t own = lists.pairs[2 * pair], other_aggregate = lists.pairs[2 * pair + 1];
  double sums[kModes * kModes] = {};
  const auto place = [&](std::uint32_t row, std::uint32_t aggregate) {
    return Vec3<double>(place_in_aggregate(state, coarse, row, aggregate).template cast<double>());
  };
  const auto free_part = [&](const Mat3<Real>& block, std::uint32_t row, std::uint32_t other) {
    return Mat3<double>(detail::free_part(state, block, row, other).template cast<double>());
  };
  team.for_each(lists.aggregate_rows[own], lists.aggregate_rows[own + 1], [&](std::uint32_t i) {
    const std::uint32_t row = lists.rows[i];
    const view::Patch patch = view::patch_of(patches, lists.slice_patch[row / view::kSliceRows]);
    detail::RowBlock<double> part;
    if (own == other_aggregate) {
      Mat3<Real> diagonal = detail::diagonal_block(matrix, row);
      for (int c = 0; c < 9; ++c) {
        diagonal(c / 3, c % 3) -= coarse.row_errors[std::size_t{9} * row + static_cast<std::size_t>(c)];
      }
      part.add(free_part(diagonal, row, row), place(row, own));
    }
    view::for_each_slot(matrix, row, [&](std::size_t slot, std::uint32_t column) {
      const std::uint32_t other = view::global_row(patches, patch, column);
      if (other == row || coarse.row_aggregate[other] != other_aggregate) return;
      part.add(free_part(view::load_block<Real>(matrix.edges, slot), row, other), place(other, other_aggregate));
    });
    part.add_to(sums, kModes, place(row, own));
  });
  team.patch_sum(sums);
  if (!team.leads_patch()) return;
  const std::size_t n = coarse_unknowns(coarse);
  double* const to = coarse.sums + kModes * (n * own + other_aggregate);
  for (std::uint32_t i = 0; i < kModes; ++i) {
    for (std::uint32_t j = 0; j < kModes; ++j) to[i * n + j] = sums[kModes * i + j];
  }
}

/// Reals of a triangle of W, and the places in it of W_kj (j ≤ k) and of (Wᵀ)_jk.
TM_HOST_DEVICE constexpr std::uint32_t triangle_reals(std::uint32_t unknowns) { return unknowns * (unknowns + 1) / 2; }
TM_HOST_DEVICE constexpr std::uint32_t lower_place(std::uint32_t k, std::uint32_t j) { return k * (k + 1) / 2 + j; }
TM_HOST_DEVICE constexpr std::uint32_t upper_place(std::uint32_t unknowns, std::uint32_t j, std::uint32_t k) {
  return j * unknowns - j * (j + 1) / 2 + k;
}

/// Calls use(i, Σ_j term(i, j)) for i < count, with j in [begin(i), end(i)). A team of many threads has each_sum of its
/// own. The results of `use` are visible after team.sync().
template <class Team, class Begin, class End, class Term, class Use>
TM_HOST_DEVICE void each_sum(const Team& team, std::uint32_t count, const Begin& begin, const End& end,
                             const Term& term, const Use& use) {
  if constexpr (requires { team.each_sum(count, begin, end, term, use); }) {
    team.each_sum(count, begin, end, term, use);
  } else {
    for (std::uint32_t i = 0; i < count; ++i) {
      auto sum = term(i, begin(i));
      for (std::uint32_t j = begin(i) + 1; j < end(i); ++j) sum += term(i, j);
      use(i, sum);
    }
  }
}

/// Returns Σ_i term(i), i < count, in every thread. Needs no synchronization.
template <class Team, class Term>
TM_HOST_DEVICE auto whole_sum(const Team& team, std::uint32_t count, const Term& term) {
  if constexpr (requires { team.whole_sum(count, term); }) {
    return team.whole_sum(count, term);
  } else {
    auto sum = term(0);
    for (std::uint32_t i = 1; i < count; ++i) sum += term(i);
    return sum;
  }
}

/// The coarse level as one patch sees it during a solve, for conjugate_gradients.h. All patches call the same functions
/// in the same order.
template <class Team, class Real>
class RowsCoarseLevel {
 public:
  static constexpr bool kExists = true;

  /// lower, upper: W and Wᵀ, those of `coarse` or a copy that is closer.
  /// vectors: [4, n] of the patch alone.
  TM_HOST_DEVICE RowsCoarseLevel(Team& team, const view::PatchesView& patches, const view::CoarseView<Real>& coarse,
                                 const CoarseLists& lists, const Real* lower, const Real* upper, Real* vectors)
      : team_(team),
        patches_(patches),
        patch_(view::patch_of(patches, team.patch())),
        coarse_(coarse),
        lists_(lists),
        unknowns_(static_cast<std::uint32_t>(coarse_unknowns(coarse))),
        lower_(lower),
        upper_(upper),
        rows_(coarse.rows + view::kCoarseRowReals * patch_.local_begin),
        c_(vectors),
        y_(c_ + unknowns_),
        d_(y_ + unknowns_),
        t_(d_ + unknowns_) {}

  /// Prepares the modes of the patch's rows and of its halo, and computes c and y of the residual r.
  /// Must run after the matrix is factorized. r: [own + halo, 4]
  TM_HOST_DEVICE void begin(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix, const Real* r) {
    team_.for_each(0, patch_.own() + patch_.halo_count, [&](std::uint32_t local) {
      const std::uint32_t row = view::global_row(patches_, patch_, local), aggregate = coarse_.row_aggregate[row];
      Real modes[11] = {};
      if (aggregate != view::kNoAggregate) {
        detail::factor_of(matrix.diagonal + std::size_t{8} * row, modes);
        const Vec3<Real> x = place_in_aggregate(state, coarse_, row, aggregate);
        for (int i = 0; i < 3; ++i) modes[8 + i] = x[i];
      }
      for (std::uint32_t i = 0; i < 11; ++i) rows_[std::size_t{view::kCoarseRowReals} * local + i] = modes[i];
    });
    publish(r, r, 1);
    team_.meet();
    collect(1, 0, c_);
    cy_ = solve();
  }
  /// Adds δ p to q = Â p of a row.
  TM_HOST_DEVICE void correct(std::uint32_t row, const Vec3<Real>& p, Vec3<Real>& q) const {
    const Real* const loss = coarse_.row_losses + std::size_t{view::kRowLossReals} * row;
    for (int i = 0; i < 3; ++i) q[i] += loss[3 * i] * p[0] + loss[3 * i + 1] * p[1] + loss[3 * i + 2] * p[2];
  }
  /// Publishes the patch's part of c = Ẑᵀ r and d = Ẑᵀ q. Call before the exchange of an iteration. r, q: [own, 4]
  TM_HOST_DEVICE void publish(const Real* r, const Real* q, std::uint32_t iteration) {
    constexpr std::uint32_t kModes = view::kRigidModes;
    team_.sync();  // other threads may have written to q
    const std::uint32_t end = lists_.patch_entries[patch_.index + 1];
    for (std::uint32_t entry = lists_.patch_entries[patch_.index]; entry < end; ++entry) {
      const std::uint32_t aggregate = lists_.entry_aggregate[entry];
      Real sums[2 * kModes] = {};
      team_.for_each(0, patch_.own(), [&](std::uint32_t local) {
        if (coarse_.row_aggregate[patch_.row_begin + local] != aggregate) return;
        const Real* const row = rows_ + std::size_t{view::kCoarseRowReals} * local;
        const Real* const x = row + 8;
        const auto add = [&](const Vec3<Real>& v, Real* to) {
          const Vec3<Real> f(row[0] * v[0], row[1] * v[0] + row[2] * v[1],
                             row[3] * v[0] + row[4] * v[1] + row[5] * v[2]);
          for (int i = 0; i < 3; ++i) to[i] += f[i];
          to[3] += x[1] * f[2] - x[2] * f[1];
          to[4] += x[2] * f[0] - x[0] * f[2];
          to[5] += x[0] * f[1] - x[1] * f[0];
        };
        add(view::load3<Real>(r, local), sums);
        add(view::load3<Real>(q, local), sums + kModes);
      });
      team_.patch_sum(sums);
      if (!team_.leads_patch()) continue;
      for (std::uint32_t i = 0; i < 2 * kModes; ++i) exchanged(iteration, entry)[i] = sums[i];
    }
  }
  /// Adds up c and d of all patches. Call after the exchange of an iteration.
  TM_HOST_DEVICE void receive(std::uint32_t iteration) {
    collect(iteration, 0, c_);
    collect(iteration, view::kRigidModes, d_);
    yd_ = whole_sum(team_, unknowns_, [&](std::uint32_t i) { return y_[i] * d_[i]; });
  }
  TM_HOST_DEVICE Real cy() const { return cy_; }  ///< c · y, which is r · z − r · r
  TM_HOST_DEVICE Real yd() const { return yd_; }  ///< y · d, which is p · q − r · q

  /// Takes a step along p: c' = c − α d, y' = E⁻¹ c'.
  TM_HOST_DEVICE void advance(Real alpha) {
    team_.for_each(0, unknowns_, [&](std::uint32_t i) { c_[i] -= alpha * d_[i]; });
    team_.sync();
    cy_ = solve();
  }
  /// Adds Ẑ y to a vector of the patch. p: [own + halo, 4]
  TM_HOST_DEVICE void add_modes(Real* p) const {
    team_.sync();  // other threads may have written to p
    team_.for_each(0, patch_.own() + patch_.halo_count, [&](std::uint32_t local) {
      const std::uint32_t aggregate = coarse_.row_aggregate[view::global_row(patches_, patch_, local)];
      if (aggregate == view::kNoAggregate) return;
      const Vec3<Real> moved =
          detail::motion<Real>(rows_ + std::size_t{view::kCoarseRowReals} * local, y_ + view::kRigidModes * aggregate);
      view::store3<Real>(p, local, Vec3<Real>(view::load3<Real>(p, local) + moved));
    });
    team_.sync();
  }

 private:
  TM_HOST_DEVICE Real* exchanged(std::uint32_t iteration, std::uint32_t entry) const {
    const std::uint32_t entries = lists_.patch_entries[patches_.patch_count];
    return coarse_.exchanged +
           view::kCoarseExchanged * view::kCoarseStride * (std::size_t{iteration & 1} * entries + entry);
  }
  /// Adds up one of the two vectors of all patches. first: where its modes begin in an entry.
  TM_HOST_DEVICE void collect(std::uint32_t iteration, std::uint32_t first, Real* total) const {
    team_.for_each(0, unknowns_, [&](std::uint32_t i) {
      const std::uint32_t aggregate = i / view::kRigidModes, mode = i % view::kRigidModes;
      Real sum = 0;
      for (std::uint32_t k = lists_.aggregate_entries[aggregate]; k < lists_.aggregate_entries[aggregate + 1]; ++k) {
        sum += exchanged(iteration, lists_.entries[k])[first + mode];
      }
      total[i] = sum;
    });
    team_.sync();
  }
  /// Computes t = W c and y = Wᵀ t, and returns c · y, computed as t · t, which cannot be negative.
  TM_HOST_DEVICE Real solve() const {
    const std::uint32_t n = unknowns_;
    const auto zero = [](std::uint32_t) { return 0u; };
    const auto itself = [](std::uint32_t i) { return i; };
    const auto next = [](std::uint32_t i) { return i + 1; };
    const auto all = [n](std::uint32_t) { return n; };
    each_sum(
        team_, n, zero, next, [&](std::uint32_t k, std::uint32_t j) { return lower_[lower_place(k, j)] * c_[j]; },
        [&](std::uint32_t k, Real sum) { t_[k] = sum; });
    team_.sync();
    each_sum(
        team_, n, itself, all, [&](std::uint32_t j, std::uint32_t k) { return upper_[upper_place(n, j, k)] * t_[k]; },
        [&](std::uint32_t j, Real sum) { y_[j] = sum; });
    const Real square = whole_sum(team_, n, [&](std::uint32_t k) { return t_[k] * t_[k]; });
    team_.sync();
    return square;
  }

  Team& team_;
  const view::PatchesView& patches_;
  const view::Patch patch_;
  const view::CoarseView<Real>& coarse_;
  const CoarseLists& lists_;
  const std::uint32_t unknowns_;
  const Real *const lower_, *const upper_;
  Real* const rows_;
  Real *const c_, *const y_, *const d_, *const t_;
  Real cy_ = 0, yd_ = 0;
};

}  // namespace tensormass::solver
