#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>

#include "backend/cuda/resident_memory.h"
#include "backend/cuda/streamed_memory.h"
#include "matrix/layout.h"

/// How much of the largest patch fits into the shared memory of a block. solve_plan.cuh chooses the kernel by it.
namespace tensormass::backend::cuda {

/// The largest numbers of rows of any patch.
struct PatchSizes {
  std::uint32_t rows = 0, halo = 0, locals = 0;  // locals: own and halo of one patch
};
inline PatchSizes largest_sizes(const matrix::Layout& layout) {
  PatchSizes most{0, 0, layout.largest_patch()};
  for (std::uint32_t p = 0; p < layout.patch_count; ++p) {
    most.rows = std::max(most.rows, layout.patch_rows[p + 1] - layout.patch_rows[p]);
    most.halo = std::max(most.halo, layout.patch_halo[p + 1] - layout.patch_halo[p]);
  }
  return most;
}

/// Shared memory of a resident solve.
struct ResidentRoom {
  bool whole;                     ///< it holds all further columns of every patch
  std::uint32_t column_capacity;  ///< columns that it has room for, at most as many as are needed
  std::size_t bytes;
};
/// Returns nothing if the vectors of the largest patch do not fit.
/// held: columns of a slice in registers.
/// most_bytes: shared memory of a block.
inline std::optional<ResidentRoom> resident_room(const matrix::Layout& layout, const PatchSizes& most,
                                                 std::uint32_t held, std::size_t most_bytes) {
  const std::size_t vectors = resident_vector_bytes(most.locals, most.halo);
  if (vectors > most_bytes || most.locals * kCellBytes > kMaxOffset) return std::nullopt;
  std::uint32_t needed = 0;
  for (std::uint32_t p = 0; p < layout.patch_count; ++p) {
    std::uint32_t columns = 0;
    for (std::uint32_t i = layout.patch_rows[p] / kSliceRows; i < layout.patch_rows[p + 1] / kSliceRows; ++i) {
      columns += further_columns(layout.slice_begin[i + 1] - layout.slice_begin[i], held);
    }
    needed = std::max(needed, columns);
  }
  const auto room = static_cast<std::uint32_t>((most_bytes - vectors) / kResidentBytesPerColumn);
  const std::uint32_t capacity = std::min(needed, room);
  return ResidentRoom{needed <= room, capacity, vectors + capacity * kResidentBytesPerColumn};
}

/// Vectors in shared memory, and the bytes of shared memory that they and the tiles take.
struct StreamedRoom {
  std::uint32_t near_vectors = 0;
  std::size_t bytes = 0;
};
/// Decides which vectors of the largest patch are in shared memory. Memory that stays free serves as L1 cache.
/// most_rows, most_locals: of any patch, without and with its halo.
/// most_bytes: shared memory of a block.
inline StreamedRoom streamed_room(std::uint32_t most_rows, std::uint32_t most_locals, std::uint32_t tile_rows,
                                  std::size_t most_bytes) {
  StreamedRoom room{0, streamed_tile_rows(most_rows, tile_rows) * kStreamedBytesPerCell};
  const auto place = [&](StreamedVectors which, std::size_t bytes) {
    bytes = round_to_cells(bytes);
    if (room.bytes + bytes > most_bytes) return;
    room.bytes += bytes;
    room.near_vectors |= which;
  };
  place(kNearDirection, most_locals * kStreamedBytesPerCell);
  place(kNearResidual, most_locals * kStreamedBytesPerVector);
  place(kNearSolution, most_rows * kStreamedBytesPerVector);
  return room;
}

/// Returns the largest number of rows of a patch, own and halo, for which p and r certainly stay in shared memory.
/// There is then also room for the tiles' q, and for the positions of PatchVolume.
constexpr std::uint32_t most_kept_rows(std::size_t bytes_per_block) {
  constexpr std::size_t kStaticBytes = 2048;  // most that the kernels declare themselves
  constexpr std::size_t kBytesPerRow = 2 * kStreamedBytesPerCell + kStreamedBytesPerVector;
  return static_cast<std::uint32_t>((bytes_per_block - kStaticBytes) / kBytesPerRow);
}

}  // namespace tensormass::backend::cuda
