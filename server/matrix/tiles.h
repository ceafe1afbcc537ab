#pragma once

#include <cstdint>
#include <span>

#include "view/patches.h"

/// Storage::kTiles: the rows of a patch in tiles of neighbouring rows, each of which one warp multiplies.
///
/// Two rows i and j of a tile are coupled by A_ij and by A_ji = A_ijᵀ, and a warp that has read one of them needs no
/// other: it adds A_ij p_j to q_i and A_ijᵀ p_i to q_j. So a row's neighbours are ordered: first those that the warp
/// reads, then those whose blocks it has from other rows. The matrix is assembled whole, and whoever wants full rows
/// reads them as in Storage::kRows. A solve whose matrix comes from memory in each iteration reads two blocks for
/// three.
///
/// What a warp adds to other rows is added column by column, to 32 different ones.
namespace tensormass::matrix {

using namespace view;

/// Warps of a patch, and so tiles that are walked at once; and what each has near memory for.
inline constexpr std::uint32_t kTilesAtOnce = 16, kMostTileRows = 256;

/// How many rows tiles get where the largest patch has `most_rows`: as many for each warp, a multiple of kSliceRows.
std::uint32_t rows_of_tiles(std::uint32_t most_rows);

/// A tile's part of a layout. columns and neighbour_rows: [column of its slices][kSliceRows], as in Layout.
struct TileSlots {
  std::uint32_t first_row;                ///< patch-local
  std::span<const std::uint32_t> widths;  ///< of its slices, in columns
  std::span<std::uint32_t> columns, neighbour_rows;
};

/// Orders the neighbours of each row of a tile. Slices keep their widths.
/// read_widths: [slice] how many of its columns are to be read.
/// used_twice: [column of the slices] bit for bit of a lane whether its block serves the row that it names, too.
void order_tile(const TileSlots& tile, std::span<std::uint32_t> read_widths, std::span<std::uint32_t> used_twice);

}  // namespace tensormass::matrix
