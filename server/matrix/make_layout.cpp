#include <algorithm>
#include <array>
#include <numeric>

#include "core/assert.h"
#include "core/offsets.h"
#include "core/parallel.h"
#include "matrix/banks.h"
#include "matrix/layout.h"
#include "matrix/stored_edges.h"
#include "mesh/partition.h"

/// Makes a layout in four steps:
///
///   1. partition    nodes into patches (mesh/partition.h)
///   2. number_rows  patch by patch; rows of equal length side by side, so that slices have little padding. With
///                   kRows, rows that are far longer than the others come first
///   3. halo_of      for each patch; kRows then exchanges rows so that reads meet different banks (banks.h)
///   4. patch_slots  for each patch: the columns of its slices; kTiles then orders them (tiles.h)
///
/// Steps 3 and 4 run in parallel over patches. Their results are joined in the order of the patches.
namespace tensormass::matrix {

namespace {

/// Rows are sorted by length within windows of this many. Larger windows leave less padding, but tear neighbours apart
/// in memory.
constexpr std::uint32_t kSortWindowRows = 8 * kSliceRows;

std::uint32_t round_up(std::uint32_t value, std::uint32_t multiple) {
  return (value + multiple - 1) / multiple * multiple;
}

/// Moves nodes with many neighbours to the front of their patch. The corners of quadratic elements have far more than
/// the other nodes: spread over all slices, they would widen each.
void bring_long_rows_forward(mesh::Partition& partition, const StoredEdges& stored) {
  std::vector<std::uint32_t> lengths(stored.all);
  const auto usual = lengths.begin() + static_cast<std::ptrdiff_t>(lengths.size() * 3 / 4);
  std::nth_element(lengths.begin(), usual, lengths.end());
  for (std::size_t patch = 0; patch + 1 < partition.offsets.size(); ++patch) {
    std::stable_partition(partition.order.begin() + partition.offsets[patch],
                          partition.order.begin() + partition.offsets[patch + 1],
                          [&](std::uint32_t node) { return stored.all[node] >= 2 * *usual; });
  }
}

/// kTiles: returns for each node how many of its neighbours are outside of its tile.
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

/// Numbers the nodes patch by patch, sorted by length within each window. Fills up each patch to whole slices.
///
/// beyond_tile: [node] for kTiles, else empty. It sorts rows of equal length, so that the rows which share the fewest
/// blocks with their tile come into the same slices.
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

/// The part of the layout that one patch contributes. Widths are in columns.
struct PatchSlots {
  std::vector<std::uint32_t> columns, neighbour_rows, halo;
  std::vector<std::uint32_t> inner_widths, widths;  // [slice] inner: edges within the patch
  std::vector<std::uint32_t> read_widths;           // [slice] kTiles only
  std::vector<std::uint32_t> used_twice;            // [column] kTiles only
};

/// kTiles: orders the neighbours of all rows, tile by tile. Tiles with very wide slices keep the order they have.
void order_tiles(const Layout& layout, PatchSlots& patch) {
  const std::size_t slices = patch.widths.size(), tile_slices = layout.tile_rows / kSliceRows;
  patch.read_widths = patch.widths;
  patch.used_twice.assign(patch.columns.size() / kSliceRows, 0);
  std::size_t column = 0;
  for (std::size_t first = 0; first < slices; first += tile_slices) {
    const auto widths =
        std::span<const std::uint32_t>(patch.widths).subspan(first, std::min(tile_slices, slices - first));
    const std::size_t columns = std::accumulate(widths.begin(), widths.end(), std::size_t{0});
    if (*std::max_element(widths.begin(), widths.end()) <= kMaxSpreadColumns) {
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
  TM_ASSERT(column * kSliceRows == patch.columns.size(), "tiles cover all columns of the patch");
}

/// Returns the nodes of other patches to which a patch's rows are coupled, ascending by row.
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

/// kRows: exchanges the rows of a patch and the nodes of its halo so that reads meet different banks (banks.h).
///
/// Does not update row_of_node: other patches read it at the same time.
void arrange_by_bank(Layout& layout, const mesh::Rows& neighbours, std::uint32_t patch,
                     std::vector<std::uint32_t>& halo) {
  const std::uint32_t begin = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - begin;
  const std::span<std::uint32_t> own_nodes(layout.node_of_row.data() + begin, own);
  const auto row_of = [&](std::uint32_t node) { return layout.row_of_node[node]; };
  const auto column_of = [&](std::uint32_t node) {
    if (row_of(node) >= begin && row_of(node) < begin + own) return row_of(node) - begin;
    const auto place = std::lower_bound(halo.begin(), halo.end(), node,
                                        [&](std::uint32_t a, std::uint32_t b) { return row_of(a) < row_of(b); });
    TM_ASSERT(place != halo.end() && *place == node, "the halo has every neighbour of other patches");
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

/// Lists the slots of a patch, slice by slice and column by column: first the edges within the patch, then (kEdges
/// only) those to the halo. Within each of the two sections the neighbours of a row ascend, unless an order by bank or
/// tile follows.
PatchSlots patch_slots(const Layout& layout, const mesh::Rows& neighbours, const StoredEdges& stored,
                       std::uint32_t patch, std::span<const std::uint32_t> halo) {
  const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1], count = end - begin;
  // The neighbours of local row i: inner in [offsets[i], middles[i]), outer in [middles[i], offsets[i + 1]).
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
  std::vector<std::pair<std::uint32_t, std::uint32_t>> outer;  // rows of the halo and their local numbers
  for (const std::uint32_t node : halo) {
    out.halo.push_back(layout.row_of_node[node]);
    outer.emplace_back(out.halo.back(), count + static_cast<std::uint32_t>(outer.size()));
  }
  std::sort(outer.begin(), outer.end());
  const auto column_of = [&](std::uint32_t row) {
    if (row >= begin && row < end) return row - begin;
    const auto found = std::lower_bound(outer.begin(), outer.end(), std::pair{row, 0u});
    TM_ASSERT(found != outer.end() && found->first == row, "the halo has every neighbour of other patches");
    return found->second;
  };

  const std::uint32_t height = layout.slice_rows();
  for (std::uint32_t slice = 0; slice < count; slice += height) {
    // Adds a section: the neighbours [from(i), to(i)) of each row i. Returns its width.
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
    if (layout.storage == Storage::kRows && out.widths.back() <= kMaxSpreadColumns) {
      std::array<std::uint32_t, kSliceRows> ends{};
      for (std::uint32_t i = 0; i < kSliceRows; ++i) ends[i] = offsets[slice + i + 1] - offsets[slice + i];
      order_by_bank(std::span(out.columns).subspan(begin_of_slice),
                    std::span(out.neighbour_rows).subspan(begin_of_slice), ends);
    }
  }
  if (layout.storage == Storage::kTiles) order_tiles(layout, out);
  return out;
}

/// Appends the parts of all patches to the layout, and frees them.
void join_patches(Layout& layout, std::vector<PatchSlots>& patches) {
  layout.patch_halo.assign(1, 0);
  layout.slice_begin.assign(1, 0);
  for (PatchSlots& patch : patches) {
    for (std::size_t slice = 0; slice < patch.widths.size(); ++slice) {
      const std::uint32_t begin = layout.slice_begin.back();
      if (layout.storage == Storage::kEdges) layout.slice_halo.push_back(begin + patch.inner_widths[slice]);
      if (layout.storage == Storage::kTiles) layout.slice_read.push_back(begin + patch.read_widths[slice]);
      layout.slice_begin.push_back(begin + patch.widths[slice]);
    }
    layout.columns.insert(layout.columns.end(), patch.columns.begin(), patch.columns.end());
    layout.neighbour_rows.insert(layout.neighbour_rows.end(), patch.neighbour_rows.begin(), patch.neighbour_rows.end());
    layout.used_twice.insert(layout.used_twice.end(), patch.used_twice.begin(), patch.used_twice.end());
    layout.halo.insert(layout.halo.end(), patch.halo.begin(), patch.halo.end());
    layout.patch_halo.push_back(static_cast<std::uint32_t>(layout.halo.size()));
    patch = {};
  }
}

/// kEdges: lists the rows of each patch that are in the halo of another.
void list_boundary(Layout& layout) {
  std::vector<std::uint32_t> boundary = layout.halo;
  std::sort(boundary.begin(), boundary.end());
  boundary.erase(std::unique(boundary.begin(), boundary.end()), boundary.end());
  layout.patch_boundary.assign(layout.patch_count + 1, 0);
  for (const std::uint32_t row : boundary) {
    const std::uint32_t patch = layout.patch_of_row(row);
    layout.boundary.push_back(row - layout.patch_rows[patch]);
    ++layout.patch_boundary[patch + 1];
  }
  std::partial_sum(layout.patch_boundary.begin(), layout.patch_boundary.end(), layout.patch_boundary.begin());
}

}  // namespace

Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count, Storage storage) {
  return make_layout(mesh.nodes, mesh::node_neighbours(mesh), patch_count, storage);
}

Layout make_layout(std::span<const Eigen::Vector3d> nodes, const mesh::Rows& neighbours, std::uint32_t patch_count,
                   Storage storage) {
  TM_ASSERT(patch_count >= 1, "a layout has patches");
  TM_ASSERT(neighbours.size() == nodes.size(), "each node has a list of neighbours");
  Layout layout;
  layout.storage = storage;
  layout.patch_count = patch_count;
  if (storage == Storage::kTiles) {
    layout.tile_rows = rows_of_tiles(static_cast<std::uint32_t>(nodes.size()) / patch_count + 1);
  }
  mesh::Partition partition = mesh::partition(nodes, patch_count, std::max(layout.tile_rows, kSliceRows));
  assert_offsets(partition.offsets, patch_count, nodes.size());
  const StoredEdges stored = storage == Storage::kEdges ? share_edges(partition, neighbours) : whole_rows(neighbours);
  if (storage == Storage::kRows) bring_long_rows_forward(partition, stored);
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
  join_patches(layout, patches);
  if (storage == Storage::kEdges) list_boundary(layout);
  check_layout(layout);
  return layout;
}

}  // namespace tensormass::matrix
