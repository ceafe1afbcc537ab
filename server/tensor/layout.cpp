#include "tensor/layout.h"

#include <algorithm>
#include <cassert>
#include <numeric>

#include "mesh/partition.h"
#include "physics/element/element.h"

namespace tensormass::tensor {

namespace {

/// Rows within a window are sorted by degree, so that the rows of a slice are about equally long; a window is small
/// enough to keep neighbours close in memory.
constexpr std::uint32_t kSortWindowRows = 8 * kSliceRows;

std::uint32_t round_up(std::uint32_t value, std::uint32_t multiple) {
  return (value + multiple - 1) / multiple * multiple;
}

/// Numbers the nodes patch by patch.
void number_rows(Layout& layout, const mesh::Partition& partition, const mesh::Rows& neighbours) {
  layout.row_of_node.assign(partition.order.size(), 0);
  layout.patch_rows.assign(1, 0);
  std::vector<std::uint32_t> order = partition.order;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t begin = partition.offsets[patch], end = partition.offsets[patch + 1];
    for (std::uint32_t window = begin; window < end; window += kSortWindowRows) {
      std::stable_sort(order.begin() + window, order.begin() + std::min(window + kSortWindowRows, end),
                       [&](std::uint32_t a, std::uint32_t b) { return neighbours[a].size() > neighbours[b].size(); });
    }
    const std::uint32_t first_row = layout.patch_rows.back();
    const std::uint32_t rows = round_up(std::max(end - begin, 1u), kSliceRows);
    layout.node_of_row.resize(first_row + rows, mesh::kNone);
    for (std::uint32_t i = begin; i < end; ++i) {
      layout.row_of_node[order[i]] = first_row + i - begin;
      layout.node_of_row[first_row + i - begin] = order[i];
    }
    layout.patch_rows.push_back(first_row + rows);
  }
  layout.row_count = layout.patch_rows.back();
}

/// The neighbours of a row as rows, ascending.
std::vector<std::uint32_t> neighbours_of_row(const Layout& layout, const mesh::Rows& neighbours, std::uint32_t row) {
  std::vector<std::uint32_t> result;
  if (layout.node_of_row[row] == mesh::kNone) return result;
  for (const std::uint32_t node : neighbours[layout.node_of_row[row]]) result.push_back(layout.row_of_node[node]);
  std::sort(result.begin(), result.end());
  return result;
}

/// Slices and columns of one patch.
void add_patch_slots(Layout& layout, const mesh::Rows& neighbours, std::uint32_t patch) {
  const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
  std::vector<std::vector<std::uint32_t>> rows(end - begin);
  std::vector<std::uint32_t> halo;
  for (std::uint32_t row = begin; row < end; ++row) {
    rows[row - begin] = neighbours_of_row(layout, neighbours, row);
    for (const std::uint32_t other : rows[row - begin]) {
      if (other < begin || other >= end) halo.push_back(other);
    }
  }
  std::sort(halo.begin(), halo.end());
  halo.erase(std::unique(halo.begin(), halo.end()), halo.end());

  for (std::uint32_t slice = begin; slice < end; slice += kSliceRows) {
    std::size_t width = 0;
    for (std::uint32_t row = slice; row < slice + kSliceRows; ++row) width = std::max(width, rows[row - begin].size());
    for (std::size_t j = 0; j < width; ++j) {
      for (std::uint32_t row = slice; row < slice + kSliceRows; ++row) {
        const auto& own = rows[row - begin];
        if (j >= own.size()) {
          layout.columns.push_back(row - begin);
          layout.neighbour_rows.push_back(mesh::kNone);
          continue;
        }
        const std::uint32_t other = own[j];
        const bool is_own = other >= begin && other < end;
        const auto place = std::lower_bound(halo.begin(), halo.end(), other) - halo.begin();
        layout.columns.push_back(is_own ? other - begin : end - begin + static_cast<std::uint32_t>(place));
        layout.neighbour_rows.push_back(other);
      }
    }
    layout.slice_begin.push_back(layout.slice_begin.back() + static_cast<std::uint32_t>(width));
  }
  layout.halo.insert(layout.halo.end(), halo.begin(), halo.end());
  layout.patch_halo.push_back(static_cast<std::uint32_t>(layout.halo.size()));
}

/// Counts, then fills, so that each list comes in the order of the elements. fill(add) calls add(list, item).
template <class Fill>
void fill_lists(std::size_t list_count, std::vector<std::uint32_t>& begin, std::vector<std::uint32_t>& items,
                const Fill& fill) {
  begin.assign(list_count + 1, 0);
  fill([&](std::uint32_t list, std::uint32_t) { ++begin[list + 1]; });
  std::partial_sum(begin.begin(), begin.end(), begin.begin());
  items.resize(begin.back());
  std::vector<std::uint32_t> next(begin.begin(), begin.end() - 1);
  fill([&](std::uint32_t list, std::uint32_t item) { items[next[list]++] = item; });
}

}  // namespace

std::uint32_t Layout::patch_of_row(std::uint32_t row) const {
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

std::uint32_t Layout::slot(std::uint32_t row, std::uint32_t other) const {
  const std::uint32_t slice = row / kSliceRows;
  // Ascending neighbours, then padding, which as kNone is the largest: binary search holds.
  std::uint32_t low = slice_begin[slice], high = slice_begin[slice + 1];
  while (low < high) {
    const std::uint32_t middle = (low + high) / 2;
    if (neighbour_rows[middle * kSliceRows + row % kSliceRows] < other) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  assert(low < slice_begin[slice + 1] && neighbour_rows[low * kSliceRows + row % kSliceRows] == other);
  return low * kSliceRows + row % kSliceRows;
}

Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count) {
  Layout layout;
  layout.patch_count = patch_count;
  const mesh::Rows neighbours = mesh::node_neighbours(mesh);
  number_rows(layout, mesh::partition(mesh, patch_count, kSliceRows), neighbours);
  layout.patch_halo.assign(1, 0);
  layout.slice_begin.assign(1, 0);
  for (std::uint32_t patch = 0; patch < patch_count; ++patch) add_patch_slots(layout, neighbours, patch);
  return layout;
}

GatherMap make_gather_map(const Layout& layout, std::span<const ElementRows> groups) {
  GatherMap map;
  fill_lists(layout.row_count, map.force_begin, map.force, [&](const auto& add) {
    for (const ElementRows& group : groups) {
      for (std::uint32_t e = 0; e < group.element_count; ++e) {
        const std::uint32_t record = group.partial_begin + e * record_reals(group.node_count);
        for (std::uint32_t k = 0; k < group.node_count; ++k) {
          add(group.rows[std::size_t{k} * group.stride + e], record + force_offset(k));
        }
      }
    }
  });
  fill_lists(2 * std::size_t{layout.slot_count()}, map.edge_begin, map.edge, [&](const auto& add) {
    for (const ElementRows& group : groups) {
      for (std::uint32_t e = 0; e < group.element_count; ++e) {
        const std::uint32_t record = group.partial_begin + e * record_reals(group.node_count);
        std::uint32_t pair = 0;  // in the order of physics::pair_index
        for (std::uint32_t k = 0; k < group.node_count; ++k) {
          for (std::uint32_t l = k + 1; l < group.node_count; ++l, ++pair) {
            const std::uint32_t row_k = group.rows[std::size_t{k} * group.stride + e];
            const std::uint32_t row_l = group.rows[std::size_t{l} * group.stride + e];
            const std::uint32_t block = record + edge_offset(group.node_count, pair);
            add(2 * layout.slot(row_k, row_l), block);
            add(2 * layout.slot(row_l, row_k) + 1, block);
          }
        }
      }
    }
  });
  return map;
}

}  // namespace tensormass::tensor
