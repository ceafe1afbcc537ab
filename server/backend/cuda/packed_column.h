#pragma once

#include <cstdint>

#include "matrix/tiles.h"
#include "view/matrix.h"

/// Places of the packed matrix, and the order in which a warp walks it (packed_matrix.cuh).
///
///   one column, in the memory of its 32 unpacked blocks:
///     │ pair 0, lanes 0..31 │ pair 1 │ pair 2 │ Neighbour, lanes 0..31 │ PackedDiagonal, lanes 0..31 │
///     │ 256 bytes           │        │        │ 64 or 128 bytes        │ first column of a slice only│
///
///   Word   type of a Neighbour: 16 or 32 bits
///   Pair   two words of 32 bits that are read at once; a parameter, so that tests need no CUDA
namespace tensormass::backend::cuda {

using view::kSliceRows;

/// The columns of a slice that a solve reads.
struct ReadColumns {
  std::uint32_t begin, end;
  TM_HOST_DEVICE ReadColumns(const view::MatrixView<float>& matrix, std::uint32_t slice)
      : begin(matrix.slice_begin[slice]),
        end(matrix.slice_read != nullptr ? matrix.slice_read[slice] : matrix.slice_begin[slice + 1]) {}
};

/// The patch-local row behind a slot; the top bit says whether the block serves that row too. 16 bits suffice for small
/// patches.
template <class Word>
struct Neighbour {
  static constexpr std::uint32_t kServesBoth = 1u << (8 * sizeof(Word) - 1), kMaxLocals = kServesBoth;
  TM_HOST_DEVICE static Word of(std::uint32_t local, bool serves_both) {
    return static_cast<Word>(local | (serves_both ? kServesBoth : 0));
  }
  TM_HOST_DEVICE static std::uint32_t local(Word word) { return word & (kServesBoth - 1); }
  TM_HOST_DEVICE static bool serves_both(Word word) { return (word & kServesBoth) != 0; }
};

/// Addresses of one packed column, as drawn above.
template <class Word, class Pair>
class PackedColumn {
 public:
  TM_HOST_DEVICE PackedColumn(float* edges, std::uint32_t column)
      : pairs_(reinterpret_cast<Pair*>(edges + view::block_begin(std::size_t{column} * kSliceRows))),
        neighbours_(reinterpret_cast<Word*>(pairs_ + kPairs * kSliceRows)),
        diagonals_(reinterpret_cast<Pair*>(neighbours_ + kSliceRows)) {}

  TM_HOST_DEVICE Pair* pair(std::uint32_t which, std::uint32_t lane) const {
    return pairs_ + which * kSliceRows + lane;
  }
  TM_HOST_DEVICE Word* neighbour(std::uint32_t lane) const { return neighbours_ + lane; }
  TM_HOST_DEVICE Pair* diagonal(std::uint32_t lane) const { return diagonals_ + lane; }

 private:
  static constexpr std::uint32_t kPairs = 3;
  static_assert(sizeof(Pair) == 8 && kPairs * sizeof(Pair) + sizeof(Word) + sizeof(Pair) <= 9 * sizeof(float));

  Pair* pairs_;       // [pair][lane]
  Word* neighbours_;  // [lane]
  Pair* diagonals_;   // [lane]
};

/// The walk of a warp over the slices of its tiles, over and over. Tile t of a patch belongs to warp t mod Warps.
template <unsigned Warps>
struct TileSteps {
  const std::uint32_t tile_rows, own, begin;  // own: rows of the patch.  begin: first row of the warp's first tile
  std::uint32_t first;                        // first row of the current tile
  std::uint32_t slice, slices;                // current slice in the tile; slices of the tile

  TM_HOST_DEVICE TileSteps(std::uint32_t tile_rows_, std::uint32_t own_, std::uint32_t warp)
      : tile_rows(tile_rows_), own(own_), begin(warp * tile_rows_) {}

  TM_HOST_DEVICE bool has_tile() const { return begin < own; }
  /// End of the rows of the current tile.
  TM_HOST_DEVICE std::uint32_t last() const { return minimum(first + tile_rows, own); }
  TM_HOST_DEVICE void begin_tile(std::uint32_t first_row) {
    first = first_row;
    slice = 0;
    slices = (last() - first) / kSliceRows;
  }
  /// Goes on to the next slice.
  ///
  ///   begin_slice()    called for a slice of the current tile
  ///   begin_tile(row)  called for the first slice of another tile, which starts at this row; must call begin_tile
  template <class BeginSlice, class BeginTile>
  TM_HOST_DEVICE void next(const BeginSlice& begin_slice, const BeginTile& begin_other_tile) {
    if (++slice < slices) return begin_slice();
    std::uint32_t next = first + Warps * tile_rows;
    if (next >= own) next = begin;
    if (next != first) return begin_other_tile(next);
    slice = 0;
    begin_slice();
  }
};

}  // namespace tensormass::backend::cuda
