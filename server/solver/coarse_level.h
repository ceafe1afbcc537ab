#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "matrix/edges.h"
#include "solver/jacobi_scaling.h"
#include "view/coarse.h"
#include "view/scene.h"

/// A coarse level for conjugate gradients: a preconditioner that knows the rigid motion of pieces of a body.
///
///   aggregate   a compact piece of a body (model/aggregates.cpp); every row belongs to at most one
///   Z_i         3×6, rigid modes of row i's aggregate at the row: u = t + ω × x_i, zero in its fixed directions
///   x_i         present position relative to the aggregate's centre, over the aggregate's size
///   Ẑ_i         L_iᵀ Z_i, the modes in the scaled system (solver/jacobi_scaling.h)
///   E           Ẑᵀ Â Ẑ = Σ Z_iᵀ A_ij Z_j, a dense matrix of 6 unknowns an aggregate
///   M⁻¹         I + Ẑ E⁻¹ Ẑᵀ, the preconditioner: block-Jacobi, and the coarse level added (Nicolaides 1987; two-level
///               additive Schwarz in Toselli & Widlund 2005, chapter 3)
///
///   assemble_coarse ──> factorize_coarse ──> CoarseLevel, one for each patch, in conjugate_gradients.h
///   E of a patch's rows   C Cᵀ = Σ E           c = Ẑᵀ r,  y = E⁻¹ c,  z = r + Ẑ y
///
/// Why: block-Jacobi moves information by one element an iteration. A stiff, slender body bends as a whole in a step,
/// so it needs hundreds of iterations. Its pieces move almost rigidly, and E holds how they pull at each other.
///
/// 1. M⁻¹ is positive definite whatever E is, as long as C is real. Modes that hardly resist are left out: their pivots
///    are below kLeastPivot of the diagonal.
/// 2. An iteration still communicates once. Ẑᵀ q and Ẑᵀ r of the patches travel with the other sums, and c' = Ẑᵀ r −
///    α Ẑᵀ q. Ẑᵀ r is summed anew each time, as r·r is. By recurrence alone c drifts away from r, and E⁻¹ multiplies
///    the difference: solves of nearly incompressible tissue then ended with numbers that were not finite.
/// 3. Links between bodies are left out of E, except for their part of the diagonal blocks.
/// 4. E is formed in double precision from the blocks as they are stored, before they are scaled.
/// 5. In float the blocks' rounding errors alone would leave a ligament half off. So a solve with a coarse level
///    corrects each row's product by δ (row_sums.h).
///
/// One CPU thread runs a patch here. docs/decisions/preconditioner.md has iterations and times.
namespace tensormass::solver {

/// A pivot below this share of its diagonal element leaves its mode out of the coarse level.
inline constexpr double kLeastPivot = 1e-6;

/// Unknowns of the coarse system.
template <class Real>
TM_HOST_DEVICE std::size_t coarse_unknowns(const view::CoarseView<Real>& coarse) {
  return std::size_t{view::kRigidModes} * coarse.aggregate_count;
}

/// Returns the place of a row in its aggregate: x_i.
template <class Real>
TM_HOST_DEVICE Vec3<Real> place_in_aggregate(const view::StateView<Real>& state, const view::CoarseView<Real>& coarse,
                                             std::uint32_t row, std::uint32_t aggregate) {
  const Vec3<Real> center = view::position(state, coarse.center_rows[aggregate]);
  return (view::position(state, row) - center) * coarse.inverse_sizes[aggregate];
}

namespace detail {

/// Returns m · (−[x]×): how a matrix acts on rotations about the centre.
template <class Real>
TM_HOST_DEVICE Mat3<Real> times_rotations(const Mat3<Real>& m, const Vec3<Real>& x) {
  Mat3<Real> out;
  for (int i = 0; i < 3; ++i) {
    out(i, 0) = m(i, 2) * x[1] - m(i, 1) * x[2];
    out(i, 1) = m(i, 0) * x[2] - m(i, 2) * x[0];
    out(i, 2) = m(i, 1) * x[0] - m(i, 0) * x[1];
  }
  return out;
}

/// One row's part of a 6×6 block: Z_iᵀ (A Z_j), from A Z_j = (moved, turned).
template <class Real>
struct RowBlock {
  Mat3<Real> moved = Mat3<Real>::Zero(), turned = Mat3<Real>::Zero();

  /// Adds the coupling to a row at x of its aggregate.
  TM_HOST_DEVICE void add(const Mat3<Real>& a, const Vec3<Real>& x) {
    moved += a;
    turned += times_rotations(a, x);
  }
  /// Adds Z_iᵀ (A Z_j) to a block of E. x: place of row i. transposes: adds its transpose instead.
  TM_HOST_DEVICE void add_to(double* block, std::size_t stride, const Vec3<Real>& x, bool transposes = false) const {
    for (int j = 0; j < 6; ++j) {
      const Vec3<Real> column = j < 3 ? Vec3<Real>(moved.col(j)) : Vec3<Real>(turned.col(j - 3));
      const Vec3<Real> torque = x.cross(column);
      for (int i = 0; i < 6; ++i) {
        const Real value = i < 3 ? column[i] : torque[i - 3];
        const int to_row = transposes ? j : i, to_column = transposes ? i : j;
        block[static_cast<std::size_t>(to_row) * stride + static_cast<std::size_t>(to_column)] +=
            static_cast<double>(value);
      }
    }
  }
};

/// Returns a block without the rows and columns of directions that are not free.
template <class Real>
TM_HOST_DEVICE Mat3<Real> free_part(const view::StateView<Real>& state, const Mat3<Real>& block, std::uint32_t row,
                                    std::uint32_t other) {
  const std::uint32_t bits = view::free_bits(state, row), other_bits = view::free_bits(state, other);
  if ((bits & other_bits) == 7) return block;
  Mat3<Real> part = block;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if ((bits >> i & 1) == 0 || (other_bits >> j & 1) == 0) part(i, j) = 0;
    }
  }
  return part;
}

/// Computes L from L⁻¹, both as (00, 10, 11, 20, 21, 22). Fixed directions have zeros in both.
template <class Real>
TM_HOST_DEVICE void factor_of(const Real* m, Real* l) {
  const auto inverse = [](Real value) { return value != 0 ? 1 / value : Real(0); };
  l[0] = inverse(m[0]);
  l[2] = inverse(m[2]);
  l[5] = inverse(m[5]);
  l[1] = -m[1] * l[0] * l[2];
  l[4] = -m[4] * l[2] * l[5];
  l[3] = -(m[3] * l[0] + m[4] * l[1]) * l[5];
}

/// Returns Ẑ_i y = Lᵀ (t + ω × x). row: kCoarseRowReals of the row. y: six modes of its aggregate.
template <class Scalar>
TM_HOST_DEVICE Vec3<Scalar> motion(const Scalar* row, const Scalar* y) {
  const Scalar *x = row + 8, *w = y + 3;
  const Vec3<Scalar> u(y[0] + w[1] * x[2] - w[2] * x[1], y[1] + w[2] * x[0] - w[0] * x[2],
                       y[2] + w[0] * x[1] - w[1] * x[0]);
  return {row[0] * u[0] + row[1] * u[1] + row[3] * u[2], row[2] * u[1] + row[4] * u[2], row[5] * u[2]};
}

}  // namespace detail

/// Computes the part of E that the rows of a patch contribute. Must run before the matrix is scaled. The matrix must
/// store edges.
/// Reads edges, diagonal, rest, displacement; writes sums.
template <class Team, class Real>
void assemble_coarse(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                     const view::MatrixView<Real>& matrix, const view::CoarseView<Real>& coarse) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  const std::size_t unknowns = coarse_unknowns(coarse);
  double* const sums = coarse.sums + unknowns * unknowns * patch.index;
  std::fill(sums, sums + unknowns * unknowns, 0.0);
  const auto block_of = [&](std::uint32_t i, std::uint32_t j) { return sums + view::kRigidModes * (unknowns * i + j); };
  const auto free_part = [&](const Mat3<Real>& block, std::uint32_t row, std::uint32_t other) {
    return detail::free_part(state, block, row, other);
  };
  constexpr std::uint32_t kHeight = matrix::kEdgeSliceRows;
  for (std::uint32_t row = patch.row_begin; row < patch.row_end; ++row) {
    const std::uint32_t own = coarse.row_aggregate[row];
    if (own == view::kNoAggregate) continue;
    const Vec3<Real> x = place_in_aggregate(state, coarse, row, own);
    // `once` has blocks that are stored for both rows of a pair. The diagonal and blocks of the halo are not.
    detail::RowBlock<Real> within, once;
    const Real* d = matrix.diagonal + std::size_t{8} * row;
    Mat3<Real> diagonal;
    diagonal << d[0], d[1], d[2], d[1], d[3], d[4], d[2], d[4], d[5];
    for (int c = 0; c < 9; ++c) diagonal(c / 3, c % 3) -= coarse.row_errors[std::size_t{9} * row + c];
    within.add(free_part(diagonal, row, row), x);
    const std::uint32_t slice = row / kHeight;
    for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
      const std::size_t slot = std::size_t{j} * kHeight + row % kHeight;
      const std::uint32_t other = view::global_row(patches, patch, matrix.columns[slot]);
      const std::uint32_t aggregate = coarse.row_aggregate[other];
      if (aggregate == view::kNoAggregate || other == row) continue;
      const bool both = j < matrix.slice_halo[slice];
      const Mat3<Real> part = free_part(matrix::load_edge(matrix.edges, slot), row, other);
      const Vec3<Real> place = place_in_aggregate(state, coarse, other, aggregate);
      if (aggregate == own) {
        (both ? once : within).add(part, place);
      } else if (both || aggregate < own) {
        detail::RowBlock<Real> apart;
        apart.add(part, place);
        const bool above = aggregate > own;
        apart.add_to(above ? block_of(aggregate, own) : block_of(own, aggregate), unknowns, x, above);
      }
    }
    within.add_to(block_of(own, own), unknowns, x);
    once.add_to(block_of(own, own), unknowns, x);
    once.add_to(block_of(own, own), unknowns, x, true);
  }
}

/// Factorizes E = C Cᵀ, in one thread. Reads sums; writes factor, lower, upper, inverse_pivots.
template <class Team, class Real>
void factorize_coarse(const Team& team, const view::PatchesView& patches, const view::CoarseView<Real>& coarse) {
  if (!team.leads()) return;
  const std::size_t n = coarse_unknowns(coarse);
  double* const c = coarse.factor;
  std::copy(coarse.sums, coarse.sums + n * n, c);
  for (std::size_t patch = 1; patch < patches.patch_count; ++patch) {
    const double* const more = coarse.sums + patch * n * n;
    for (std::size_t i = 0; i < n * n; ++i) c[i] += more[i];
  }
  // Column by column. A finished column is also a row of `upper`, where it lies side by side.
  double column[view::kRigidModes * view::kMaxAggregates];
  for (std::size_t k = 0; k < n; ++k) coarse.inverse_pivots[k] = static_cast<Real>(c[k * n + k]);
  for (std::size_t k = 0; k < n; ++k) {
    const double pivot = c[k * n + k];
    const bool kept = pivot > kLeastPivot * static_cast<double>(coarse.inverse_pivots[k]);
    const double inverse = kept ? 1 / std::sqrt(pivot) : 0;
    coarse.inverse_pivots[k] = static_cast<Real>(inverse);
    for (std::size_t i = k; i < n; ++i) column[i] = c[i * n + k] * inverse;
    for (std::size_t i = k + 1; i < n; ++i) {
      double* const row = c + i * n;
      const double factor = column[i];
      for (std::size_t j = k + 1; j <= i; ++j) row[j] -= factor * column[j];
    }
    for (std::size_t i = 0; i < n; ++i) {
      coarse.upper[k * n + i] = i >= k ? static_cast<Real>(column[i]) : Real(0);
      coarse.lower[i * n + k] = coarse.upper[k * n + i];
    }
  }
}

/// Stands for no coarse level in conjugate_gradients.
struct NoCoarseLevel {
  static constexpr bool kExists = false;
};

/// The coarse level as one patch sees it during a solve. All patches call the same functions in the same order.
template <class Team, class Real>
class CoarseLevel {
 public:
  static constexpr bool kExists = true;
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;

  CoarseLevel(Team& team, const view::PatchesView& patches, const view::CoarseView<Real>& coarse)
      : team_(team),
        patches_(patches),
        patch_(view::patch_of(patches, team.patch())),
        coarse_(coarse),
        size_(std::size_t{view::kCoarseStride} * coarse.aggregate_count),
        rows_(coarse.rows + view::kCoarseRowReals * patch_.local_begin),
        c_(coarse.vectors + view::kCoarseVectors * size_ * patch_.index),
        y_(c_ + size_),
        d_(y_ + size_),
        solving_(d_ + size_) {}

  /// Prepares the modes of the patch's rows and of its halo, and computes c and y of the residual r.
  /// Must run after the matrix is factorized. r: [own + halo, 4]
  void begin(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix, const Real* r) {
    for (std::uint32_t local = 0; local < patch_.own() + patch_.halo_count; ++local) {
      const std::uint32_t row = view::global_row(patches_, patch_, local);
      Real* const to = rows_ + std::size_t{view::kCoarseRowReals} * local;
      std::fill(to, to + view::kCoarseRowReals, Real(0));
      const std::uint32_t aggregate = coarse_.row_aggregate[row];
      if (aggregate == view::kNoAggregate) continue;
      detail::factor_of(matrix.diagonal + std::size_t{8} * row, to);
      const Vec3<Real> x = place_in_aggregate(state, coarse_, row, aggregate);
      for (int i = 0; i < 3; ++i) to[8 + i] = x[i];
    }
    publish(r, 1, kResidual);
    team_.meet();
    collect(1, kResidual, c_);
    cy_ = solve(c_, y_);
  }
  /// Adds δ p to q = Â p of the patch (row_sums.h). p: [own + halo, 4]; q: [own, 4]
  void correct(const Real* p, Real* q) const {
    const Real* const losses = coarse_.row_losses + std::size_t{view::kRowLossReals} * patch_.row_begin;
    for (std::uint32_t local = 0; local < patch_.own(); local += Lanes::kWidth) {
      T loss[9];
      Lanes::gather_records(
          loss, [&](std::uint32_t lane) { return losses + std::size_t{view::kRowLossReals} * (local + lane); });
      const Vec3<T> v = Lanes::load3(p, local);
      Vec3<T> sum = Lanes::load3(q, local);
      for (int i = 0; i < 3; ++i) sum[i] += loss[3 * i] * v[0] + loss[3 * i + 1] * v[1] + loss[3 * i + 2] * v[2];
      Lanes::store3(q, local, sum);
    }
  }
  /// Publishes the patch's part of c = Ẑᵀ r and d = Ẑᵀ q. Call before the exchange of an iteration. r, q: [own, 4]
  void publish(const Real* r, const Real* q, std::uint32_t iteration) {
    publish(r, iteration, kResidual);
    publish(q, iteration, kProduct);
  }
  /// Adds up c and d of all patches. Call after the exchange of an iteration.
  void receive(std::uint32_t iteration) {
    collect(iteration, kResidual, c_);
    collect(iteration, kProduct, d_);
    yd_ = 0;
    for (std::size_t i = 0; i < size_; ++i) yd_ += y_[i] * d_[i];
  }
  Real cy() const { return cy_; }  ///< c · y, which is r · z − r · r
  Real yd() const { return yd_; }  ///< y · d, which is p · q − r · q

  /// Takes a step along p: c' = c − α d, y' = E⁻¹ c'.
  void advance(Real alpha) {
    for (std::size_t i = 0; i < size_; ++i) c_[i] -= alpha * d_[i];
    cy_ = solve(c_, y_);
  }
  /// Adds Ẑ y to a vector of the patch. p: [own + halo, 4]
  void add_modes(Real* p) const {
    for (std::uint32_t local = 0; local < patch_.own(); local += Lanes::kWidth) {
      T row[view::kCoarseRowReals], y[view::kCoarseStride];
      load_rows(local, row);
      Lanes::gather_records(y, [&](std::uint32_t lane) { return y_ + aggregate_of(local + lane); });
      Lanes::store3(p, local, Vec3<T>(Lanes::load3(p, local) + detail::motion<T>(row, y)));
    }
    for (std::uint32_t local = patch_.own(); local < patch_.own() + patch_.halo_count; ++local) {
      const Real* row = rows_ + std::size_t{view::kCoarseRowReals} * local;
      view::store3<Real>(p, local,
                         Vec3<Real>(view::load3<Real>(p, local) + detail::motion<Real>(row, y_ + aggregate_of(local))));
    }
  }

 private:
  /// The two coarse vectors of an iteration that patches exchange: Ẑᵀ r and Ẑᵀ q.
  enum Exchanged : std::uint32_t { kResidual, kProduct };

  /// Publishes the patch's part of Ẑᵀ v. v: [own, 4]
  void publish(const Real* v_of_rows, std::uint32_t iteration, Exchanged which) {
    Real* const to = exchanged(iteration, patch_.index, which);
    std::fill(to, to + size_, Real(0));
    for (std::uint32_t local = 0; local < patch_.own(); local += Lanes::kWidth) {
      T row[view::kCoarseRowReals];
      load_rows(local, row);
      const Vec3<T> v = Lanes::load3(v_of_rows, local);
      const Vec3<T> f(row[0] * v[0], row[1] * v[0] + row[2] * v[1], row[3] * v[0] + row[4] * v[1] + row[5] * v[2]);
      const T* x = row + 8;
      T modes[view::kCoarseStride] = {
          f[0], f[1], f[2], x[1] * f[2] - x[2] * f[1], x[2] * f[0] - x[0] * f[2], x[0] * f[1] - x[1] * f[0],
          T(0), T(0)};
      alignas(64) Real records[Lanes::kWidth * view::kCoarseStride];
      Lanes::scatter(records, view::kCoarseStride, modes);
      for (std::uint32_t lane = 0; lane < Lanes::kWidth; ++lane) {
        Real* const sum = to + aggregate_of(local + lane);
        for (std::uint32_t i = 0; i < view::kCoarseStride; ++i) sum[i] += records[lane * view::kCoarseStride + i];
      }
    }
  }
  void load_rows(std::uint32_t local, T (&row)[view::kCoarseRowReals]) const {
    Lanes::gather_records(
        row, [&](std::uint32_t lane) { return rows_ + std::size_t{view::kCoarseRowReals} * (local + lane); });
  }
  /// Place of a row's aggregate in a coarse vector. A row without one has modes that are zero, so it may take any.
  std::size_t aggregate_of(std::uint32_t local) const {
    const std::uint32_t aggregate = coarse_.row_aggregate[view::global_row(patches_, patch_, local)];
    return aggregate == view::kNoAggregate ? 0 : std::size_t{view::kCoarseStride} * aggregate;
  }
  Real* exchanged(std::uint32_t iteration, std::uint32_t patch, Exchanged which) const {
    return coarse_.exchanged +
           ((std::size_t{iteration & 1} * patches_.patch_count + patch) * view::kCoarseExchanged + which) * size_;
  }
  void collect(std::uint32_t iteration, Exchanged which, Real* total) const {
    std::copy_n(exchanged(iteration, 0, which), size_, total);
    for (std::uint32_t patch = 1; patch < patches_.patch_count; ++patch) {
      const Real* const part = exchanged(iteration, patch, which);
      for (std::size_t i = 0; i < size_; ++i) total[i] += part[i];
    }
  }
  /// Solves E y = c and returns c · y, computed as |C⁻¹ c|², which cannot be negative.
  Real solve(const Real* c, Real* y) const {
    const std::size_t n = coarse_unknowns(coarse_);
    Real* const t = solving_;
    for (std::size_t i = 0; i < n; ++i) t[i] = c[padded(i)];
    Real square = 0;
    for (std::size_t k = 0; k < n; ++k) {
      const Real value = t[k] * coarse_.inverse_pivots[k];
      const Real* const column = coarse_.upper + k * n;
      for (std::size_t i = k + 1; i < n; ++i) t[i] -= column[i] * value;
      t[k] = value;
      square += value * value;
    }
    for (std::size_t k = n; k-- > 0;) {
      const Real value = t[k] * coarse_.inverse_pivots[k];
      const Real* const row = coarse_.lower + k * n;
      for (std::size_t i = 0; i < k; ++i) t[i] -= row[i] * value;
      y[padded(k)] = value;
    }
    return square;
  }
  static std::size_t padded(std::size_t unknown) {
    return unknown / view::kRigidModes * view::kCoarseStride + unknown % view::kRigidModes;
  }

  Team& team_;
  const view::PatchesView& patches_;
  const view::Patch patch_;
  const view::CoarseView<Real>& coarse_;
  const std::size_t size_;
  Real* const rows_;
  Real *const c_, *const y_, *const d_, *const solving_;
  Real cy_ = 0, yd_ = 0;
};

}  // namespace tensormass::solver
