#pragma once

#include <cstdint>

#include "view/patches.h"

/// resident_solve.cuh keeps the data of a patch here.
///
///   blocks of a row:   0 .. Held - 1 │ Held .. Held + shared_width - 1 │ the rest
///                      registers     │ shared memory                   │ device memory
///
///   further columns    those of a slice beyond Held; slices take shared memory for them in order, until it is full
///   column_capacity    columns that shared memory has room for
namespace tensormass::backend::cuda {

using view::kSliceRows;

/// Largest number of rows of a patch in resident_solve.
inline constexpr std::uint32_t kMostResidentRows = 512;

/// Shared memory of resident_solve [bytes].
inline constexpr std::size_t kResidentBytesPerRow = 16 + 6 * 4;  // own and halo: direction, L⁻¹
inline constexpr std::size_t kResidentBytesPerHaloRow = 2 * 16;  // residual, product
inline constexpr std::size_t kResidentBytesPerColumn = kSliceRows * (9 * 4 + 2);

/// Returns the bytes of the vectors of a patch, without further columns. The last 16 are for the alignment of blocks.
constexpr std::size_t resident_vector_bytes(std::uint32_t locals, std::uint32_t halo) {
  return locals * kResidentBytesPerRow + halo * kResidentBytesPerHaloRow + 16;
}

/// Reals of a column in shared memory: two Cells and a float for each row.
inline constexpr std::uint32_t kSharedColumnReals = 9 * kSliceRows;
/// Returns the place of component c of a lane's block within a column in shared memory: the Cells of all rows with
/// components 0 to 3, then those with 4 to 7, then components 8.
TM_HOST_DEVICE constexpr std::uint32_t shared_component(std::uint32_t c, std::uint32_t lane) {
  return c / 4 * (4 * kSliceRows) + (c < 8 ? 4 * lane + c % 4 : lane);
}

/// Returns the number of further columns of a slice. width: columns of the slice. held: columns in registers. The
/// kernel writes this out: nvcc makes other code of it if it calls this function.
TM_HOST_DEVICE constexpr std::uint32_t further_columns(std::uint32_t width, std::uint32_t held) {
  return width > held ? width - held : 0;
}
/// Returns where the further columns of a slice start in shared memory. before: further columns of earlier slices.
TM_HOST_DEVICE constexpr std::uint32_t shared_begin_of(std::uint32_t before, std::uint32_t column_capacity) {
  return minimum(before, column_capacity);
}
/// Returns how many of the further columns of a slice shared memory holds.
TM_HOST_DEVICE constexpr std::uint32_t shared_width_of(std::uint32_t further, std::uint32_t shared_begin,
                                                       std::uint32_t column_capacity) {
  return minimum(further, column_capacity - shared_begin);
}

/// Columns of the blocks in registers: two in a word, as offsets into `direction` [bytes].
inline constexpr std::uint32_t kCellBytes = 16, kMostOffset = 0xFFFF;
/// Returns `word` with the offset of block j, an even one first.
TM_HOST_DEVICE constexpr std::uint32_t with_offset(std::uint32_t word, int j, std::uint32_t column) {
  return (j % 2 == 0 ? 0 : word) | (column * kCellBytes) << (16 * (j % 2));
}
TM_HOST_DEVICE constexpr std::uint32_t offset_of(std::uint32_t word, int j) {
  return word >> (16 * (j % 2)) & kMostOffset;
}

}  // namespace tensormass::backend::cuda
