#pragma once

#include <cstdint>

#include "view/patches.h"

/// resident_solve.cuh keeps the data of a patch here.
///
///   blocks of a row:   0 .. Held - 1 │ Held .. Held + shared_width - 1 │ the rest
///                      registers     │ shared memory                   │ device memory
///
///   further columns    those of a slice beyond Held
///   column_capacity    columns that shared memory has room for
///   left               columns that each slice leaves in device memory, as far as it has so many further columns
///
/// Each slice leaves the same number in device memory. The slowest slice ends the iteration, so it counts how many one
/// slice has to read and not how many there are in all.
namespace tensormass::backend::cuda {

using view::kSliceRows;

/// Largest number of rows of a patch in resident_solve.
inline constexpr std::uint32_t kMaxResidentRows = 512;

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
/// Returns how many of the further columns of a slice shared memory holds.
TM_HOST_DEVICE constexpr std::uint32_t shared_width_of(std::uint32_t further, std::uint32_t left) {
  return further - minimum(further, left);
}
/// Returns the smallest `left` with which the columns in shared memory are at most column_capacity.
///
///   sum_shared(left) -> std::uint32_t   returns the sum of shared_width_of over the slices of the patch
template <class SumShared>
TM_HOST_DEVICE std::uint32_t least_left(std::uint32_t column_capacity, const SumShared& sum_shared) {
  std::uint32_t least = 0, enough = 0xFFFF;  // a slice has fewer columns
  while (least < enough) {
    const std::uint32_t middle = (least + enough) / 2;
    if (sum_shared(middle) <= column_capacity) {
      enough = middle;
    } else {
      least = middle + 1;
    }
  }
  return least;
}

/// Columns of the blocks in registers: two in a word, as offsets into `direction` [bytes].
inline constexpr std::uint32_t kCellBytes = 16, kMaxOffset = 0xFFFF;
/// Returns `word` with the offset of block j, an even one first.
TM_HOST_DEVICE constexpr std::uint32_t with_offset(std::uint32_t word, int j, std::uint32_t column) {
  return (j % 2 == 0 ? 0 : word) | (column * kCellBytes) << (16 * (j % 2));
}
TM_HOST_DEVICE constexpr std::uint32_t offset_of(std::uint32_t word, int j) {
  return word >> (16 * (j % 2)) & kMaxOffset;
}

}  // namespace tensormass::backend::cuda
