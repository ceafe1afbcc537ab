#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "view/patches.h"

/// Storage::kRows: the order in which rows and their neighbours meet the banks of a device's near memory.
///
/// A thread has a row and reads the vectors of its neighbours, four numbers at once, with seven other threads beside
/// it. The eight reads are one if their columns differ modulo eight, and wait for each other where they do not. Any
/// order is as good otherwise, so rows are exchanged among the eight of a group, halos likewise, and the neighbours of
/// a row at will. Two random columns of eight meet so often that an iteration reads half as long again as it needs to.
namespace tensormass::matrix {

using namespace view;

/// Wider slices keep their neighbours ascending: they would not fit into near memory anyway, and the order below takes
/// the square of the width.
inline constexpr std::uint32_t kMostSpreadColumns = 64;

/// rows: the columns of each row of a patch. Returns the place of each of its `column_count` columns, within the same
/// aligned group of eight, so that in each group of rows all banks are read about equally often. Columns that no row
/// names keep their place.
std::vector<std::uint32_t> places_by_bank(const mesh::Rows& rows, std::uint32_t column_count);

/// Orders the neighbours of each row of a slice. columns and neighbour_rows: [width][kSliceRows], as in Layout; ends:
/// [kSliceRows] how many of each row are neighbours, the others padding, which stays behind.
void order_by_bank(std::span<std::uint32_t> columns, std::span<std::uint32_t> neighbour_rows,
                   std::span<const std::uint32_t> ends);

}  // namespace tensormass::matrix
