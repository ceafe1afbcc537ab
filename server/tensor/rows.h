#pragma once

#include "tensor/assembly.h"

/// Elements to rows where a thread owns a row: it evaluates every element that the row touches and keeps what belongs
/// to the row.
///
/// Between threads nothing is exchanged, no tensor of an element is stored anywhere, and every sum runs in the order of
/// the row's list. Each element is evaluated once for each of its nodes, but of its tensors a node computes its own row
/// only, and gathering takes as long as the arithmetic that this repeats.
///
/// A row's blocks so far, and the displacements of its neighbours against its own, are in `Blocks`, which a device
/// keeps in memory that is near. It holds `capacity()` columns at once; a wider row comes in turns.
namespace tensormass::tensor {

/// A place is the column of a row's slot in its slice, in 8 or 16 bits; that of the row itself has all bits set.
TM_HOST_DEVICE constexpr std::uint32_t own_place(std::uint32_t bits) { return bits == 8 ? 0xFF : 0xFFFF; }
TM_HOST_DEVICE constexpr std::uint32_t place_words(std::uint32_t nodes, std::uint32_t bits) {
  return (nodes * bits + 31) / 32;
}

/// Where the blocks of an element belong in one of its rows.
template <int Nodes>
struct Places {
  std::uint32_t of[Nodes];  // of node l
  std::uint32_t own;        // the place of the row itself

  /// As they are stored.
  struct Packed {
    std::uint32_t words[place_words(Nodes, 16)];
    template <class Real>
    TM_HOST_DEVICE static Packed read(const ElementView<Real>& e, std::uint32_t column, std::uint32_t lane) {
      Packed packed;
      const std::uint32_t count = place_words(Nodes, e.place_bits);
      const std::uint32_t* words = e.places + std::size_t{column} * count * kSliceRows + lane;
      TM_UNROLL_ALL
      for (std::uint32_t i = 0; i < place_words(Nodes, 16); ++i) {
        packed.words[i] = i < count ? words[i * kSliceRows] : 0;
      }
      return packed;
    }
  };

  TM_HOST_DEVICE Places(const Packed& packed, std::uint32_t bits) : own(own_place(bits)) {
    if (bits == 8) {
      unpack<8>(packed);
    } else {
      unpack<16>(packed);
    }
  }

 private:
  template <std::uint32_t Bits>
  TM_HOST_DEVICE void unpack(const Packed& packed) {
    constexpr std::uint32_t kInWord = 32 / Bits;
    TM_UNROLL_ALL
    for (std::uint32_t l = 0; l < Nodes; ++l) of[l] = packed.words[l / kInWord] >> (Bits * (l % kInWord)) & own;
  }
};

/// Calls use(j, load(j)) for every `step`-th column in [begin, end). Loads are under way eight at a time: each is a
/// chain of reads that depend on each other.
template <class Load, class Use>
TM_HOST_DEVICE void each_column(std::uint32_t begin, std::uint32_t end, std::uint32_t step, const Load& load,
                                const Use& use) {
  constexpr std::uint32_t kAtOnce = 8;
  for (std::uint32_t first = begin; first < end; first += kAtOnce * step) {
    decltype(load(first)) loaded[kAtOnce];
    TM_UNROLL_ALL
    for (std::uint32_t i = 0; i < kAtOnce; ++i) loaded[i] = load(first + i * step < end ? first + i * step : first);
    TM_UNROLL_ALL
    for (std::uint32_t i = 0; i < kAtOnce; ++i) {
      if (first + i * step < end) use(first + i * step, loaded[i]);
    }
  }
}

/// What an element adds to one of its rows (physics::add_point_to_node).
template <int Nodes, class Real, class Blocks>
struct RowShare {
  const Places<Nodes>& places;
  Blocks& blocks;
  RowSums<Real>& sums;

  TM_HOST_DEVICE bool is_own(int l) const { return places.of[l] == places.own; }
  TM_HOST_DEVICE void add_force(const Vec3<Real>& force) { sums.force += force; }
  TM_HOST_DEVICE void add_edge(int l, const Mat3<Real>& block) {
    if (blocks.holds(places.of[l])) blocks.add(places.of[l], block);
  }
};

/// The row `lane` of the slice at `index` of a group's slices: adds the group's elements and, if it is the last group
/// there, forms the row of A and b. Several threads may share a row: then each has a part of its elements and, when
/// their sums have been put together, of its columns. Blocks has
///   parts(), part()                     how many threads share the row, and which one this is
///   begin(column, count)                places are from `column` on, as far as they fit; returns how many
///   clear(place, stretch)               for all parts: no block yet
///   holds(place), stretch(place), add(place, block)
///   meet()                              all parts have done what they had to
///   block(place)                        the sum of all parts
///   leads(sums)                         adds up the sums of all parts; whether this part is to use them
/// Reads displacement, velocity, base fields, history; writes edges, diagonal, rhs, internal_force.
template <class Shape, class Law, class Real, class Blocks>
TM_HOST_DEVICE void assemble_row(const SceneView<Real>& s, const ElementView<Real>& e, std::uint32_t index,
                                 std::uint32_t lane, Blocks& blocks) {
  using Lanes = SingleLane<Real>;
  using Stored = StoredPoint<Lanes, Shape, Law>;
  const std::uint32_t slice = e.slices[index] / 4;
  const bool begun = (e.slices[index] & 1) != 0, finishes = (e.slices[index] & 2) != 0;
  const std::uint32_t row = slice * kSliceRows + lane, first = s.slice_begin[slice];
  const std::uint32_t width = s.slice_begin[slice + 1] - first;
  const std::uint32_t list_begin = e.list_begin[index] + blocks.part(), list_end = e.list_begin[index + 1];
  const Patch patch = patch_of(s, s.patch_of_slice[slice]);
  const Vec3<Real> own_displacement = load3<Real>(s.displacement, row);
  const physics::Stiffness kind = stiffness_kind(s);
  const auto slot_of = [first, lane](std::uint32_t column) {
    return (std::size_t{first} + column) * kSliceRows + lane;
  };
  const auto stretch_of = [&](std::uint32_t column) -> Vec3<Real> {
    return load3<Real>(s.displacement, global_row(s, patch, s.columns[slot_of(column)])) - own_displacement;
  };
  const auto element_at = [&e, list_end, lane](std::uint32_t i) {
    return i < list_end ? e.listed[std::size_t{i} * kSliceRows + lane] : kNoPlace;
  };
  RowSums<Real> sums;
  for (std::uint32_t turn = 0; turn < width;) {
    const std::uint32_t held = blocks.begin(turn, width - turn);
    each_column(turn + blocks.part(), turn + held, blocks.parts(), stretch_of,
                [&](std::uint32_t j, const Vec3<Real>& stretch) { blocks.clear(j, stretch); });
    blocks.meet();
    sums.force.setZero();  // every turn has all of them
    // What the next point needs is read ahead of the arithmetic of this one.
    std::uint32_t element = element_at(list_begin), next = element_at(list_begin + blocks.parts());
    Stored ahead;
    typename Places<Shape::kNodes>::Packed packed{};
    if (element != kNoPlace) {
      packed = Places<Shape::kNodes>::Packed::read(e, list_begin, lane);
      ahead = Stored(e, 0, element);
    }
    for (std::uint32_t i = list_begin; element != kNoPlace; i += blocks.parts()) {
      const std::uint32_t after_next = element_at(i + 2 * blocks.parts());
      const Places<Shape::kNodes> places(packed, e.place_bits);
      if (next != kNoPlace) packed = Places<Shape::kNodes>::Packed::read(e, i + blocks.parts(), lane);
      // Against the row's own displacement, which F does not notice.
      Vec3<Real> u[Shape::kNodes];
      TM_UNROLL_ALL
      for (int l = 0; l < Shape::kNodes; ++l) {
        u[l] = Vec3<Real>::Zero();
        if (places.of[l] != places.own) {
          u[l] = blocks.holds(places.of[l]) ? blocks.stretch(places.of[l]) : stretch_of(places.of[l]);
        }
      }
      RowShare<Shape::kNodes, Real, Blocks> share{places, blocks, sums};
      TM_UNROLL(1)
      for (std::uint32_t q = 0; q < points_of<Shape>(e); ++q) {
        const Stored now = ahead;
        const bool ends = q + 1 == points_of<Shape>(e);
        if (!ends || next != kNoPlace) ahead = Stored(e, ends ? 0 : q + 1, ends ? next : element);
        const auto gradients = now.gradients();
        const Mat3<Real> f = gradients.deformation_gradient(u);
        auto point = now.law_at(e, q, f);
        with_memory<Lanes, Law>(s, e, q, element, point, Real(0), [&](const auto* memory) {
          physics::add_point_to_node<Shape, Law>(gradients, f, point, memory, kind, share);
        });
      }
      element = next;
      next = after_next;
    }
    blocks.meet();
    const RowAssembly<false, Real> assembly(s, patch, row);
    each_column(
        turn + blocks.part(), turn + held, blocks.parts(),
        [&](std::uint32_t j) { return assembly.neighbour(s.columns[slot_of(j)]); },
        [&](std::uint32_t j, const auto& neighbour) {
          const std::size_t slot = slot_of(j);
          Mat3<Real> edge = blocks.block(j);
          if (begun) edge += load_block<Real>(s.edges, slot);
          store_block<Real>(s.edges, slot, finishes ? assembly.couple(slot, neighbour, edge, sums) : edge);
        });
    turn += held;
  }
  if (!blocks.leads(sums)) return;
  if (begun) sums.force += load3<Real>(s.rhs, row);
  if (finishes) {
    RowAssembly<false, Real>(s, patch, row).finish(sums);
  } else {
    store3<Real>(s.rhs, row, sums.force);
  }
}

/// Ends the rows where groups do not: in scenes with linear laws.
/// Reads constant tensors, displacement, velocity, base fields; writes edges, diagonal, rhs, internal_force.
template <bool HasConstant, class Team, class Real>
TM_HOST_DEVICE void finish_rows(const Team& team, const SceneView<Real>& s) {
  const Patch patch = patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const bool begun = s.begun_slices[row / kSliceRows] != 0;
    const RowAssembly<HasConstant, Real> assembly(s, patch, row);
    RowSums<Real> sums;
    if (begun) sums.force = load3<Real>(s.rhs, row);
    for_each_slot(s, row, [&](std::size_t slot, std::uint32_t column) {
      const Mat3<Real> edge = begun ? load_block<Real>(s.edges, slot) : Mat3<Real>(Mat3<Real>::Zero());
      store_block<Real>(s.edges, slot, assembly.couple(slot, assembly.neighbour(column), edge, sums));
    });
    assembly.finish(sums);
  });
}

}  // namespace tensormass::tensor
