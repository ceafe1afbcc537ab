#pragma once

#include <algorithm>

#include "matrix/edges.h"
#include "matrix/element_points.h"
#include "matrix/row_elements.h"
#include "matrix/row_system.h"

/// Lagged tangents: elements whose force follows its last tangent until they are evaluated again.
///
///   f_k = f_k⁰ − Σ_l K_kl⁰ (d_l − d_l⁰)      d_l = u_l − u_k
///       = g_k − Σ_l K_kl⁰ d_l                g_k = f_k⁰ + Σ_l K_kl⁰ d_l⁰
///
///   ⁰      when the element was evaluated last
///   K_kl   its edge tensor, which is also that of the system
///   g_k    its force if nothing were displaced
///   turn   one of Settings::lag_steps steps; each element is evaluated in its own (model::turns_of)
///
/// The sums of K and g over all elements are kept (MatrixView::kept_edges, kept_force), so that a step pays for the
/// elements that it evaluates, and for one product, as scenes of linear laws do. An element is evaluated in its turn,
/// and at once if F has changed by more than lag_strain at one of its quadrature points. The error of a force is of
/// second order in that change, and of first order in what `project_to_psd` takes from K.
///
/// Storage by edges adds to its sums what an element's tensors change by (element_pass). Storage by rows sums the
/// tensors of a slice anew if one of its elements was evaluated:
///
///   keep_elements ──kept, kept_touched──> gather_kept ──kept_edges, kept_force──> finish_rows (rows.h)
///
/// All rows of an element are refreshed in the same step, so forces balance: K_lk = K_klᵀ, and Σ_k f_k = 0.
namespace tensormass::matrix {

/// Reals that are kept of an element: d⁰ of its other nodes against node 0, K_kl⁰ of its pairs, g_k of its nodes.
template <class Shape>
inline constexpr std::uint32_t kKeptReals = static_cast<std::uint32_t>(3 * (Shape::kNodes - 1) +
                                                                       9 * physics::kPairs<Shape::kNodes> +
                                                                       3 * Shape::kNodes);

/// Elements whose kept reals lie side by side: those that are evaluated together.
template <class Lanes>
inline constexpr std::uint32_t kPackOf = kReadsRecords<Lanes> ? kSliceRows : Lanes::kWidth;

/// The kept reals of the elements from `first` on.
template <class Lanes, class Shape>
class KeptElements {
 public:
  using Real = typename Lanes::Real;
  using T = typename Lanes::Scalar;
  static constexpr std::uint32_t kNodes = Shape::kNodes, kPairs = physics::kPairs<Shape::kNodes>;

  TM_HOST_DEVICE KeptElements(const ElementView<Real>& e, std::uint32_t first)
      : reals_(e.kept + std::size_t{first - first % kPack} * kKeptReals<Shape> + first % kPack) {}

  TM_HOST_DEVICE T move(std::uint32_t node, std::uint32_t c) const { return load(3 * (node - 1) + c); }
  TM_HOST_DEVICE T block(std::uint32_t pair, std::uint32_t c) const { return load(kMoves + 9 * pair + c); }
  TM_HOST_DEVICE T force(std::uint32_t node, std::uint32_t c) const { return load(kForces + 3 * node + c); }
  TM_HOST_DEVICE void keep_move(std::uint32_t node, std::uint32_t c, T value) const {
    store(3 * (node - 1) + c, value);
  }
  TM_HOST_DEVICE void keep_block(std::uint32_t pair, std::uint32_t c, T value) const {
    store(kMoves + 9 * pair + c, value);
  }
  TM_HOST_DEVICE void keep_force(std::uint32_t node, std::uint32_t c, T value) const {
    store(kForces + 3 * node + c, value);
  }

 private:
  static constexpr std::uint32_t kMoves = 3 * (kNodes - 1), kForces = kMoves + 9 * kPairs, kPack = kPackOf<Lanes>;
  TM_HOST_DEVICE T load(std::uint32_t c) const { return Lanes::load(reals_ + std::size_t{c} * kPack); }
  TM_HOST_DEVICE void store(std::uint32_t c, T value) const { Lanes::store(reals_ + std::size_t{c} * kPack, value); }

  Real* const reals_;
};

/// Returns 1 in the lanes of elements that must be evaluated in this step, else 0.
template <class Lanes, class Shape, class Real>
TM_HOST_DEVICE typename Lanes::Scalar elements_due(const view::StateView<Real>& state,
                                                   const view::MatrixView<Real>& matrix, const ElementView<Real>& e,
                                                   std::uint32_t first,
                                                   const Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes]) {
  using T = typename Lanes::Scalar;
  if (state.control->refreshes_all != 0) return T(1);
  Real turns[Lanes::kWidth];
  for (std::uint32_t lane = 0; lane < Lanes::kWidth; ++lane) {
    turns[lane] = e.turns[first + lane] == state.control->refresh_turn ? Real(1) : Real(0);
  }
  const KeptElements<Lanes, Shape> kept(e, first);
  Vec3<T> moved[Shape::kNodes];
  moved[0] = Vec3<T>::Zero();
  TM_UNROLL_ALL
  for (std::uint32_t l = 1; l < Shape::kNodes; ++l) {
    for (std::uint32_t c = 0; c < 3; ++c) moved[l][c] = u[l][c] - u[0][c] - kept.move(l, c);
  }
  T largest(0);
  for (std::uint32_t q = 0; q < points_of<Shape>(e); ++q) {
    const StoredPoint<Lanes, Shape, NoLaw> stored(e, q, first);
    const Mat3<T> change = stored.gradients().deformation_gradient_against_first(moved) - Mat3<T>::Identity();
    for (int c = 0; c < 9; ++c) largest = maximum(largest, absolute(change(c)));
  }
  return select_greater(largest, T(matrix.lag_strain), T(1), Lanes::load(turns));
}

/// Keeps new tensors of the elements that are due, and adds what they change to the sums of the patch's rows and edges.
/// count: elements from `first` on, at most Lanes::kWidth.
/// due: of elements_due
template <class Lanes, class Shape, class Real>
void keep_tensors(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix, const ElementView<Real>& e,
                  const Patch& patch, std::uint32_t first, std::uint32_t count, typename Lanes::Scalar due,
                  const Vec3<typename Lanes::Scalar> (&u)[Shape::kNodes],
                  const physics::ElementTensors<Shape, typename Lanes::Scalar>& tensors) {
  using T = typename Lanes::Scalar;
  constexpr std::uint32_t kNodes = Shape::kNodes, kPairs = physics::kPairs<Shape::kNodes>;
  // What changes, as an element's record (add_to_edges has a similar one):
  //
  //   0         8 a node   its part of K_kk, as MatrixView::diagonal stores it
  //   kBlocks   8 a pair   the first eight components of K_kl
  //   kForces   4 a node   g
  //   kNinths   1 a pair   the ninth component of K_kl
  constexpr std::uint32_t kBlocks = 8 * kNodes, kForces = kBlocks + 8 * kPairs;
  constexpr std::uint32_t kNinths = kForces + (kNodes + 1) / 2 * 8, kRecord = kNinths + (kPairs + 7) / 8 * 8;
  const bool all = state.control->refreshes_all != 0;
  const KeptElements<Lanes, Shape> kept(e, first);
  T record[kRecord];
  for (T& value : record) value = T(0);
  // Returns what a kept number changes by, and hands out the number to keep.
  const auto change = [&](T now, T before, const auto& keep) {
    keep(select_greater(due, T(0), now, before));
    return all ? now : select_greater(due, T(0), now - before, T(0));
  };
  Vec3<T> force[kNodes];
  for (std::uint32_t k = 0; k < kNodes; ++k) force[k] = tensors.force[k];
  for (std::uint32_t k = 0, pair = 0; k < kNodes; ++k) {
    for (std::uint32_t l = k + 1; l < kNodes; ++l, ++pair) {
      const Mat3<T>& edge = tensors.edge_stiffness[pair];
      const Vec3<T> stretch = u[l] - u[k];
      force[k] += edge * stretch;
      force[l] -= edge.transpose() * stretch;
      Mat3<T> changed;
      for (std::uint32_t c = 0; c < 9; ++c) {
        const auto keep = [&](T now) { kept.keep_block(pair, c, now); };
        changed(c / 3, c % 3) = change(edge(c / 3, c % 3), kept.block(pair, c), keep);
        record[c < 8 ? kBlocks + 8 * pair + c : kNinths + pair] = changed(c / 3, c % 3);
      }
      T *diagonal_k = record + 8 * k, *diagonal_l = record + 8 * l;
      for (int i = 0, c = 0; i < 3; ++i) {
        for (int j = i; j < 3; ++j, ++c) {
          diagonal_k[c] -= changed(i, j);
          diagonal_l[c] -= changed(j, i);
        }
      }
    }
  }
  for (std::uint32_t k = 0; k < kNodes; ++k) {
    for (std::uint32_t c = 0; c < 3; ++c) {
      record[kForces + 4 * k + c] = change(force[k][c], kept.force(k, c), [&](T now) { kept.keep_force(k, c, now); });
      if (k > 0) change(u[k][c] - u[0][c], kept.move(k, c), [&](T now) { kept.keep_move(k, c, now); });
    }
  }
  alignas(64) Real records[Lanes::kWidth * kRecord];
  Lanes::scatter(records, kRecord, record);
  Real dues[Lanes::kWidth];
  Lanes::store(dues, due);
  for (std::uint32_t lane = 0; lane < count; ++lane) {
    if (dues[lane] == 0) continue;
    const Real* from = records + lane * kRecord;
    for (std::uint32_t k = 0; k < kNodes; ++k) {
      const std::size_t row = e.rows[std::size_t{k} * e.count + first + lane];
      if (row - patch.row_begin >= patch.own()) continue;  // another patch's row; the difference wraps
      detail::add_reals<4>(matrix.kept_force + 4 * row, from + kForces + 4 * k);
      detail::add_reals<8>(matrix.kept_diagonal + 8 * row, from + 8 * k);
    }
    for (std::uint32_t pair = 0; pair < kPairs; ++pair) {
      const std::uint32_t place = e.pair_places[std::size_t{pair} * e.count + first + lane];
      if (place == kNoPlace) continue;
      Real* to = matrix.kept_edges + edge_begin(place / 2);
      detail::add_eight(to, from + kBlocks + 8 * pair, place % 2);
      to[8] += from[kNinths + pair];
    }
  }
}

/// Keeps the tensors of one element as they are added up: add_point's `out`.
template <class Shape, class Real>
class ElementKeeper {
 public:
  TM_HOST_DEVICE ElementKeeper(const ElementView<Real>& e, std::uint32_t element) : kept_(e, element) {}

  TM_HOST_DEVICE void add_force(int k, const Vec3<Real>& f, bool first) {
    force_[k] = first ? f : Vec3<Real>(force_[k] + f);
  }
  TM_HOST_DEVICE void add_edge(int pair, const Mat3<Real>& block, bool first) {
    const auto at = static_cast<std::uint32_t>(pair);
    TM_UNROLL_ALL
    for (std::uint32_t c = 0; c < 9; ++c) {
      kept_.keep_block(at, c, first ? block(c / 3, c % 3) : kept_.block(at, c) + block(c / 3, c % 3));
    }
  }
  /// Keeps the rest. Call it after the last point. u: displacements of the nodes against node 0.
  TM_HOST_DEVICE void finish(const Vec3<Real> (&u)[Shape::kNodes]) {
    constexpr std::uint32_t kNodes = Shape::kNodes;
    std::uint32_t pair = 0;
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kNodes; ++k) {
      TM_UNROLL_ALL
      for (std::uint32_t l = k + 1; l < kNodes; ++l, ++pair) {
        Mat3<Real> block;
        for (std::uint32_t c = 0; c < 9; ++c) block(c / 3, c % 3) = kept_.block(pair, c);
        const Vec3<Real> stretch = u[l] - u[k];
        force_[k] += block * stretch;
        force_[l] -= block.transpose() * stretch;
      }
    }
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kNodes; ++k) {
      for (std::uint32_t c = 0; c < 3; ++c) {
        kept_.keep_force(k, c, force_[k][c]);
        if (k > 0) kept_.keep_move(k, c, u[k][c]);
      }
    }
  }

 private:
  const KeptElements<SingleLane<Real>, Shape> kept_;
  Vec3<Real> force_[Shape::kNodes];
};

/// Evaluates the elements of a group that are due, keeps their tensors, and marks their rows for gather_kept. Storage
/// by rows; with storage by edges element_pass does this. Reads displacement, kept tensors; writes kept tensors,
/// kept_touched.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void keep_elements(const Team& team, const view::PatchesView& patches,
                                  const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                  const view::NewtonView<Real>& newton, const ElementView<Real>& e) {
  using Lanes = SingleLane<Real>;
  const ElementRange range = element_range(patches, e, team.patch());
  const physics::Stiffness kind = stiffness_kind(state, newton);
  team.for_each(range.begin, range.end, [&](std::uint32_t element) {
    Vec3<Real> u[Shape::kNodes];
    load_displacement<Lanes, Shape>(state, e, element, u);
    TM_UNROLL_ALL
    for (int l = 1; l < Shape::kNodes; ++l) u[l] -= u[0];
    u[0].setZero();
    if (elements_due<Lanes, Shape>(state, matrix, e, element, u) == 0) return;
    ElementKeeper<Shape, Real> keeper(e, element);
    for_each_point<Lanes, Shape, Law>(
        e, element, u, [&](const auto& gradients, const auto& f, auto& point, std::uint32_t q) {
          physics::add_point<Shape, Law>(gradients, f, point, nullptr, kind, q == 0, keeper);
        });
    keeper.finish(u);
    for (std::uint32_t k = 0; k < Shape::kNodes; ++k) {
      matrix.kept_touched[e.rows[std::size_t{k} * e.count + element] / kSliceRows] = 1;
    }
  });
}

/// Adds up the kept tensors of row `lane` of the slice at `index` of a group's slices, if one of its elements was
/// evaluated. The first group at a slice overwrites what is there, the others add to it. When all elements are
/// evaluated it does so for all slices: an element whose material is gone no longer names its rows.
/// blocks: as of assemble_row (rows.h), without neighbours, each part with a sum of its own.
/// Reads kept tensors, kept_touched; writes kept_edges, kept_force.
template <class Shape, class Real, class Blocks>
TM_HOST_DEVICE void gather_kept(const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                const ElementView<Real>& e, std::uint32_t index, std::uint32_t lane, Blocks& blocks) {
  using Packed = typename Places<Shape::kNodes>::Packed;
  constexpr std::uint32_t kNodes = Shape::kNodes;
  const ListedSlice slice = e.slices[index];
  if (state.control->refreshes_all == 0 && matrix.kept_touched[slice.slice()] == 0) return;
  const std::uint32_t own = slice.slice() * kSliceRows + lane, width = slice.columns_end - slice.columns_begin;
  const bool begun = slice.is_begun();
  RowSums<Real> sums;
  for (std::uint32_t turn = 0; turn < width;) {
    const std::uint32_t held = blocks.begin(turn, width - turn);
    for (std::uint32_t j = turn + blocks.part(); j < turn + held; j += blocks.parts()) blocks.clear(j, {});
    blocks.meet();
    sums.force.setZero();  // each turn reads all elements
    for (std::uint32_t column = slice.list_begin + blocks.part(); column < slice.list_end; column += blocks.parts()) {
      const std::uint32_t element = e.listed[std::size_t{column} * kSliceRows + lane];
      if (element == kNoPlace) break;
      const Places<kNodes> places(Packed::read(e, column, lane), e.place_bits);
      const KeptElements<SingleLane<Real>, Shape> kept(e, element);
      std::uint32_t node = 0;  // the own one
      TM_UNROLL_ALL
      for (std::uint32_t l = 1; l < kNodes; ++l) node = places.is_own(static_cast<int>(l)) ? l : node;
      TM_UNROLL_ALL
      for (std::uint32_t m = 0; m + 1 < kNodes; ++m) {
        const std::uint32_t other = node == m + 1 ? 0 : m + 1;
        const auto pair = static_cast<std::uint32_t>(physics::pair_index(
            static_cast<int>(kNodes), static_cast<int>(minimum(node, other)), static_cast<int>(maximum(node, other))));
        Mat3<Real> block[1];
        TM_UNROLL_ALL
        for (std::uint32_t c = 0; c < 9; ++c) {
          block[0](c / 3, c % 3) = kept.block(pair, node < other ? c : 3 * (c % 3) + c / 3);
        }
        const std::uint32_t place[1] = {places.others()[m]};
        blocks.add(place, block, true);
      }
      for (std::uint32_t c = 0; c < 3; ++c) sums.force[c] += kept.force(node, c);
    }
    blocks.meet();
    for (std::uint32_t j = turn + blocks.part(); j < turn + held; j += blocks.parts()) {
      const std::size_t slot = (std::size_t{slice.columns_begin} + j) * kSliceRows + lane;
      Mat3<Real> edge = blocks.block(j);
      if (begun) edge += load_block<Real>(matrix.kept_edges, slot);
      store_block<Real>(matrix.kept_edges, slot, edge);
    }
    turn += held;
    if (turn < width || !blocks.leads(sums)) continue;
    if (begun) sums.force += load3<Real>(matrix.kept_force, own);
    store3<Real>(matrix.kept_force, own, sums.force);
  }
}

/// Sets the sums of a patch to zero, before all elements are evaluated.
template <class Real>
void clear_kept(const view::MatrixView<Real>& matrix, const Patch& patch) {
  clear_edges(matrix, patch, matrix.kept_edges);
  std::fill_n(matrix.kept_diagonal + 8 * std::size_t{patch.row_begin}, 8 * std::size_t{patch.own()}, Real(0));
  std::fill_n(matrix.kept_force + 4 * std::size_t{patch.row_begin}, 4 * std::size_t{patch.own()}, Real(0));
}

/// Adds the kept tensors of a patch to A, and their forces and K (β v + d) to b (row_system.h): one product with
/// u + β v + d.
/// Adds: the blocks of A have other tensors. Otherwise they are overwritten.
template <class Lanes, bool Adds, class Real>
void add_kept(const view::PatchesView& patches, const view::StateView<Real>& state,
              const view::MatrixView<Real>& matrix, const Patch& patch) {
  using T = typename Lanes::Scalar;
  Real* const ahead = matrix.kept_ahead + 4 * std::size_t{patch.local_begin};
  for (std::uint32_t local = 0; local < patch.own() + patch.halo_count; ++local) {
    const std::size_t row = global_row(patches, patch, local);
    const RowTerms<Real> terms(state, row);
    store3<Real>(ahead, local, load3<Real>(state.displacement, row) + terms.stretch_ahead(row));
    if (local >= patch.own()) continue;
    store3<Real>(matrix.rhs, row, load3<Real>(matrix.rhs, row) + load3<Real>(matrix.kept_force, row) * terms.h);
    for (std::size_t c = 8 * row; c < 8 * row + 6; ++c) {
      matrix.diagonal[c] += matrix.kept_diagonal[c] * terms.stiffness_share();
    }
  }
  const T h(step_size(state));
  for (std::uint32_t local = 0; local < patch.own(); local += Lanes::kWidth) {
    const std::uint32_t first = patch.row_begin + local;
    const std::uint32_t slice = first / kEdgeSliceRows, lane = local % kEdgeSliceRows;
    Real shares[Lanes::kWidth];
    for (std::uint32_t i = 0; i < Lanes::kWidth; ++i) shares[i] = RowTerms<Real>(state, first + i).stiffness_share();
    const Vec3<T> own = Lanes::load3(ahead, local);
    Vec3<T> sum(T(0), T(0), T(0));
    const std::uint32_t halo = matrix.slice_halo[slice];
    for (std::uint32_t j = matrix.slice_begin[slice]; j < matrix.slice_begin[slice + 1]; ++j) {
      const std::size_t slot = std::size_t{j} * kEdgeSliceRows + lane;
      const Real* const kept = matrix.kept_edges + edge_begin(slot);
      Real* const to = matrix.edges + edge_begin(slot);
      for (std::uint32_t i = 0; i < Lanes::kWidth; ++i) {
        for (std::uint32_t c = 9 * i; c < 9 * i + 9; ++c) to[c] = (Adds ? to[c] : Real(0)) + kept[c] * shares[i];
      }
      T block[9];
      Lanes::gather_records(block, [&](std::uint32_t i) { return kept + 9 * i; });
      const std::uint32_t* const columns = matrix.columns + slot;
      const Vec3<T> stretch = (Lanes::gather3(ahead, columns) - own) * h;
      Vec3<T> other(T(0), T(0), T(0));
      for (int i = 0; i < 3; ++i) {
        for (int c = 0; c < 3; ++c) {
          sum[i] -= block[3 * i + c] * stretch[c];
          other[c] += block[3 * i + c] * stretch[i];
        }
      }
      if (j < halo) Lanes::scatter_add3(matrix.rhs + 4 * std::size_t{patch.row_begin}, columns, other);
    }
    Lanes::store3(matrix.rhs, first, Vec3<T>(Lanes::load3(matrix.rhs, first) + sum));
  }
}

}  // namespace tensormass::matrix
