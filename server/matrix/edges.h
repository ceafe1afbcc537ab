#pragma once

#include <cmath>
#include <cstring>
#include <type_traits>

#include "physics/element/element.h"
#include "view/scene.h"

/// A matrix that stores edges, for patches that one CPU thread runs.
///
///   A_ij    3×3 block that couples the rows i and j;  A_ji = A_ijᵀ
///   edge    a pair of coupled rows; its block is A_ij
///   slot    column · kEdgeSliceRows + row within the slice: where a block is stored
///   place   2 · slot, + 1 if the slot holds the transpose of the block that an element computes
///
/// 1. The matrix is symmetric, so each block off the diagonal is needed only once. A product reads A_ij and uses it for
///    both rows. This halves the bytes that an iteration reads.
/// 2. An edge between two patches is stored in both. A patch therefore writes only to its own rows.
/// 3. Either of two rows may store their edge. make_layout balances the edges, so that all rows of a slice store about
///    equally many.
/// 4. Elements add to the matrix one after the other, directly: there are no element records and no gather maps. During
///    assembly the nine components of a block therefore lie side by side, row by row. scale_edges then moves them
///    kEdgeSliceRows apart, as the solver's lanes read them.
///
/// Slices are kEdgeSliceRows rows high, which is a vector register of floats. The columns of slice i are
///
///     slice_begin[i]               slice_halo[i]              slice_begin[i + 1]
///     │ A_ij, used for i and j     │ A_ih, used for i only     │
///     │ edges within the patch     │ edges to the halo         │
namespace tensormass::matrix {

using namespace view;

inline constexpr std::uint32_t kEdgeSliceRows = 8;

/// Index of the first component of a slot's block during assembly.
TM_HOST_DEVICE constexpr std::size_t edge_begin(std::size_t slot) { return 9 * slot; }

/// Whether the matrix stores edges. Otherwise each row stores all of its blocks.
template <class Real>
TM_HOST_DEVICE bool stores_edges(const view::MatrixView<Real>& matrix) {
  return matrix.slice_halo != nullptr;
}

template <class Real>
Mat3<Real> load_edge(const Real* blocks, std::size_t slot) {
  return Eigen::Map<const Eigen::Matrix<Real, 3, 3, Eigen::RowMajor>>(blocks + edge_begin(slot));
}
template <class Real>
void store_edge(Real* blocks, std::size_t slot, const Mat3<Real>& m) {
  Eigen::Map<Eigen::Matrix<Real, 3, 3, Eigen::RowMajor>>(blocks + edge_begin(slot)) = m;
}

/// Adds to a block of the system during assembly, in every storage.
template <class Real>
TM_HOST_DEVICE void add_to_block(const view::MatrixView<Real>& matrix, std::size_t slot, const Mat3<Real>& m) {
  if (stores_edges(matrix)) {
    for (int c = 0; c < 9; ++c) matrix.edges[edge_begin(slot) + c] += m(c / 3, c % 3);
  } else {
    store_block<Real>(matrix.edges, slot, load_block<Real>(matrix.edges, slot) + m);
  }
}

/// Calls visit for each slot of a patch, padding included.
///
///   visit(slot, row, column, both)   row, column: patch-local;  both: the edge is used for both rows
template <class Real, class Visit>
void for_each_edge(const view::MatrixView<Real>& matrix, const Patch& patch, const Visit& visit) {
  for (std::uint32_t slice = patch.row_begin / kEdgeSliceRows; slice < patch.row_end / kEdgeSliceRows; ++slice) {
    for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
      for (std::uint32_t lane = 0; lane < kEdgeSliceRows; ++lane) {
        const std::size_t slot = std::size_t{j} * kEdgeSliceRows + lane;
        visit(slot, slice * kEdgeSliceRows + lane - patch.row_begin, matrix.columns[slot],
              j < matrix.slice_halo[slice]);
      }
    }
  }
}

/// Sets the blocks of a patch to zero, as they lie during assembly.
template <class Real>
void clear_edges(const view::MatrixView<Real>& matrix, const Patch& patch, Real* blocks) {
  const std::size_t begin = std::size_t{matrix.slice_begin[patch.row_begin / kEdgeSliceRows]} * kEdgeSliceRows;
  const std::size_t end = std::size_t{matrix.slice_begin[patch.row_end / kEdgeSliceRows]} * kEdgeSliceRows;
  std::memset(blocks + edge_begin(begin), 0, (edge_begin(end) - edge_begin(begin)) * sizeof(Real));
}

namespace detail {

/// Adds the first eight components of a block, or of its transpose, to `to`, row by row. It has no branch: whether a
/// block is transposed is practically random, so the processor could not predict it.
template <class Real>
void add_eight(Real* to, const Real* block, std::uint32_t transposed) {
  typedef Real Eight __attribute__((vector_size(8 * sizeof(Real))));
  using Index = std::conditional_t<sizeof(Real) == 4, std::int32_t, std::int64_t>;
  typedef Index Order __attribute__((vector_size(8 * sizeof(Index))));
  static constexpr Index kOrders[2][8] = {{0, 1, 2, 3, 4, 5, 6, 7}, {0, 3, 6, 1, 4, 7, 2, 5}};
  Order order;
  Eight sum, added;
  std::memcpy(&order, kOrders[transposed], sizeof order);
  std::memcpy(&sum, to, sizeof sum);
  std::memcpy(&added, block, sizeof added);
  sum += __builtin_shuffle(added, order);
  std::memcpy(to, &sum, sizeof sum);
}

template <std::uint32_t Count, class Real>
void add_reals(Real* to, const Real* from) {
  for (std::uint32_t c = 0; c < Count; ++c) to[c] += from[c];
}

}  // namespace detail

/// Prefetches what the elements from `first` on will need soon. They read more streams than the processor follows by
/// itself, and their blocks are spread over the matrix. Inlining is forced: GCC 12 takes a function that only
/// prefetches for one without effect and drops its calls.
template <class Lanes, class Shape, class Real>
[[gnu::always_inline]] inline void prefetch_elements(const view::MatrixView<Real>& matrix, const ElementView<Real>& e,
                                                     std::uint32_t first) {
  constexpr std::uint32_t kBlocksAhead = 16, kStreamsAhead = 64;  // elements; blocks need their places first
  if (first + kStreamsAhead >= e.count) return;
  constexpr std::uint32_t kPairs = physics::kPairs<Shape::kNodes>;
  const std::size_t ahead = first + kStreamsAhead;
  for (std::uint32_t k = 0; k < Shape::kNodes; ++k) __builtin_prefetch(e.rows + std::size_t{k} * e.count + ahead);
  for (std::uint32_t c = 0; Shape::kSinglePoint && c < physics::kRestReals<Shape>; ++c) {
    __builtin_prefetch(e.rest + std::size_t{c} * e.count + ahead);
  }
  for (std::uint32_t pair = 0; pair < kPairs; ++pair) {
    const std::uint32_t* places = e.pair_places + std::size_t{pair} * e.count + first;
    __builtin_prefetch(places + kStreamsAhead);
    for (std::uint32_t lane = kBlocksAhead; lane < kBlocksAhead + Lanes::kWidth; ++lane) {
      __builtin_prefetch(matrix.edges + edge_begin(places[lane] / 2), 1);  // kNoPlace: a bad address, harmless
    }
  }
}

/// Adds the contributions of some elements to A and b (matrix/row_system.h) to the rows and edges of a patch. Nodes and
/// edges of other patches are skipped.
/// count: elements from `first` on, at most Lanes::kWidth.
template <class Lanes, class Shape, class Real>
void add_to_edges(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                  const view::NewtonView<Real>& newton, const ElementView<Real>& e, const Patch& patch,
                  std::uint32_t first, std::uint32_t count,
                  const physics::ElementTensors<Shape, typename Lanes::Scalar>& tensors) {
  using T = typename Lanes::Scalar;
  constexpr std::uint32_t kNodes = Shape::kNodes, kPairs = physics::kPairs<Shape::kNodes>;
  // An element's record. Each field starts at a multiple of eight reals and is written and read as whole vectors:
  //
  //   0        8 a node   its part of the diagonal block, as MatrixView::diagonal stores it
  //   kEdges   8 a pair   the first eight components of its part of A_kl
  //   kRhs     4 a node   b
  //   kNinths  1 a pair   the ninth component of A_kl
  //   kForces  4 a node   f, for Newton's method
  constexpr std::uint32_t kEdges = 8 * kNodes, kRhs = kEdges + 8 * kPairs, kNinths = kRhs + (kNodes + 1) / 2 * 8;
  constexpr std::uint32_t kForces = kNinths + (kPairs + 7) / 8 * 8, kRecord = kForces + (kNodes + 1) / 2 * 8;
  const auto rows = [&](std::uint32_t k) { return e.rows + std::size_t{k} * e.count + first; };
  const T h = T(step_size(state));
  // Mass, α and β of a row lie side by side. All nodes of an element belong to one body and have its damping.
  const T beta = Lanes::gather3(state.inertia, rows(0))[2];
  const T stiffness_share = h * (beta + h);
  Vec3<T> ahead[kNodes], rhs[kNodes];  // β v + d, as RowTerms::stretch_ahead
  for (std::uint32_t k = 0; k < kNodes; ++k) {
    const Vec3<T> velocity = Lanes::gather3(state.velocity, rows(k));
    ahead[k] = velocity * (h + beta);
    if (state.base_displacement != nullptr) {
      ahead[k] += Lanes::gather3(state.base_displacement, rows(k)) - Lanes::gather3(state.displacement, rows(k));
    }
    rhs[k] = tensors.force[k];
  }
  T record[kRecord];
  for (std::uint32_t c = kRhs; c < kRecord; ++c) record[c] = T(0);
  for (std::uint32_t k = 0; k < kNodes; ++k) {
    for (std::uint32_t c = 0; c < 8; ++c) record[8 * k + c] = T(0);
  }
  for (std::uint32_t k = 0, pair = 0; k < kNodes; ++k) {
    for (std::uint32_t l = k + 1; l < kNodes; ++l, ++pair) {
      const Mat3<T>& edge = tensors.edge_stiffness[pair];
      // K_kk = −Σ K_kl, so K d of a node is the sum over its edges of K_kl (d_l − d_k).
      const Vec3<T> change = ahead[l] - ahead[k];
      rhs[k] -= edge * change;
      rhs[l] += edge.transpose() * change;
      const Mat3<T> share = edge * stiffness_share;
      T *diagonal_k = record + 8 * k, *diagonal_l = record + 8 * l;
      for (int i = 0, c = 0; i < 3; ++i) {
        for (int j = i; j < 3; ++j, ++c) {
          diagonal_k[c] -= share(i, j);
          diagonal_l[c] -= share(j, i);
        }
      }
      for (int c = 0; c < 8; ++c) record[kEdges + 8 * pair + static_cast<std::uint32_t>(c)] = share(c / 3, c % 3);
      record[kNinths + pair] = share(2, 2);
    }
  }
  for (std::uint32_t k = 0; k < kNodes; ++k) {
    for (std::uint32_t c = 0; c < 3; ++c) {
      record[kRhs + 4 * k + c] = rhs[k][c] * h;
      record[kForces + 4 * k + c] = tensors.force[k][c];
    }
  }
  alignas(64) Real records[Lanes::kWidth * kRecord];
  Lanes::scatter(records, kRecord, record);

  for (std::uint32_t lane = 0; lane < count; ++lane) {
    const Real* from = records + lane * kRecord;
    for (std::uint32_t k = 0; k < kNodes; ++k) {
      const std::size_t row = rows(k)[lane];
      if (row - patch.row_begin >= patch.own()) continue;  // another patch's row; the difference wraps
      detail::add_reals<4>(matrix.rhs + 4 * row, from + kRhs + 4 * k);
      detail::add_reals<8>(matrix.diagonal + 8 * row, from + 8 * k);
      if (newton.internal_force != nullptr)
        detail::add_reals<4>(newton.internal_force + 4 * row, from + kForces + 4 * k);
    }
    for (std::uint32_t pair = 0; pair < kPairs; ++pair) {
      const std::uint32_t place = e.pair_places[std::size_t{pair} * e.count + first + lane];
      if (place == kNoPlace) continue;
      Real* to = matrix.edges + edge_begin(place / 2);
      detail::add_eight(to, from + kEdges + 8 * pair, place % 2);
      to[8] += from[kNinths + pair];
    }
  }
}

/// Publishes q of the rows that other patches read, and adds the patch's part to p · q (`pq`) and q · q (`qq`). Both
/// sums use the finished q. Summed edge by edge, p · q would add up terms that cancel in q. It would lose the digits
/// that an ill-conditioned matrix leaves it.
template <class Lanes, class Real>
void publish_product(const view::MatrixView<Real>& matrix, const Patch& patch, const Real* p, const Real* q,
                     Real* product, typename Lanes::Scalar& pq, typename Lanes::Scalar& qq) {
  using T = typename Lanes::Scalar;
  for (std::uint32_t i = matrix.patch_boundary[patch.index]; i < matrix.patch_boundary[patch.index + 1]; ++i) {
    store3<Real>(product, patch.row_begin + matrix.boundary[i], load3<Real>(q, matrix.boundary[i]));
  }
  for (std::uint32_t c = 0; c < 4 * patch.own(); c += Lanes::kWidth) {
    const T component = Lanes::load(q + c);
    pq += Lanes::load(p + c) * component;
    qq += component * component;
  }
}

/// Computes q = Â p on the rows of a patch, after scale_edges.
/// p: patch-local, own rows and then the halo.
/// q: own rows only; must be zero before.
template <class Lanes, class Real>
void multiply_edges(const view::MatrixView<Real>& matrix, const Patch& patch, const Real* p, Real* q) {
  using T = typename Lanes::Scalar;
  for (std::uint32_t local = 0; local < patch.own(); local += Lanes::kWidth) {
    const std::uint32_t slice = (patch.row_begin + local) / kEdgeSliceRows, lane = local % kEdgeSliceRows;
    const Vec3<T> own = Lanes::load3(p, local);
    Vec3<T> sum = own;  // the unit diagonal
    const auto multiply = [&](std::uint32_t j, auto&& use) {
      const Real* block = matrix.edges + std::size_t{j} * (9 * kEdgeSliceRows) + lane;
      const std::uint32_t* columns = matrix.columns + std::size_t{j} * kEdgeSliceRows + lane;
      const Vec3<T> x = Lanes::gather3(p, columns);
      for (int i = 0; i < 3; ++i) {
        for (int c = 0; c < 3; ++c) {
          const T a = Lanes::load(block + (3 * i + c) * static_cast<int>(kEdgeSliceRows));
          sum[i] += a * x[c];
          use(a, i, c);
        }
      }
      return columns;
    };
    const std::uint32_t halo = matrix.slice_halo[slice], end = matrix.slice_begin[slice + 1];
    for (std::uint32_t j = matrix.slice_begin[slice]; j < halo; ++j) {
      Vec3<T> other(T(0), T(0), T(0));
      const std::uint32_t* columns = multiply(j, [&](T a, int i, int c) { other[c] += a * own[i]; });
      Lanes::scatter_add3(q, columns, other);
    }
    for (std::uint32_t j = halo; j < end; ++j) multiply(j, [](T, int, int) {});
    Lanes::store3(q, local, Vec3<T>(Lanes::load3(q, local) + sum));
  }
}

}  // namespace tensormass::matrix
