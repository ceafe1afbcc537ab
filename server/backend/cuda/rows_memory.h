#pragma once

#include <cstdint>

#include "view/patches.h"

/// Shared memory of the assembly by rows (rows.cuh), and the size of its launch.
///
///   part      warp of the block: parts share the rows of a slice
///   sum       copy of the blocks to which a part adds: one for all parts, or one for each
///   column    of the slice, from the first one of the turn on;  capacity: columns that fit at once
///   Quad      four reals, read and written at once
///
///   Quads of the blocks  [sum][column][2][32 rows]
///   ninth components     [sum][column][32 rows]
///   neighbours           [column][6][32 rows], only if they are kept
namespace tensormass::backend::cuda {

using view::kSliceRows;

/// Reals of the RowSums of a row, which parts exchange.
inline constexpr std::uint32_t kSumsReals = 15;

/// Reals of a column in shared memory: one block for each sum, and the neighbour if it is kept.
TM_HOST_DEVICE constexpr std::uint32_t column_reals(bool keeps_neighbours, std::uint32_t sums) {
  return 9 * sums + (keeps_neighbours ? 6 : 0);
}

/// Returns the Quad of a row with the first four components of a block. Those with the next four are kSliceRows later.
/// place, first: columns of the slice, of the block and the first of the turn.
TM_HOST_DEVICE constexpr std::uint32_t quad_place(std::uint32_t sum, std::uint32_t capacity, std::uint32_t place,
                                                  std::uint32_t first) {
  return (sum * capacity + place - first) * (2 * kSliceRows);
}
/// Returns the place of the ninth component, behind the Quads.
TM_HOST_DEVICE constexpr std::uint32_t single_place(std::uint32_t sum, std::uint32_t capacity, std::uint32_t place,
                                                    std::uint32_t first) {
  return (sum * capacity + place - first) * kSliceRows;
}
/// Reals of a column of neighbours.
inline constexpr std::uint32_t kNeighbourColumnReals = column_reals(true, 0) * kSliceRows;
/// Returns the place of component c of a neighbour, behind the ninth components.
TM_HOST_DEVICE constexpr std::uint32_t neighbour_place(std::uint32_t column, std::uint32_t c) {
  return (column * column_reals(true, 0) + c) * kSliceRows;
}
/// Returns the place of the RowSums of a part, where the blocks were.
TM_HOST_DEVICE constexpr std::uint32_t row_sums_place(std::uint32_t part) { return part * (kSumsReals * kSliceRows); }

/// Parts of a slice. Usually two, so that one's reads are hidden by the other's arithmetic. More if a small scene has
/// too few slices for all multiprocessors.
inline constexpr std::uint32_t kUsualParts = 2, kMostParts = 4;
/// Smallest capacity. After the last turn kMostParts parts leave their RowSums where the blocks were
/// (SharedBlocks::leads).
inline constexpr std::uint32_t kLeastColumns = (kMostParts * kSumsReals + 8) / 9;

struct RowsLaunch {
  std::uint32_t capacity;  ///< columns that fit into shared memory at once
  unsigned threads;
  std::size_t shared_bytes;
};

/// Returns the launch of assemble_rows.
/// slices: number of slices of the group.
/// widest: largest width of a slice, in columns.
/// keeps_neighbours, adds_in_turns: of the group's shape (matrix/rows.h).
/// processors: multiprocessors of the device.
/// most_bytes: shared memory of a block if two fit on a multiprocessor.
template <class Real>
RowsLaunch rows_launch(std::uint32_t slices, std::uint32_t widest, bool keeps_neighbours, bool adds_in_turns,
                       std::uint32_t processors, std::size_t most_bytes) {
  constexpr std::uint32_t kWarpsPerProcessor = 16;
  const auto bytes_per_column = [=](std::uint32_t parts) {
    return column_reals(keeps_neighbours, adds_in_turns ? 1 : parts) * kSliceRows * sizeof(Real);
  };
  const auto room = [=](std::uint32_t parts) {
    return static_cast<std::uint32_t>(most_bytes / bytes_per_column(parts));
  };
  const std::uint32_t capacity = maximum(kLeastColumns, minimum(widest, room(1)));
  const std::uint32_t wanted = maximum(kUsualParts, kWarpsPerProcessor * processors / maximum(slices, 1u));
  std::uint32_t parts = minimum(wanted, kMostParts);
  while (parts > 1 && room(parts) < capacity) --parts;
  return {capacity, parts * kSliceRows, capacity * bytes_per_column(parts)};
}

}  // namespace tensormass::backend::cuda
