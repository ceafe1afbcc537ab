#include "matrix/layout.h"

#include <algorithm>
#include <array>
#include <cassert>
#include <iterator>
#include <numeric>

#include "core/parallel.h"
#include "matrix/banks.h"
#include "mesh/partition.h"
#include "physics/element/element.h"

namespace tensormass::matrix {

namespace {

/// Rows within a window are sorted by degree, so that the rows of a slice are about equally long; a window is small
/// enough to keep neighbours close in memory.
constexpr std::uint32_t kSortWindowRows = 8 * kSliceRows;

std::uint32_t round_up(std::uint32_t value, std::uint32_t multiple) {
  return (value + multiple - 1) / multiple * multiple;
}

/// Which neighbours a node stores its edges with. Those within its patch come first.
struct StoredEdges {
  std::vector<std::uint32_t> inner, all;  // [node] how many within the patch, and together
  std::vector<std::uint32_t> items;       // as in mesh::Rows of all neighbours, whose offsets hold here, too

  std::span<const std::uint32_t> of(const mesh::Rows& neighbours, std::uint32_t node) const {
    return {items.data() + neighbours.offsets[node], all[node]};
  }
};

/// Kind kEdges: shares the edges within a patch out so that each node stores half of its own, as near as can be. All
/// nodes of a patch then have about equally many, which keeps slices free of padding.
StoredEdges share_edges(const mesh::Partition& partition, const mesh::Rows& neighbours) {
  const std::size_t node_count = partition.order.size();
  std::vector<std::uint32_t> place(node_count), patch(node_count);
  for (std::uint32_t p = 0; p + 1 < partition.offsets.size(); ++p) {
    for (std::uint32_t i = partition.offsets[p]; i < partition.offsets[p + 1]; ++i) {
      place[partition.order[i]] = i;
      patch[partition.order[i]] = p;
    }
  }
  StoredEdges stored{
      std::vector<std::uint32_t>(node_count, 0), {}, std::vector<std::uint32_t>(neighbours.items.size())};
  const auto store = [&](std::uint32_t node, std::uint32_t other) {
    stored.items[neighbours.offsets[node] + stored.inner[node]++] = other;
  };
  std::vector<std::uint32_t> degree(node_count, 0);  // within the patch
  for (std::uint32_t node = 0; node < node_count; ++node) {
    for (const std::uint32_t other : neighbours[node]) degree[node] += patch[other] == patch[node] ? 1 : 0;
  }
  std::vector<std::uint32_t> later;
  for (const std::uint32_t node : partition.order) {
    later.clear();
    for (const std::uint32_t other : neighbours[node]) {
      if (patch[other] == patch[node] && place[other] > place[node]) later.push_back(other);
    }
    const std::uint32_t goal = (degree[node] + 1) / 2;
    for (std::size_t i = 0; i < later.size(); ++i) {
      const std::uint32_t other = later[i];
      const bool wants = stored.inner[node] < goal, must = stored.inner[node] + (later.size() - i) <= goal;
      const bool other_is_full = stored.inner[other] >= (degree[other] + 1) / 2;
      if (must || (wants && other_is_full)) {
        store(node, other);
      } else {
        store(other, node);
      }
    }
  }
  stored.all = stored.inner;
  for (std::uint32_t node = 0; node < node_count; ++node) {
    for (const std::uint32_t other : neighbours[node]) {
      if (patch[other] != patch[node]) stored.items[neighbours.offsets[node] + stored.all[node]++] = other;
    }
  }
  return stored;
}

/// Kinds kRows and kTiles: each node all of its edges, in one section.
StoredEdges whole_rows(const mesh::Rows& neighbours) {
  StoredEdges stored;
  stored.items = neighbours.items;
  for (std::uint32_t node = 0; node < neighbours.size(); ++node) {
    stored.all.push_back(static_cast<std::uint32_t>(neighbours[node].size()));
  }
  stored.inner = stored.all;
  return stored;
}

/// [node] neighbours outside of the node's tile.
std::vector<std::uint32_t> neighbours_beyond_tile(const mesh::Partition& partition, const mesh::Rows& neighbours,
                                                  std::uint32_t tile_rows) {
  std::vector<std::uint32_t> tile(partition.order.size()), beyond(partition.order.size(), 0);
  for (std::uint32_t patch = 0, tiles = 0; patch + 1 < partition.offsets.size(); ++patch) {
    const std::uint32_t begin = partition.offsets[patch], end = partition.offsets[patch + 1];
    for (std::uint32_t i = begin; i < end; ++i) tile[partition.order[i]] = tiles + (i - begin) / tile_rows;
    tiles += (end - begin) / tile_rows + 1;
  }
  for (std::uint32_t node = 0; node < beyond.size(); ++node) {
    for (const std::uint32_t other : neighbours[node]) beyond[node] += tile[other] != tile[node] ? 1 : 0;
  }
  return beyond;
}

/// Numbers the nodes patch by patch. beyond_tile: of kTiles, by which rows of a length are sorted, so that those which
/// share least with others come into the same slices.
void number_rows(Layout& layout, const mesh::Partition& partition, const StoredEdges& stored,
                 const std::vector<std::uint32_t>& beyond_tile) {
  layout.row_of_node.assign(partition.order.size(), 0);
  layout.patch_rows.assign(1, 0);
  std::vector<std::uint32_t> order = partition.order;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t begin = partition.offsets[patch], end = partition.offsets[patch + 1];
    const std::uint32_t window_rows = beyond_tile.empty() ? kSortWindowRows : layout.tile_rows;
    for (std::uint32_t window = begin; window < end; window += window_rows) {
      std::stable_sort(order.begin() + window, order.begin() + std::min(window + window_rows, end),
                       [&](std::uint32_t a, std::uint32_t b) {
                         if (!beyond_tile.empty() && stored.all[a] == stored.all[b]) {
                           return beyond_tile[a] > beyond_tile[b];
                         }
                         const std::uint32_t outer_a = stored.all[a] - stored.inner[a];
                         const std::uint32_t outer_b = stored.all[b] - stored.inner[b];
                         return outer_a != outer_b ? outer_a > outer_b : stored.inner[a] > stored.inner[b];
                       });
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

/// What a patch adds to the layout.
struct PatchSlots {
  std::vector<std::uint32_t> columns, neighbour_rows, halo;
  std::vector<std::uint32_t> inner_widths, widths;  // of slices
  std::vector<std::uint32_t> read_widths;           // of kTiles: [slice]
  std::vector<std::uint32_t> used_twice;            // of kTiles: [column]
};

/// Of kTiles: orders the neighbours in all rows.
void order_tiles(const Layout& layout, PatchSlots& patch) {
  const std::size_t slices = patch.widths.size(), tile_slices = layout.tile_rows / kSliceRows;
  patch.read_widths = patch.widths;
  patch.used_twice.assign(patch.columns.size() / kSliceRows, 0);
  std::size_t column = 0;
  for (std::size_t first = 0; first < slices; first += tile_slices) {
    const auto widths =
        std::span<const std::uint32_t>(patch.widths).subspan(first, std::min(tile_slices, slices - first));
    const std::size_t columns = std::accumulate(widths.begin(), widths.end(), std::size_t{0});
    if (*std::max_element(widths.begin(), widths.end()) <= kMostSpreadColumns) {
      const auto slots = [&](std::vector<std::uint32_t>& items) {
        return std::span(items).subspan(column * kSliceRows, columns * kSliceRows);
      };
      order_tile(
          {static_cast<std::uint32_t>(first) * kSliceRows, widths, slots(patch.columns), slots(patch.neighbour_rows)},
          std::span(patch.read_widths).subspan(first, widths.size()),
          std::span(patch.used_twice).subspan(column, columns));
    }
    column += columns;
  }
}

/// The nodes of other patches that a patch's rows name, ascending by row.
std::vector<std::uint32_t> halo_of(const Layout& layout, const mesh::Rows& neighbours, const StoredEdges& stored,
                                   std::uint32_t patch) {
  const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
  const auto row_of = [&](std::uint32_t node) { return layout.row_of_node[node]; };
  std::vector<std::uint32_t> halo;
  for (std::uint32_t row = begin; row < end; ++row) {
    if (layout.node_of_row[row] == mesh::kNone) continue;
    for (const std::uint32_t other : stored.of(neighbours, layout.node_of_row[row])) {
      if (row_of(other) < begin || row_of(other) >= end) halo.push_back(other);
    }
  }
  std::sort(halo.begin(), halo.end(), [&](std::uint32_t a, std::uint32_t b) { return row_of(a) < row_of(b); });
  halo.erase(std::unique(halo.begin(), halo.end()), halo.end());
  return halo;
}

/// Of kRows: exchanges a patch's rows, and the nodes of its halo. Leaves row_of_node as it is.
void arrange_by_bank(Layout& layout, const mesh::Rows& neighbours, std::uint32_t patch,
                     std::vector<std::uint32_t>& halo) {
  const std::uint32_t begin = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - begin;
  const std::span<std::uint32_t> own_nodes(layout.node_of_row.data() + begin, own);
  const auto row_of = [&](std::uint32_t node) { return layout.row_of_node[node]; };
  const auto column_of = [&](std::uint32_t node) {
    if (row_of(node) >= begin && row_of(node) < begin + own) return row_of(node) - begin;
    const auto place = std::lower_bound(halo.begin(), halo.end(), node,
                                        [&](std::uint32_t a, std::uint32_t b) { return row_of(a) < row_of(b); });
    return own + static_cast<std::uint32_t>(place - halo.begin());
  };
  mesh::Rows rows;
  for (const std::uint32_t node : own_nodes) {
    for (const std::uint32_t other : node != mesh::kNone ? neighbours[node] : std::span<const std::uint32_t>{}) {
      rows.items.push_back(column_of(other));
    }
    rows.offsets.push_back(static_cast<std::uint32_t>(rows.items.size()));
  }
  const std::vector<std::uint32_t> places = places_by_bank(rows, own + static_cast<std::uint32_t>(halo.size()));
  std::vector<std::uint32_t> nodes(own_nodes.begin(), own_nodes.end());
  nodes.insert(nodes.end(), halo.begin(), halo.end());
  for (std::uint32_t i = 0; i < nodes.size(); ++i) {
    (places[i] < own ? own_nodes[places[i]] : halo[places[i] - own]) = nodes[i];
  }
}

PatchSlots patch_slots(const Layout& layout, const mesh::Rows& neighbours, const StoredEdges& stored,
                       std::uint32_t patch, std::span<const std::uint32_t> halo) {
  const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1], count = end - begin;
  // Neighbours as rows, each section ascending.
  std::vector<std::uint32_t> offsets{0}, middles, rows;
  PatchSlots out;
  for (std::uint32_t row = begin; row < end; ++row) {
    const std::uint32_t node = layout.node_of_row[row];
    const std::size_t first = rows.size();
    std::size_t inner = 0;
    if (node != mesh::kNone) {
      for (const std::uint32_t other : stored.of(neighbours, node)) rows.push_back(layout.row_of_node[other]);
      inner = stored.inner[node];
    }
    const auto middle = rows.begin() + static_cast<std::ptrdiff_t>(first + inner);
    std::sort(rows.begin() + static_cast<std::ptrdiff_t>(first), middle);
    std::sort(middle, rows.end());
    middles.push_back(static_cast<std::uint32_t>(first + inner));
    offsets.push_back(static_cast<std::uint32_t>(rows.size()));
  }
  std::vector<std::pair<std::uint32_t, std::uint32_t>> outer;  // rows of the halo, ascending, and their columns
  for (const std::uint32_t node : halo) {
    out.halo.push_back(layout.row_of_node[node]);
    outer.emplace_back(out.halo.back(), count + static_cast<std::uint32_t>(outer.size()));
  }
  std::sort(outer.begin(), outer.end());
  const auto column_of = [&](std::uint32_t row) {
    if (row >= begin && row < end) return row - begin;
    return std::lower_bound(outer.begin(), outer.end(), std::pair{row, 0u})->second;
  };

  const std::uint32_t height = layout.slice_rows();
  for (std::uint32_t slice = 0; slice < count; slice += height) {
    // Section by section: what lies in [from(i), to(i)) of `rows`.
    const auto add = [&](const auto& from, const auto& to) {
      std::uint32_t width = 0;
      for (std::uint32_t i = slice; i < slice + height; ++i) width = std::max(width, to(i) - from(i));
      for (std::uint32_t j = 0; j < width; ++j) {
        for (std::uint32_t i = slice; i < slice + height; ++i) {
          if (from(i) + j >= to(i)) {
            out.columns.push_back(i);
            out.neighbour_rows.push_back(mesh::kNone);
            continue;
          }
          const std::uint32_t other = rows[from(i) + j];
          out.columns.push_back(column_of(other));
          out.neighbour_rows.push_back(other);
        }
      }
      return width;
    };
    const auto first = [&](std::uint32_t i) { return offsets[i]; };
    const auto middle = [&](std::uint32_t i) { return middles[i]; };
    const auto last = [&](std::uint32_t i) { return offsets[i + 1]; };
    const std::size_t begin_of_slice = out.columns.size();
    out.inner_widths.push_back(add(first, middle));
    out.widths.push_back(out.inner_widths.back() + add(middle, last));
    if (layout.storage == Storage::kRows && out.widths.back() <= kMostSpreadColumns) {
      std::array<std::uint32_t, kSliceRows> ends{};
      for (std::uint32_t i = 0; i < kSliceRows; ++i) ends[i] = offsets[slice + i + 1] - offsets[slice + i];
      order_by_bank(std::span(out.columns).subspan(begin_of_slice),
                    std::span(out.neighbour_rows).subspan(begin_of_slice), ends);
    }
  }
  if (layout.storage == Storage::kTiles) order_tiles(layout, out);
  return out;
}

}  // namespace

std::uint32_t Layout::largest_patch() const {
  std::uint32_t largest = 0;
  for (std::uint32_t patch = 0; patch < patch_count; ++patch) {
    largest = std::max(largest, patch_rows[patch + 1] - patch_rows[patch] + patch_halo[patch + 1] - patch_halo[patch]);
  }
  return largest;
}

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
  if (storage != Storage::kEdges && high - low <= kMostSpreadColumns) {
    while (low < high && neighbour_rows[low * height + lane] != other) ++low;
    assert(low < high);
    return low < high ? low * height + lane : kNoPlace;
  }
  if (storage == Storage::kEdges) (in_one_patch(row, other) ? high : low) = slice_halo[slice];
  // Ascending neighbours, then padding, which as kNone is the largest: binary search holds.
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
  assert(found || storage == Storage::kEdges);
  return found ? low * height + lane : kNoPlace;
}

Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count, Storage storage) {
  Layout layout;
  layout.storage = storage;
  layout.patch_count = patch_count;
  const mesh::Rows neighbours = mesh::node_neighbours(mesh);
  if (storage == Storage::kTiles) {
    layout.tile_rows = rows_of_tiles(static_cast<std::uint32_t>(mesh.nodes.size()) / patch_count + 1);
  }
  const mesh::Partition partition = mesh::partition(mesh, patch_count, std::max(layout.tile_rows, kSliceRows));
  const StoredEdges stored = storage == Storage::kEdges ? share_edges(partition, neighbours) : whole_rows(neighbours);
  number_rows(layout, partition, stored,
              storage == Storage::kTiles ? neighbours_beyond_tile(partition, neighbours, layout.tile_rows)
                                         : std::vector<std::uint32_t>{});

  std::vector<std::vector<std::uint32_t>> halos(patch_count);
  parallel_for(patch_count, [&](std::size_t i) {
    const auto patch = static_cast<std::uint32_t>(i);
    halos[patch] = halo_of(layout, neighbours, stored, patch);
    if (storage == Storage::kRows) arrange_by_bank(layout, neighbours, patch, halos[patch]);
  });
  for (std::uint32_t row = 0; row < layout.row_count; ++row) {
    if (layout.node_of_row[row] != mesh::kNone) layout.row_of_node[layout.node_of_row[row]] = row;
  }
  std::vector<PatchSlots> patches(patch_count);
  parallel_for(patch_count, [&](std::size_t patch) {
    patches[patch] = patch_slots(layout, neighbours, stored, static_cast<std::uint32_t>(patch), halos[patch]);
    halos[patch] = {};
  });
  layout.patch_halo.assign(1, 0);
  layout.slice_begin.assign(1, 0);
  for (PatchSlots& patch : patches) {
    for (std::size_t slice = 0; slice < patch.widths.size(); ++slice) {
      const std::uint32_t begin = layout.slice_begin.back();
      if (storage == Storage::kEdges) layout.slice_halo.push_back(begin + patch.inner_widths[slice]);
      if (storage == Storage::kTiles) layout.slice_read.push_back(begin + patch.read_widths[slice]);
      layout.slice_begin.push_back(begin + patch.widths[slice]);
    }
    layout.columns.insert(layout.columns.end(), patch.columns.begin(), patch.columns.end());
    layout.neighbour_rows.insert(layout.neighbour_rows.end(), patch.neighbour_rows.begin(), patch.neighbour_rows.end());
    layout.used_twice.insert(layout.used_twice.end(), patch.used_twice.begin(), patch.used_twice.end());
    layout.halo.insert(layout.halo.end(), patch.halo.begin(), patch.halo.end());
    layout.patch_halo.push_back(static_cast<std::uint32_t>(layout.halo.size()));
    patch = {};
  }
  if (storage == Storage::kEdges) {
    std::vector<std::uint32_t> boundary = layout.halo;
    std::sort(boundary.begin(), boundary.end());
    boundary.erase(std::unique(boundary.begin(), boundary.end()), boundary.end());
    layout.patch_boundary.assign(patch_count + 1, 0);
    for (const std::uint32_t row : boundary) {
      const std::uint32_t patch = layout.patch_of_row(row);
      layout.boundary.push_back(row - layout.patch_rows[patch]);
      ++layout.patch_boundary[patch + 1];
    }
    std::partial_sum(layout.patch_boundary.begin(), layout.patch_boundary.end(), layout.patch_boundary.begin());
  }
  return layout;
}

PatchElements order_by_patch(const Layout& layout, std::span<const std::uint32_t> rows, std::size_t node_count) {
  const std::size_t element_count = rows.size() / node_count;
  PatchElements out;
  std::vector<std::vector<std::uint32_t>> of_patch(layout.patch_count);
  const std::vector<std::uint32_t> patch_of_slice = layout.patch_of_slice();
  for (std::size_t e = 0; e < element_count; ++e) {
    const auto nodes = rows.subspan(e * node_count, node_count);
    for (std::size_t k = 0; k < node_count; ++k) {
      auto& list = of_patch[patch_of_slice[nodes[k] / kSliceRows]];
      if (list.empty() || list.back() != e) list.push_back(static_cast<std::uint32_t>(e));
    }
  }
  parallel_for(layout.patch_count, [&](std::size_t patch) {
    const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
    // By the lowest row within the patch: neighbours in space are neighbours in memory. A counting sort.
    std::vector<std::uint32_t>& list = of_patch[patch];
    std::vector<std::uint32_t> key(list.size()), next(end - begin + 1, 0), sorted(list.size());
    for (std::size_t i = 0; i < list.size(); ++i) {
      key[i] = end;
      for (const std::uint32_t row : rows.subspan(list[i] * node_count, node_count)) {
        if (row >= begin && row < key[i]) key[i] = row;
      }
      ++next[key[i] - begin + 1];
    }
    std::partial_sum(next.begin(), next.end(), next.begin());
    for (std::size_t i = 0; i < list.size(); ++i) sorted[next[key[i] - begin]++] = list[i];
    list = std::move(sorted);
  });
  for (const std::vector<std::uint32_t>& list : of_patch) {
    out.ranges.push_back(static_cast<std::uint32_t>(out.order.size()));
    out.order.insert(out.order.end(), list.begin(), list.end());
    out.ranges.push_back(static_cast<std::uint32_t>(out.order.size()));
    out.order.resize(round_up(static_cast<std::uint32_t>(out.order.size()), kSliceRows), mesh::kNone);
  }
  return out;
}

std::vector<std::uint32_t> pair_places(const Layout& layout, const PatchElements& elements,
                                       std::span<const std::uint32_t> rows, std::size_t node_count) {
  const std::size_t stride = elements.order.size();
  std::vector<std::uint32_t> places(node_count * (node_count - 1) / 2 * stride, kNoPlace);
  const auto fill = [&](std::uint32_t patch, std::size_t first, std::size_t last) {
    const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
    const auto is_own = [&](std::uint32_t row) { return row >= begin && row < end; };
    for (std::size_t e = first; e < last; ++e) {
      std::size_t pair = 0;  // in the order of physics::pair_index
      for (std::size_t k = 0; k < node_count; ++k) {
        for (std::size_t l = k + 1; l < node_count; ++l, ++pair) {
          const std::uint32_t row_k = rows[k * stride + e], row_l = rows[l * stride + e];
          std::uint32_t& place = places[pair * stride + e];
          if (is_own(row_k)) {
            if (const std::uint32_t slot = layout.slot(row_k, row_l); slot != kNoPlace) place = 2 * slot;
          }
          if (place == kNoPlace && is_own(row_l)) {
            if (const std::uint32_t slot = layout.slot(row_l, row_k); slot != kNoPlace) place = 2 * slot + 1;
          }
        }
      }
    }
  };
  constexpr std::size_t kGrain = 4096;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::size_t begin = elements.ranges[2 * patch], end = elements.ranges[2 * patch + 1];
    parallel_ranges(end - begin, kGrain,
                    [&](std::size_t first, std::size_t last) { fill(patch, begin + first, begin + last); });
  }
  return places;
}

}  // namespace tensormass::matrix
