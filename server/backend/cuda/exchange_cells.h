#pragma once

#include <cstdint>

#include "core/scalar.h"
#include "view/solve.h"

/// Places of the cells through which patches exchange data (exchange.cuh).
///
///   rows    [2][row_count]                   a cell for each row
///   sums    [2][patch_count][kSumCells]      the first cell of each patch is used
///            └ parity of the tag
///
/// A cell has four floats. `Cell` is a parameter, so that tests can place cells without a device.
namespace tensormass::backend::cuda {

/// Distance between the sums of two patches [cells].
inline constexpr std::uint32_t kSumCells = view::kPatchSums / 4;

/// Returns the cell of a row in exchange `tag`.
template <class Cell>
TM_HOST_DEVICE Cell* row_cell(Cell* rows, std::uint32_t row_count, std::uint32_t tag, std::uint32_t row) {
  return rows + std::size_t{tag & 1} * row_count + row;
}
/// Returns the cell of a patch's sums in exchange `tag`.
template <class Cell>
TM_HOST_DEVICE Cell* sum_cell(Cell* sums, std::uint32_t patch_count, std::uint32_t tag, std::uint32_t patch) {
  return sums + (std::size_t{tag & 1} * patch_count + patch) * kSumCells;
}

/// Finds the cells that a thread waits for at once: those of the items first, first + stride, .. below `count`, at most
/// Count. Beyond the end it repeats the first, so that all Count reads are valid.
///
///   cell_of(i) -> const Cell*   called only if first + i · stride is below `count`
template <class Cell, int Count, class CellOf>
TM_HOST_DEVICE void cells_to_wait_for(std::uint32_t first, std::uint32_t stride, std::uint32_t count,
                                      const CellOf& cell_of, const Cell* (&cells)[Count]) {
  TM_UNROLL_ALL
  for (int i = 0; i < Count; ++i) cells[i] = first + i * stride < count ? cell_of(i) : cell_of(0);
}

}  // namespace tensormass::backend::cuda
