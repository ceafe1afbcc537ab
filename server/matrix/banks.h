#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "view/patches.h"

/// Storage::kRows: an order of rows and neighbours that avoids bank conflicts in a GPU's shared memory.
///
/// Why: a thread multiplies one row and reads the vector of each neighbour, four reals at once. Eight threads read
/// together. Vectors whose local numbers are equal modulo eight lie in one bank:
///
///   local number   0  1  2  3  4  5  6  7  8  9 ...
///   bank           0  1  2  3  4  5  6  7  0  1 ...      8 different banks: one read; else the reads queue
///
/// In a random order the reads of an iteration take half as long again. Any order gives the same matrix, so two things
/// are free to change: the places of rows within an aligned group of eight (halos likewise), and the order of
/// the neighbours within a row.
namespace tensormass::matrix {

using namespace view;

/// Widest slice [columns] whose neighbours are ordered by bank or tile. Wider slices keep their neighbours ascending:
/// they do not fit into shared memory anyway, and the order takes time with the square of the width.
inline constexpr std::uint32_t kMaxSpreadColumns = 64;

/// Returns a new place for each of the `column_count` local numbers, within the same aligned group of eight. Each group
/// of eight rows then reads all banks about equally often. Numbers that no row names keep their place.
///
/// rows: the local numbers that each row of a patch reads.
std::vector<std::uint32_t> places_by_bank(const mesh::Rows& rows, std::uint32_t column_count);

/// Orders the neighbours of each row of a slice so that eight rows side by side read different banks in each column.
///
/// columns, neighbour_rows: [width][kSliceRows], as in Layout.
/// ends:                    [kSliceRows] the number of neighbours of each row. Padding follows them and stays there.
void order_by_bank(std::span<std::uint32_t> columns, std::span<std::uint32_t> neighbour_rows,
                   std::span<const std::uint32_t> ends);

}  // namespace tensormass::matrix
