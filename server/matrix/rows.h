#pragma once

#include "core/strided.h"
#include "matrix/row_elements.h"
#include "matrix/row_system.h"

/// Assembly in which a thread owns a row (storage by rows, on a GPU). The thread evaluates every element that touches
/// its row and keeps the row's part of it.
///
///   for each round of the row's element list:
///     read ──> F at each quadrature point ──> stress, stiffness ──> force of the own node   added to RowSums
///                                                                └─> K_kl to the other nodes  added to Blocks
///   then for each column of the row:
///     Blocks ──> A_kl, and K d into RowSums ──> diagonal block and right-hand side of the row
///
///   round   kElementsAtOnce elements of the list, evaluated side by side
///   part    one of several threads that share a row
///   turn    the columns of a row whose blocks fit into shared memory together
///   begun   the row holds sums of an earlier group: K_kl in edges, f in rhs
///
/// row_system.h defines A, K, d and RowSums.
///
/// 1. Threads exchange nothing, and no element tensor is stored anywhere. Every sum runs in the order of the row's
///    list, so results repeat bitwise. Each element is evaluated once for each of its nodes, but only that node's row
///    of its tensors. Storing tensors and gathering them would take as long as this repeated arithmetic.
/// 2. The rows of an element must find the same F and the same stress to the last bit. Otherwise the forces of a stiff
/// element would not balance: they would be off by the rounding error of its modulus.
/// 3. Blocks live in shared memory on a GPU, and a wide row may not fit. It is then processed in several turns. Each
///    turn evaluates all elements of the row and keeps only its own columns.
namespace tensormass::matrix {

/// The row behind a slot: its displacement, and how far it moves (RowTerms::stretch_ahead) [m].
template <class Real>
struct RowNeighbour {
  Vec3<Real> displacement, ahead;
};

/// True: cache the RowNeighbours in shared memory while the elements of a row are evaluated. False: read them when they
/// are needed. The cache pays only for linear tetrahedra, whose rows are narrow. With wider rows, shared memory would
/// hold fewer rows at once and leave less room for the L1 cache.
template <class Shape>
inline constexpr bool kKeepsNeighbours = Shape::kSinglePoint;

/// True: the parts of a row have one sum of its blocks and add to it one after the other. False: each part has a sum of
/// its own. An element of several points takes long to evaluate, so waiting for the others is cheap there. Separate
/// sums would leave shared memory for fewer threads.
template <class Shape>
inline constexpr bool kAddsInTurns = !Shape::kSinglePoint;

/// A row of a slice that has elements of a group.
template <class Real>
struct ListedRow {
  const view::PatchesView& patches;
  const view::StateView<Real>& state;
  const view::MatrixView<Real>& matrix;
  const ListedSlice slice;
  const std::uint32_t lane;

  TM_HOST_DEVICE std::uint32_t index() const { return slice.slice() * kSliceRows + lane; }
  TM_HOST_DEVICE std::uint32_t width() const { return slice.columns_end - slice.columns_begin; }
  /// The slot of a column, counted within the slice.
  TM_HOST_DEVICE std::size_t slot(std::uint32_t column) const {
    return (std::size_t{slice.columns_begin} + column) * kSliceRows + lane;
  }
  TM_HOST_DEVICE std::uint32_t neighbour(std::uint32_t column) const {
    return global_row(patches, slice.patch, matrix.columns[slot(column)]);
  }
};

/// Reads the displacements of the nodes of a round's elements, relative to each element's first node. All rows of an
/// element then find the same stress to the last bit.
/// held: how many columns of the row `blocks` holds in this turn.
template <class Shape, class Real, class Blocks>
TM_HOST_DEVICE void read_moves(const ListedRow<Real>& row, const Vec3<Real>& own, const ElementView<Real>& e,
                               const std::uint32_t (&elements)[kElementsAtOnce<Shape>],
                               const Places<Shape::kNodes> (&places)[kElementsAtOnce<Shape>], const Blocks& blocks,
                               std::uint32_t held, Vec3<Real> (&u)[kElementsAtOnce<Shape>][Shape::kNodes]) {
  constexpr std::uint32_t kAtOnce = kElementsAtOnce<Shape>;
  if constexpr (kKeepsNeighbours<Shape>) {
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      TM_UNROLL_ALL
      for (int l = 0; l < Shape::kNodes; ++l) {
        u[k][l] = blocks.displacement(places[k].of(l));
        for (int c = 0; c < 3; ++c) u[k][l][c] = places[k].is_own(l) ? own[c] : u[k][l][c];
      }
    }
    if (held < row.width()) {
      TM_UNROLL_ALL
      for (std::uint32_t k = 0; k < kAtOnce; ++k) {
        TM_UNROLL_ALL
        for (int l = 0; l < Shape::kNodes; ++l) {
          const std::uint32_t place = places[k].of(l);
          if (places[k].is_own(l) || blocks.holds(place)) continue;
          u[k][l] = load3<Real>(row.state.displacement, row.neighbour(place));
        }
      }
    }
  } else {
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      load_displacement<SingleLane<Real>, Shape>(row.state, e, elements[k] != kNoPlace ? elements[k] : 0, u[k]);
    }
  }
  TM_UNROLL_ALL
  for (std::uint32_t k = 0; k < kAtOnce; ++k) {
    TM_UNROLL_ALL
    for (int l = 1; l < Shape::kNodes; ++l) u[k][l] -= u[k][0];
  }
}

/// Assembles row `lane` of the slice at `index` of a group's slices. It adds the group's elements. If the group is the
/// last one there, it also forms the row of A and b. Parts evaluate different elements of the row and, once their sums
/// have been added up, form different columns.
///
/// Blocks holds the row's blocks of a turn. It has
///
///   parts(), part()                     how many threads share the row, and which one this is
///   begin(column, count) -> count       starts a turn at `column`; returns how many columns fit
///   clear(place, neighbour)             zeroes the block of a place for all parts; stores the neighbour if
///                                       kKeepsNeighbours
///   holds(place) -> bool                whether the place belongs to this turn
///   displacement(place), ahead(place)   as clear() stored them; displacement() returns any value for a place of
///                                       another turn. Only with kKeepsNeighbours
///   add(places, blocks, adds)           if `adds`, adds each block at its place. Places differ; those of another turn
///                                       are ignored. With kAddsInTurns the parts synchronize within: each must call it
///                                       equally often, also with nothing to add
///   meet()                              synchronizes the parts
///   block(place) -> Mat3                the sum of all parts
///   leads(sums) -> bool                 adds up the RowSums of all parts; true for the part that must use them
///
/// Reads displacement, velocity, base fields, internal variables, decompositions, external, and edges and rhs of begun
/// rows; writes edges, diagonal, rhs, internal_force.
template <class Shape, class Law, class Real, class Blocks>
TM_HOST_DEVICE void assemble_row(const view::PatchesView& patches, const view::StateView<Real>& state,
                                 const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton,
                                 const ElementView<Real>& e, std::uint32_t index, std::uint32_t lane, Blocks& blocks) {
  using Lanes = SingleLane<Real>;
  using Point = ReadPoint<Shape, Law, Real>;
  using Packed = typename Places<Shape::kNodes>::Packed;
  constexpr std::uint32_t kAtOnce = kElementsAtOnce<Shape>;
  const ListedRow<Real> row{patches, state, matrix, e.slices[index], lane};
  const ListedSlice& slice = row.slice;
  const std::uint32_t own = row.index();
  const bool begun = slice.is_begun(), finishes = slice.finishes();
  const std::uint32_t width = slice.columns_end - slice.columns_begin;
  const std::uint32_t list_begin = slice.list_begin + blocks.part(), list_end = slice.list_end;
  const PatchColumns& patch = slice.patch;
  const Vec3<Real> own_displacement = load3<Real>(state.displacement, own);
  const RowTerms<Real> terms(state, own);
  const physics::Stiffness kind = stiffness_kind(state, newton);
  // The list's columns of this part, round by round. Beyond the end of a list, element 0 is evaluated and discarded.
  const auto column_of = [list_begin, parts = blocks.parts()](std::uint32_t round, std::uint32_t k) {
    return list_begin + (round * kAtOnce + k) * parts;
  };
  const auto listed_at = [&e, list_end, lane](std::uint32_t column) {
    return read_once(e.listed + std::size_t{minimum(column, list_end - 1)} * kSliceRows + lane);
  };
  const auto places_at = [&e, list_end, lane](std::uint32_t column) {
    return Packed::read(e, minimum(column, list_end - 1), lane);
  };
  // A value that was just read is tested where it is used: testing it here would wait for the read.
  const auto element_of = [column_of, list_end](std::uint32_t listed, std::uint32_t round, std::uint32_t k) {
    return column_of(round, k) < list_end ? listed : kNoPlace;
  };
  const auto point_at = [&e](std::uint32_t element, std::uint32_t q) {
    return Point(e, q, element != kNoPlace ? element : 0);
  };
  // With kAddsInTurns every part must run all rounds.
  const std::uint32_t at_once = kAtOnce * blocks.parts(), listed_count = list_end - slice.list_begin;
  const std::uint32_t rounds = (listed_count + at_once - 1) / at_once;
  RowSums<Real> sums;
  for (std::uint32_t turn = 0; turn < width;) {
    const std::uint32_t held = blocks.begin(turn, width - turn);
    sums.force.setZero();  // each turn evaluates all elements
    // Reads run ahead: the next points' data are read before the arithmetic of these, the first points' with the
    // neighbours.
    std::uint32_t now[kAtOnce], listed[kAtOnce];
    Packed packed[kAtOnce];
    Point ahead[kAtOnce];
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      now[k] = listed_at(column_of(0, k));
      listed[k] = listed_at(column_of(1, k));
      packed[k] = places_at(column_of(0, k));
    }
    for_each_strided(
        turn + blocks.part(), turn + held, blocks.parts(),
        [&](std::uint32_t j) -> RowNeighbour<Real> {
          if constexpr (!kKeepsNeighbours<Shape>) return {};
          const std::uint32_t other = row.neighbour(j);
          return {load3<Real>(state.displacement, other), terms.stretch_ahead(other)};
        },
        [&](std::uint32_t j, const RowNeighbour<Real>& neighbour) { blocks.clear(j, neighbour); });
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      now[k] = element_of(now[k], 0, k);
      ahead[k] = point_at(now[k], 0);
    }
    blocks.meet();
    for (std::uint32_t round = 0; kAddsInTurns<Shape> ? round < rounds : now[0] != kNoPlace; ++round) {
      std::uint32_t next[kAtOnce] = {};
      Places<Shape::kNodes> places[kAtOnce];
      Vec3<Real> u[kAtOnce][Shape::kNodes];
      TM_UNROLL_ALL
      for (std::uint32_t k = 0; k < kAtOnce; ++k) places[k] = Places<Shape::kNodes>(packed[k], e.place_bits);
      if constexpr (!physics::kDecomposes<Law>) {
        read_moves<Shape>(row, own_displacement, e, now, places, blocks, held, u);
      }
      physics::NodeTensors<Shape, Real> tensors[kAtOnce];
      TM_UNROLL(1)
      for (std::uint32_t q = 0; q < points_of<Shape>(e); ++q) {
        const bool ends = q + 1 == points_of<Shape>(e);
        physics::NodeGradients<Shape, Real> gradients[kAtOnce];
        Mat3<Real> f[kAtOnce];
        typename Law::template Point<Real> points[kAtOnce];
        TM_UNROLL_ALL
        for (std::uint32_t k = 0; k < kAtOnce; ++k) {
          const auto of_point = ahead[k].stored.gradients();
          gradients[k] = {of_point, [&](int l) { return places[k].is_own(l); }};
          if constexpr (physics::kDecomposes<Law>) {
            const auto values = ahead[k].decomposition.values();
            f[k] = values.product();
            points[k] = ahead[k].stored.law_at(e, q, values);
          } else {
            f[k] = of_point.deformation_gradient_against_first(u[k]);
            points[k] = ahead[k].stored.law_at(e, q, f[k]);
          }
          if (ends) {
            // Read here all at once, and not earlier: reads return in order, so waiting for the neighbours would also
            // wait for these.
            next[k] = element_of(listed[k], round + 1, k);
            listed[k] = listed_at(column_of(round + 2, k));
            packed[k] = places_at(column_of(round + 1, k));
          }
          ahead[k] = point_at(ends ? next[k] : now[k], ends ? 0 : q + 1);
        }
        if (kind == physics::Stiffness::kProjected) {
          TM_UNROLL_ALL
          for (std::uint32_t k = 0; k < kAtOnce; ++k) Law::project_to_psd(points[k]);
        }
        const auto add = [&](std::uint32_t k, const physics::Viscous<Real>* memory) {
          physics::add_point_to_node<Shape, Law>(gradients[k], f[k], points[k], memory, kind, tensors[k]);
        };
        if (e.prony_count == 0) {
          TM_UNROLL_ALL
          for (std::uint32_t k = 0; k < kAtOnce; ++k) add(k, nullptr);
        } else {
          TM_UNROLL_ALL
          for (std::uint32_t k = 0; k < kAtOnce; ++k) {
            const std::uint32_t element = now[k] != kNoPlace ? now[k] : 0;
            const auto memory = viscous_stress_at<Lanes, Law>(e, q, element, points[k], state.control->dt_s, Real(0));
            add(k, &memory);
          }
        }
      }
      TM_UNROLL_ALL
      for (std::uint32_t k = 0; k < kAtOnce; ++k) {
        tensors[k].complete([&](int l) { return places[k].is_own(l); });
        // Without turns a round ends at the end of the list, so only its later elements can be missing.
        const bool adds = (!kAddsInTurns<Shape> && k == 0) || now[k] != kNoPlace;
        if (adds) sums.force += tensors[k].force;
        blocks.add(places[k].others(), tensors[k].stiffness, adds);
        now[k] = next[k];
      }
    }
    const RowAssembly<false, Real> assembly(patches, state, matrix, newton, patch, own);
    blocks.meet();
    for_each_strided<kKeepsNeighbours<Shape> ? 1 : 8>(
        turn + blocks.part(), turn + held, blocks.parts(),
        [&](std::uint32_t j) {
          if constexpr (kKeepsNeighbours<Shape>) {
            return assembly.neighbour(row.slot(j), blocks.ahead(j));
          } else {
            return assembly.neighbour(row.slot(j));
          }
        },
        [&](std::uint32_t j, const auto& neighbour) {
          const std::size_t slot = row.slot(j);
          Mat3<Real> edge = blocks.block(j);
          if (begun) edge += load_block<Real>(matrix.edges, slot);
          store_block<Real>(matrix.edges, slot, finishes ? assembly.couple(slot, neighbour, edge, sums) : edge);
        });
    turn += held;
    if (turn < width || !blocks.leads(sums)) continue;  // a row with elements has columns, so there is a last turn
    if (begun) sums.force += load3<Real>(matrix.rhs, own);
    if (finishes) {
      assembly.finish(sums);
    } else {
      store3<Real>(matrix.rhs, own, sums.force);
    }
  }
}

/// Forms the rows of A and b in scenes with linear laws or lagged tangents, after all element passes. In other scenes
/// the last group does it. Reads constant and kept tensors, displacement, velocity, base fields, external, and edges
/// and rhs of begun rows; writes edges, diagonal, rhs, internal_force.
template <class Team, class Real>
TM_HOST_DEVICE void finish_rows(const Team& team, const view::PatchesView& patches, const view::StateView<Real>& state,
                                const view::MatrixView<Real>& matrix, const view::NewtonView<Real>& newton) {
  const Patch patch = patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const bool begun = matrix.begun_slices[row / kSliceRows] != 0;
    const RowAssembly<true, Real> assembly(patches, state, matrix, newton, patch, row);
    RowSums<Real> sums;
    if (begun) sums.force = load3<Real>(matrix.rhs, row);
    if (matrix.kept_force != nullptr) sums.force += load3<Real>(matrix.kept_force, row);
    const std::uint32_t slice = row / kSliceRows;
    if (matrix.kept_touched != nullptr && row % kSliceRows == 0) matrix.kept_touched[slice] = 0;  // gathered by now
    const auto slot_of = [lane = row % kSliceRows](std::uint32_t column) {
      return std::size_t{column} * kSliceRows + lane;
    };
    constexpr std::uint32_t kAtOnce = 4;  // a constant tensor takes nine registers
    for_each_strided<kAtOnce>(
        matrix.slice_begin[slice], matrix.slice_begin[slice + 1], 1,
        [&](std::uint32_t j) { return assembly.neighbour(slot_of(j)); },
        [&](std::uint32_t j, const auto& neighbour) {
          const std::size_t slot = slot_of(j);
          const Mat3<Real> edge = begun ? load_block<Real>(matrix.edges, slot) : Mat3<Real>(Mat3<Real>::Zero());
          store_block<Real>(matrix.edges, slot, assembly.couple(slot, neighbour, edge, sums));
        });
    assembly.finish(sums);
  });
}

}  // namespace tensormass::matrix
