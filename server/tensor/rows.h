#pragma once

#include "core/strided.h"
#include "tensor/row_elements.h"

/// Elements to rows where a thread owns a row: it evaluates every element that the row touches and keeps what belongs
/// to the row.
///
/// Between threads nothing is exchanged, no tensor of an element is stored anywhere, and every sum runs in the order of
/// the row's list. Each element is evaluated once for each of its nodes, but of its tensors a node computes its own row
/// only, and gathering takes as long as the arithmetic that this repeats.
///
/// Each node's row finds the same F and the same stress to the last bit, or the forces of a stiff element would not
/// balance, by as much as rounding leaves of its modulus.
///
/// A row's blocks so far are in `Blocks`, which a device keeps in memory that is near; with kKeepsNeighbours also where
/// its neighbours are and how far they move. It may not hold all columns of a wide row at once, which then comes in
/// turns.
namespace tensormass::tensor {

/// What a row needs of the row behind a slot: where it is and how far it moves (RowTerms::stretch_ahead) [m].
template <class Real>
struct RowNeighbour {
  Vec3<Real> displacement, ahead;
};

/// Whether a row keeps its RowNeighbours near while its elements are evaluated, or reads of them what it needs when it
/// needs it. Rows of linear tetrahedra are narrow and their elements soon evaluated; of others, what this takes would
/// leave near memory for fewer rows at once, and less of it to the cache.
template <class Shape>
inline constexpr bool kKeepsNeighbours = Shape::kSinglePoint;

/// Whether threads that share a row add to one sum of its blocks in turns, or each to its own. Beside evaluating an
/// element of several points a turn is short, and what sums of their own take would leave near memory for fewer
/// threads.
template <class Shape>
inline constexpr bool kAddsInTurns = !Shape::kSinglePoint;

/// A row of a slice that has elements of a group.
template <class Real>
struct ListedRow {
  const SceneView<Real>& s;
  const ListedSlice slice;
  const std::uint32_t lane;

  TM_HOST_DEVICE std::uint32_t index() const { return slice.slice() * kSliceRows + lane; }
  TM_HOST_DEVICE std::uint32_t width() const { return slice.columns_end - slice.columns_begin; }
  /// column: of the slice, from 0.
  TM_HOST_DEVICE std::size_t slot(std::uint32_t column) const {
    return (std::size_t{slice.columns_begin} + column) * kSliceRows + lane;
  }
  TM_HOST_DEVICE std::uint32_t neighbour(std::uint32_t column) const {
    return global_row(s, slice.patch, s.columns[slot(column)]);
  }
};

/// How far the nodes of the elements of a round have moved, against their first ones, so that all rows of an element
/// find the same stress. held: columns of the row that `blocks` has.
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
          u[k][l] = load3<Real>(row.s.displacement, row.neighbour(place));
        }
      }
    }
  } else {
    TM_UNROLL_ALL
    for (std::uint32_t k = 0; k < kAtOnce; ++k) {
      load_displacement<SingleLane<Real>, Shape>(row.s, e, elements[k] != kNoPlace ? elements[k] : 0, u[k]);
    }
  }
  TM_UNROLL_ALL
  for (std::uint32_t k = 0; k < kAtOnce; ++k) {
    TM_UNROLL_ALL
    for (int l = 1; l < Shape::kNodes; ++l) u[k][l] -= u[k][0];
  }
}

/// The row `lane` of the slice at `index` of a group's slices: adds the group's elements and, if it is the last group
/// there, forms the row of A and b. Several threads may share a row: then each has a part of its elements and, when
/// their sums have been put together, of its columns. Blocks has
///   parts(), part()                     how many threads share the row, and which one this is
///   begin(column, count)                places are from `column` on, as far as they fit; returns how many
///   clear(place, neighbour)             for all parts: no block yet; the neighbour only with kKeepsNeighbours
///   holds(place)
///   displacement(place), ahead(place)   as clear had them; any displacement if it is not held. Only with
///                                       kKeepsNeighbours
///   add(places, blocks, adds)           where `adds`, adds each block at its place. Places differ; those that are not
///                                       held are left out. With kAddsInTurns parts meet within: each calls it equally
///                                       often, also with nothing to add
///   meet()                              all parts have done what they had to
///   block(place)                        the sum of all parts
///   leads(sums)                         adds up the sums of all parts; whether this part is to use them
/// Reads displacement, velocity, base fields, history, decompositions, external; writes edges, diagonal, rhs (where
/// begun it reads these, too), internal_force.
template <class Shape, class Law, class Real, class Blocks>
TM_HOST_DEVICE void assemble_row(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t index,
                                 std::uint32_t lane, Blocks& blocks) {
  using Lanes = SingleLane<Real>;
  using Point = ReadPoint<Shape, Law, Real>;
  using Packed = typename Places<Shape::kNodes>::Packed;
  constexpr std::uint32_t kAtOnce = kElementsAtOnce<Shape>;
  const ListedRow<Real> row{s, e.slices[index], lane};
  const ListedSlice& slice = row.slice;
  const std::uint32_t own = row.index();
  const bool begun = slice.is_begun(), finishes = slice.is_to_be_finished();
  const std::uint32_t width = slice.columns_end - slice.columns_begin;
  const std::uint32_t list_begin = slice.list_begin + blocks.part(), list_end = slice.list_end;
  const PatchColumns& patch = slice.patch;
  const Vec3<Real> own_displacement = load3<Real>(s.displacement, own);
  const RowTerms<Real> terms(s, own);
  const physics::Stiffness kind = stiffness_kind(s);
  // The list's columns of this part, round by round. Behind a list's end the first element of all is evaluated in vain.
  const auto column_of = [list_begin, parts = blocks.parts()](std::uint32_t round, std::uint32_t k) {
    return list_begin + (round * kAtOnce + k) * parts;
  };
  const auto listed_at = [&e, list_end, lane](std::uint32_t column) {
    return read_once(e.listed + std::size_t{minimum(column, list_end - 1)} * kSliceRows + lane);
  };
  const auto places_at = [&e, list_end, lane](std::uint32_t column) {
    return Packed::read(e, minimum(column, list_end - 1), lane);
  };
  // What has been read is looked at where it is used, or that would wait for it.
  const auto element_of = [column_of, list_end](std::uint32_t listed, std::uint32_t round, std::uint32_t k) {
    return column_of(round, k) < list_end ? listed : kNoPlace;
  };
  const auto point_at = [&e](std::uint32_t element, std::uint32_t q) {
    return Point(e, q, element != kNoPlace ? element : 0);
  };
  // Where parts add in turns, each takes part in all of them.
  const std::uint32_t at_once = kAtOnce * blocks.parts(), listed_count = list_end - slice.list_begin;
  const std::uint32_t rounds = (listed_count + at_once - 1) / at_once;
  RowSums<Real> sums;
  for (std::uint32_t turn = 0; turn < width;) {
    const std::uint32_t held = blocks.begin(turn, width - turn);
    sums.force.setZero();  // every turn has all of them
    // What the next points need is read ahead of the arithmetic of these, what the first need beside the neighbours.
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
          return {load3<Real>(s.displacement, other), terms.stretch_ahead(other)};
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
            // All at once and not before: to wait for the neighbours would be to wait for these, too.
            next[k] = element_of(listed[k], round + 1, k);
            listed[k] = listed_at(column_of(round + 2, k));
            packed[k] = places_at(column_of(round + 1, k));
          }
          ahead[k] = point_at(ends ? next[k] : now[k], ends ? 0 : q + 1);
        }
        if (kind == physics::Stiffness::kPositive) {
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
            const auto memory = remember<Lanes, Law>(e, q, element, points[k], s.control->dt_s, Real(0));
            add(k, &memory);
          }
        }
      }
      TM_UNROLL_ALL
      for (std::uint32_t k = 0; k < kAtOnce; ++k) {
        tensors[k].complete([&](int l) { return places[k].is_own(l); });
        // Without turns rounds end with the first element that is none.
        const bool adds = (!kAddsInTurns<Shape> && k == 0) || now[k] != kNoPlace;
        if (adds) sums.force += tensors[k].force;
        blocks.add(places[k].others(), tensors[k].stiffness, adds);
        now[k] = next[k];
      }
    }
    const RowAssembly<false, Real> assembly(s, patch, own);
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
          if (begun) edge += load_block<Real>(s.edges, slot);
          store_block<Real>(s.edges, slot, finishes ? assembly.couple(slot, neighbour, edge, sums) : edge);
        });
    turn += held;
    if (turn < width || !blocks.leads(sums)) continue;  // what has elements has columns: there is a last turn
    if (begun) sums.force += load3<Real>(s.rhs, own);
    if (finishes) {
      assembly.finish(sums);
    } else {
      store3<Real>(s.rhs, own, sums.force);
    }
  }
}

/// Ends the rows where groups do not: in scenes with linear laws.
/// Reads constant tensors, displacement, velocity, base fields, external, and edges and rhs where begun; writes edges,
/// diagonal, rhs, internal_force.
template <bool HasConstant, class Team, class Real>
TM_HOST_DEVICE void finish_rows(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const bool begun = s.begun_slices[row / kSliceRows] != 0;
    const RowAssembly<HasConstant, Real> assembly(s, patch, row);
    RowSums<Real> sums;
    if (begun) sums.force = load3<Real>(s.rhs, row);
    const std::uint32_t slice = row / kSliceRows;
    const auto slot_of = [lane = row % kSliceRows](std::uint32_t column) {
      return std::size_t{column} * kSliceRows + lane;
    };
    constexpr std::uint32_t kAtOnce = 4;  // a constant tensor takes nine registers
    for_each_strided<kAtOnce>(
        s.slice_begin[slice], s.slice_begin[slice + 1], 1,
        [&](std::uint32_t j) { return assembly.neighbour(slot_of(j)); },
        [&](std::uint32_t j, const auto& neighbour) {
          const std::size_t slot = slot_of(j);
          const Mat3<Real> edge = begun ? load_block<Real>(s.edges, slot) : Mat3<Real>(Mat3<Real>::Zero());
          store_block<Real>(s.edges, slot, assembly.couple(slot, neighbour, edge, sums));
        });
    assembly.finish(sums);
  });
}

}  // namespace tensormass::tensor
