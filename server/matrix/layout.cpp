#include "matrix/layout.h"

#include <algorithm>

#include "core/assert.h"
#include "core/offsets.h"
#include "core/parallel.h"
#include "matrix/banks.h"

namespace tensormass::matrix {

std::uint32_t Layout::largest_patch() const {
  std::uint32_t largest = 0;
  for (std::uint32_t patch = 0; patch < patch_count; ++patch) {
    largest = std::max(largest, patch_rows[patch + 1] - patch_rows[patch] + patch_halo[patch + 1] - patch_halo[patch]);
  }
  return largest;
}

std::uint32_t Layout::patch_of_row(std::uint32_t row) const {
  TM_ASSERT(row < row_count, "the row belongs to a patch");
  return static_cast<std::uint32_t>(std::upper_bound(patch_rows.begin(), patch_rows.end(), row) - patch_rows.begin()) -
         1;
}

std::vector<std::uint32_t> Layout::patch_of_slice() const {
  std::vector<std::uint32_t> patches;
  for (std::uint32_t patch = 0; patch < patch_count; ++patch) {
    patches.resize(patch_rows[patch + 1] / kSliceRows, patch);
  }
  return patches;
}

std::uint32_t Layout::read_slot_count() const {
  if (storage != Storage::kTiles) return slot_count();
  std::uint32_t read = 0;
  for (std::size_t slice = 0; slice < slice_read.size(); ++slice) read += slice_read[slice] - slice_begin[slice];
  return read * kSliceRows;
}

std::uint32_t Layout::widest_slice() const {
  std::uint32_t widest = 0;
  for (std::size_t i = 1; i < slice_begin.size(); ++i) widest = std::max(widest, slice_begin[i] - slice_begin[i - 1]);
  return widest;
}

bool Layout::in_one_patch(std::uint32_t row, std::uint32_t other) const {
  const std::uint32_t patch = patch_of_row(row);
  return other >= patch_rows[patch] && other < patch_rows[patch + 1];
}

std::uint32_t Layout::slot(std::uint32_t row, std::uint32_t other) const {
  const std::uint32_t height = slice_rows(), slice = row / height;
  std::uint32_t low = slice_begin[slice], high = slice_begin[slice + 1];
  const std::uint32_t lane = row % height;
  if (storage != Storage::kEdges && high - low <= kMaxSpreadColumns) {  // ordered by bank or tile, not ascending
    while (low < high && neighbour_rows[low * height + lane] != other) ++low;
    TM_ASSERT(low < high, "the matrix couples the two nodes of every edge of an element");
    return low * height + lane;
  }
  if (storage == Storage::kEdges) (in_one_patch(row, other) ? high : low) = slice_halo[slice];
  // Neighbours ascend, and padding follows. Padding is kNone, the largest number, so a binary search works.
  const std::uint32_t end = high;
  while (low < high) {
    const std::uint32_t middle = (low + high) / 2;
    if (neighbour_rows[middle * height + lane] < other) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  const bool found = low < end && neighbour_rows[low * height + lane] == other;
  TM_ASSERT(found || storage == Storage::kEdges, "the matrix couples the two nodes of every edge of an element");
  return found ? low * height + lane : kNoPlace;
}

namespace {

/// Asserts that each slice is cut in two: [slice_begin[i], cuts[i]) and the rest.
void check_cuts(const Layout& layout, const std::vector<std::uint32_t>& cuts) {
  TM_ASSERT(cuts.size() + 1 == layout.slice_begin.size(), "each slice has one cut");
  for (std::size_t slice = 0; slice < cuts.size(); ++slice) {
    TM_ASSERT(layout.slice_begin[slice] <= cuts[slice] && cuts[slice] <= layout.slice_begin[slice + 1],
              "the cut of a slice lies within its columns");
  }
}

void check_rows(const Layout& layout) {
  assert_offsets(layout.patch_rows, layout.patch_count, layout.row_count);
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    TM_ASSERT(layout.patch_rows[patch] % kSliceRows == 0, "patches start at slices");
    TM_ASSERT(layout.patch_rows[patch] < layout.patch_rows[patch + 1], "each patch has a slice");
  }
  TM_ASSERT(layout.row_count % kSliceRows == 0, "the last patch ends at a slice");
  TM_ASSERT(layout.node_of_row.size() == layout.row_count, "each row has a node or is a gap");
  TM_ASSERT(layout.row_of_node.size() <= layout.row_count, "each node has a row of its own");
  for (std::uint32_t node = 0; node < layout.row_of_node.size(); ++node) {
    TM_ASSERT(layout.row_of_node[node] < layout.row_count, "nodes have rows of the layout");
    TM_ASSERT(layout.node_of_row[layout.row_of_node[node]] == node, "node_of_row is the inverse of row_of_node");
  }
  std::size_t gaps = 0;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const auto begin = layout.node_of_row.begin() + layout.patch_rows[patch];
    const auto end = layout.node_of_row.begin() + layout.patch_rows[patch + 1];
    const auto gap = std::find(begin, end, mesh::kNone);
    TM_ASSERT(std::count(gap, end, mesh::kNone) == end - gap, "gap rows are the last ones of their patch");
    gaps += static_cast<std::size_t>(end - gap);
  }
  TM_ASSERT(gaps + layout.row_of_node.size() == layout.row_count, "each node has one row");
  assert_offsets(layout.patch_halo, layout.patch_count, layout.halo.size());
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    for (std::uint32_t i = layout.patch_halo[patch]; i < layout.patch_halo[patch + 1]; ++i) {
      TM_ASSERT(layout.halo[i] < layout.row_count, "halos name rows");
      TM_ASSERT(layout.halo[i] < layout.patch_rows[patch] || layout.halo[i] >= layout.patch_rows[patch + 1],
                "the halo of a patch has no row of the patch itself");
      TM_ASSERT(
          layout.storage == Storage::kRows || i == layout.patch_halo[patch] || layout.halo[i - 1] < layout.halo[i],
          "halos ascend within a patch");
    }
  }
}

/// Asserts that the neighbours of each row ascend in the columns [begin, end), and that padding follows them.
/// Layout::slot searches them.
void check_order(const Layout& layout, std::uint32_t begin, std::uint32_t end) {
  const std::uint32_t height = layout.slice_rows();
  for (std::uint32_t slot = (begin + 1) * height; slot < end * height; ++slot) {
    const std::uint32_t before = layout.neighbour_rows[slot - height], row = layout.neighbour_rows[slot];
    TM_ASSERT(before < row || row == mesh::kNone, "neighbours ascend, and padding follows");
  }
}

/// kTiles: asserts that a column's bits mark neighbours within the tile of `slice`, and only in columns that are read.
/// own: rows of the patch. slice: within the patch.
void check_bits(const Layout& layout, std::uint32_t column, bool is_read, std::uint32_t slice, std::uint32_t own) {
  TM_ASSERT(is_read || layout.used_twice[column] == 0, "only blocks that are read serve another row");
  const std::uint32_t first = slice * kSliceRows / layout.tile_rows * layout.tile_rows;
  const std::uint32_t last = std::min(first + layout.tile_rows, own);
  for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
    if ((layout.used_twice[column] >> lane & 1) == 0) continue;
    const std::uint32_t slot = column * kSliceRows + lane;
    TM_ASSERT(
        layout.neighbour_rows[slot] != mesh::kNone && layout.columns[slot] >= first && layout.columns[slot] < last,
        "a block serves only a row of its own tile");
  }
}

/// Asserts that the slots of a patch name the rows that neighbour_rows says, or their own row if they are padding.
void check_slots(const Layout& layout, std::uint32_t patch) {
  const std::uint32_t height = layout.slice_rows(), first = layout.patch_rows[patch];
  const std::uint32_t own = layout.patch_rows[patch + 1] - first, halo = layout.patch_halo[patch];
  const std::uint32_t local_count = own + layout.patch_halo[patch + 1] - halo;
  for (std::uint32_t slice = first / height; slice < layout.patch_rows[patch + 1] / height; ++slice) {
    const std::uint32_t end = layout.slice_begin[slice + 1] * height;
    for (std::uint32_t slot = layout.slice_begin[slice] * height; slot < end; ++slot) {
      const std::uint32_t local = layout.columns[slot], row = layout.neighbour_rows[slot];
      TM_ASSERT(local < local_count, "columns are local numbers of the patch");
      const bool in_halo_section = layout.storage == Storage::kEdges && slot / height >= layout.slice_halo[slice];
      if (row == mesh::kNone) {
        TM_ASSERT(local == slice * height + slot % height - first, "padding names its own row");
      } else {
        TM_ASSERT(row == (local < own ? first + local : layout.halo[halo + local - own]),
                  "columns name the neighbours");
        TM_ASSERT(layout.storage != Storage::kEdges || in_halo_section == (local >= own),
                  "edges within the patch come before those to the halo");
      }
    }
    const std::uint32_t begin_column = layout.slice_begin[slice], end_column = layout.slice_begin[slice + 1];
    if (layout.storage == Storage::kEdges) {
      check_order(layout, begin_column, layout.slice_halo[slice]);
      check_order(layout, layout.slice_halo[slice], end_column);
    } else if (end_column - begin_column > kMaxSpreadColumns) {
      check_order(layout, begin_column, end_column);
    }
    for (std::uint32_t j = begin_column; layout.storage == Storage::kTiles && j < end_column; ++j) {
      check_bits(layout, j, j < layout.slice_read[slice], slice - first / height, own);
    }
  }
}

}  // namespace

void check_layout(const Layout& layout) {
  const bool edges = layout.storage == Storage::kEdges, tiles = layout.storage == Storage::kTiles;
  TM_ASSERT(layout.patch_count > 0, "a layout has patches");
  check_rows(layout);
  const std::size_t slices = layout.row_count / layout.slice_rows();
  TM_ASSERT(layout.columns.size() % layout.slice_rows() == 0, "a column has a slot for each row of a slice");
  assert_offsets(layout.slice_begin, slices, layout.columns.size() / layout.slice_rows());
  TM_ASSERT(layout.neighbour_rows.size() == layout.columns.size(), "each slot has a neighbour or is padding");
  if (edges) {
    check_cuts(layout, layout.slice_halo);
    assert_offsets(layout.patch_boundary, layout.patch_count, layout.boundary.size());
    for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
      const std::uint32_t own = layout.patch_rows[patch + 1] - layout.patch_rows[patch];
      for (std::uint32_t i = layout.patch_boundary[patch]; i < layout.patch_boundary[patch + 1]; ++i) {
        TM_ASSERT(layout.boundary[i] < own, "boundaries name own rows");
        TM_ASSERT(i == layout.patch_boundary[patch] || layout.boundary[i - 1] < layout.boundary[i],
                  "boundaries ascend within a patch");
      }
    }
  } else {
    TM_ASSERT(layout.slice_halo.empty() && layout.patch_boundary.empty() && layout.boundary.empty(),
              "only edges have boundaries");
  }
  if (tiles) {
    TM_ASSERT(layout.tile_rows > 0 && layout.tile_rows % kSliceRows == 0, "tiles consist of slices");
    TM_ASSERT(layout.tile_rows <= kMaxTileRows, "a warp has room for the sums of a tile");
    check_cuts(layout, layout.slice_read);
    TM_ASSERT(layout.used_twice.size() == layout.columns.size() / kSliceRows, "each column has a word of bits");
  } else {
    TM_ASSERT(layout.slice_read.empty() && layout.used_twice.empty(), "only tiles share blocks of two rows");
  }
  parallel_for(layout.patch_count, [&](std::size_t patch) { check_slots(layout, static_cast<std::uint32_t>(patch)); });
}

}  // namespace tensormass::matrix
