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

/// Parts of a slice, if each has a sum of its own. Usually two, so that one's reads are hidden by the other's
/// arithmetic. More if a small scene has too few slices for all multiprocessors.
inline constexpr std::uint32_t kUsualParts = 2, kMaxPartsWithSums = 4;
/// Most parts of a slice that have one sum.
inline constexpr std::uint32_t kMaxParts = 8;
/// Smallest capacity. After the last turn kMaxParts parts leave their RowSums where the blocks were
/// (SharedBlocks::leads).
inline constexpr std::uint32_t kLeastColumns = (kMaxParts * kSumsReals + 8) / 9;

struct RowsLaunch {
  std::uint32_t capacity;  ///< columns that fit into shared memory at once
  unsigned threads;
  std::size_t shared_bytes;
};

/// Returns the launch of assemble_rows for a shape whose parts have a sum each.
/// slices: number of slices of the group.
/// widest: largest width of a slice, in columns.
/// keeps_neighbours: of the group's shape (matrix/rows.h).
/// processors: multiprocessors of the device.
/// most_bytes: shared memory of a block if two fit on a multiprocessor.
template <class Real>
RowsLaunch launch_with_sums(std::uint32_t slices, std::uint32_t widest, bool keeps_neighbours, std::uint32_t processors,
                            std::size_t most_bytes) {
  constexpr std::uint32_t kWarpsPerProcessor = 16;
  const auto bytes_per_column = [=](std::uint32_t parts) {
    return column_reals(keeps_neighbours, parts) * kSliceRows * sizeof(Real);
  };
  const auto room = [=](std::uint32_t parts) {
    return static_cast<std::uint32_t>(most_bytes / bytes_per_column(parts));
  };
  const std::uint32_t capacity = maximum(kLeastColumns, minimum(widest, room(1)));
  const std::uint32_t wanted = maximum(kUsualParts, kWarpsPerProcessor * processors / maximum(slices, 1u));
  std::uint32_t parts = minimum(wanted, kMaxPartsWithSums);
  while (parts > 1 && room(parts) < capacity) --parts;
  return {capacity, parts * kSliceRows, capacity * bytes_per_column(parts)};
}

/// Returns the launch of assemble_rows for a shape whose parts have one sum. A multiprocessor gets as many warps as a
/// thread with all registers leaves room for: by more parts, where shared memory or the number of slices allows few
/// blocks.
/// slices, widest: as for launch_with_sums.
/// most_bytes: shared memory of a block.
///
///   blocks_at_once(threads, shared_bytes)   returns how many blocks a multiprocessor runs at once
template <class Real, class BlocksAtOnce>
RowsLaunch launch_in_turns(std::uint32_t slices, std::uint32_t widest, std::uint32_t processors, std::size_t most_bytes,
                           const BlocksAtOnce& blocks_at_once) {
  constexpr std::uint32_t kWarpsPerProcessor = 8;
  constexpr std::size_t kBytesPerColumn = column_reals(false, 1) * kSliceRows * sizeof(Real);
  const std::uint32_t room = static_cast<std::uint32_t>(most_bytes / kBytesPerColumn);
  RowsLaunch launch{maximum(kLeastColumns, minimum(widest, room)), kUsualParts * kSliceRows, 0};
  launch.shared_bytes = launch.capacity * kBytesPerColumn;
  const std::uint32_t slices_each = maximum((slices + processors / 2) / processors, 1u);
  for (std::uint32_t parts = kUsualParts; parts <= kMaxParts; parts *= 2) {
    const std::uint32_t blocks = blocks_at_once(parts * kSliceRows, launch.shared_bytes);
    if (blocks == 0) break;  // too many threads
    launch.threads = parts * kSliceRows;
    if (minimum(slices_each, blocks) * parts >= kWarpsPerProcessor) break;
  }
  return launch;
}

/// Returns how many of the slices, from the first on, one launch should assemble; another one assembles the rest. All
/// slices of a launch take as much shared memory as its widest, so wide slices are kept apart if they are few.
/// slices: begin and end of each slice's columns.
template <class Slices>
std::uint32_t wide_slices(const Slices& slices) {
  std::uint32_t widest = 0, wide = 0;
  const auto width = [](const auto& slice) { return slice.columns_end - slice.columns_begin; };
  for (const auto& slice : slices) widest = maximum(widest, width(slice));
  for (std::uint32_t i = 0; i < slices.size(); ++i) {
    if (2 * width(slices[i]) > widest) wide = i + 1;
  }
  return 2 * wide <= slices.size() ? wide : static_cast<std::uint32_t>(slices.size());
}

}  // namespace tensormass::backend::cuda
