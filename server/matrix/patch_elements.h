#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/layout.h"

/// Storage::kEdges: which elements each patch computes, and where their blocks go.
///
/// Why: a patch writes to its own rows only, so no locks are needed. A patch therefore computes every element that
/// touches its rows. An element on the border of two patches is computed by both.
///
///   place   0 ........ 40 | 41 .. 63 | 64 ........ 99 | 100 .. 127
///           patch 0         padding    patch 1          padding       ranges = {0, 41, 64, 100}
namespace tensormass::matrix {

struct PatchElements {
  std::vector<std::uint32_t> order;   ///< [place] index of the element; mesh::kNone: padding
  std::vector<std::uint32_t> ranges;  ///< [patch_count, 2] first and last place; each first is a multiple of kSliceRows
};

/// Lists the elements of each patch by their lowest row, so that neighbours in space are neighbours in memory.
/// rows: [element][node_count]
PatchElements order_by_patch(const Layout& layout, std::span<const std::uint32_t> rows, std::size_t node_count);

/// Returns ElementView::pair_places: the slot in which the patch of each place stores the block of each pair of nodes.
/// rows: [node_count][stride], one for each place
std::vector<std::uint32_t> pair_places(const Layout& layout, const PatchElements& elements,
                                       std::span<const std::uint32_t> rows, std::size_t node_count);

}  // namespace tensormass::matrix
