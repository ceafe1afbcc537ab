#pragma once

#include <cstdint>

#include "matrix/tiles.h"

/// Which vectors streamed_solve.cuh keeps in shared memory, and where.
///
///   │ q of the tiles that warps work on │ p │ r │ x │      from p on as far as shared memory reaches
namespace tensormass::backend::cuda {

/// Shared memory of streamed_solve [bytes]: of q and p a row, and of r and x a row.
inline constexpr std::size_t kStreamedBytesPerCell = 16, kStreamedBytesPerVector = 12;

/// Vectors that streamed_solve keeps in shared memory, one bit each, in this order. Besides them shared memory has the
/// q of the current tiles (kStreamedBytesPerCell a row). That is all of q if each warp has one tile.
enum StreamedVectors : std::uint32_t { kNearDirection = 1, kNearResidual = 2, kNearSolution = 4 };

/// Returns the rows whose q is in shared memory. own: rows of the patch.
TM_HOST_DEVICE constexpr std::uint32_t streamed_tile_rows(std::uint32_t own, std::uint32_t tile_rows) {
  return minimum(own, matrix::kTilesAtOnce * tile_rows);
}
/// Returns `bytes` rounded up, so that the next vector starts at a cell.
TM_HOST_DEVICE constexpr std::size_t round_to_cells(std::size_t bytes) { return (bytes + 15) / 16 * 16; }

/// Places vectors in shared memory, or leaves them where they are otherwise. Cell: four floats.
template <class Cell>
class StreamedMemory {
 public:
  TM_HOST_DEVICE StreamedMemory(Cell* shared, std::uint32_t tile_rows_at_once, std::uint32_t near_vectors)
      : shared_(shared), tile_rows_(tile_rows_at_once), next_(&shared[tile_rows_at_once].x), near_(near_vectors) {}

  /// Returns p of `locals` rows. Call it first, and only if p is in shared memory.
  TM_HOST_DEVICE Cell* place_direction(std::uint32_t locals) {
    next_ += kStreamedBytesPerCell / sizeof(float) * locals;
    return shared_ + tile_rows_;
  }
  /// Returns r or x of `rows` rows.
  TM_HOST_DEVICE float* place(StreamedVectors which, std::uint32_t rows, float* otherwise) {
    if ((near_ & which) == 0) return otherwise;
    float* const begin = next_;
    next_ += round_to_cells(kStreamedBytesPerVector * rows) / sizeof(float);
    return begin;
  }

 private:
  Cell* const shared_;
  const std::uint32_t tile_rows_;
  float* next_;
  const std::uint32_t near_;
};

}  // namespace tensormass::backend::cuda
