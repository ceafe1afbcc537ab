#pragma once

#include <cstdint>
#include <span>

#include "view/patches.h"

/// Storage::kTiles: the order in which a tile stores its blocks, so that a solve reads two blocks instead of three.
///
/// Why: a solve that streams the matrix from memory is as fast as its reads. A is symmetric, so A_ji = A_ijᵀ for two
/// rows i and j. A warp that multiplies both rows needs to read only A_ij:
///
///   q_i += A_ij p_j          the row that reads the pair
///   q_j += A_ijᵀ p_i         its partner; the slot of A_ji is "mirrored" and is not read
///
/// A tile is a run of neighbouring rows of one patch. One warp multiplies all of its rows. It finds the columns of a
/// slice in this order:
///
///   slice_begin       slice_read            next slice_begin
///        | read columns    | mirrored columns    |
///
///   read      The warp reads these blocks: neighbours outside of the tile, and the pairs that the row reads.
///   mirrored  The warp has these blocks from the partner rows.
///
/// In each read column the 32 lanes add to 32 different partner rows, so that no two lanes write to one address.
///
/// The matrix is assembled whole. Code that wants full rows reads all columns, as with Storage::kRows.
namespace tensormass::matrix {

using namespace view;

/// Warps of a patch: as many tiles are multiplied at once.
inline constexpr std::uint32_t kTilesAtOnce = 16;
/// Most rows of a tile: a warp has room for the sums of so many in shared memory.
inline constexpr std::uint32_t kMaxTileRows = 256;

/// Returns the rows of a tile where the largest patch has `most_rows` ≥ 1: each warp gets about as many, and the result
/// is a multiple of kSliceRows.
std::uint32_t rows_of_tiles(std::uint32_t most_rows);

/// A tile's part of a layout. columns and neighbour_rows: [column of its slices][kSliceRows], as in Layout.
struct TileSlots {
  std::uint32_t first_row;                ///< patch-local
  std::span<const std::uint32_t> widths;  ///< [slice] columns of each slice
  std::span<std::uint32_t> columns, neighbour_rows;
};

/// Orders the neighbours of each row of a tile. Slices keep their widths. Deterministic.
///
/// read_widths: [slice] is set to the number of read columns.
/// used_twice:  [column] is set to a word of bits: bit i if the block of lane i also serves the row that it names.
void order_tile(const TileSlots& tile, std::span<std::uint32_t> read_widths, std::span<std::uint32_t> used_twice);

}  // namespace tensormass::matrix
