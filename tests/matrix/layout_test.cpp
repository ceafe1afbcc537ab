#include "matrix/layout.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <set>

#include <gtest/gtest.h>

#include "matrix/patch_elements.h"
#include "mesh/random_mesh.h"
#include "mesh/shapes.h"

/// Checks the layout against the mesh by brute force.
namespace tensormass::matrix {
namespace {

/// Neighbours by brute force: two nodes of one element.
std::vector<std::set<std::uint32_t>> neighbours_of(const mesh::Mesh& mesh) {
  std::vector<std::set<std::uint32_t>> out(mesh.nodes.size());
  mesh::for_each_element(mesh, [&](std::uint32_t, const mesh::Topology&, std::span<const std::uint32_t> nodes) {
    for (const std::uint32_t a : nodes) {
      for (const std::uint32_t b : nodes) {
        if (a != b) out[a].insert(b);
      }
    }
  });
  return out;
}

std::uint32_t slice_width(const Layout& layout, std::uint32_t row) {
  return layout.slice_begin[row / kSliceRows + 1] - layout.slice_begin[row / kSliceRows];
}
std::uint32_t slot_at(const Layout& layout, std::uint32_t row, std::uint32_t j) {
  return (layout.slice_begin[row / kSliceRows] + j) * kSliceRows + row % kSliceRows;
}

void check_rows(const mesh::Mesh& mesh, const Layout& layout) {
  ASSERT_EQ(layout.patch_rows.size(), layout.patch_count + 1);
  ASSERT_EQ(layout.patch_rows.front(), 0u);
  ASSERT_EQ(layout.patch_rows.back(), layout.row_count);
  ASSERT_EQ(layout.node_of_row.size(), layout.row_count);
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    EXPECT_EQ(layout.patch_rows[patch] % kSliceRows, 0u);
    EXPECT_LT(layout.patch_rows[patch], layout.patch_rows[patch + 1]);
    bool padding = false;
    for (std::uint32_t row = layout.patch_rows[patch]; row < layout.patch_rows[patch + 1]; ++row) {
      EXPECT_EQ(layout.patch_of_row(row), patch);
      padding = padding || layout.node_of_row[row] == mesh::kNone;
      EXPECT_EQ(padding, layout.node_of_row[row] == mesh::kNone) << "padding comes last in its patch";
    }
  }
  std::uint32_t filled = 0;
  for (std::uint32_t node = 0; node < mesh.nodes.size(); ++node) {
    ASSERT_LT(layout.row_of_node[node], layout.row_count);
    ASSERT_EQ(layout.node_of_row[layout.row_of_node[node]], node);
  }
  for (const std::uint32_t node : layout.node_of_row) filled += node != mesh::kNone ? 1 : 0;
  EXPECT_EQ(filled, mesh.nodes.size()) << "each node has one row";
}

void check_slots(const mesh::Mesh& mesh, const Layout& layout) {
  const auto neighbours = neighbours_of(mesh);
  ASSERT_EQ(layout.slice_begin.size(), layout.row_count / kSliceRows + 1);
  ASSERT_EQ(layout.slot_count(), layout.slice_begin.back() * kSliceRows);
  ASSERT_EQ(layout.neighbour_rows.size(), layout.columns.size());
  for (std::uint32_t row = 0; row < layout.row_count; ++row) {
    const std::uint32_t patch = layout.patch_of_row(row);
    const std::uint32_t begin = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - begin;
    const std::uint32_t node = layout.node_of_row[row];
    std::set<std::uint32_t> found;
    for (std::uint32_t j = 0; j < slice_width(layout, row); ++j) {
      const std::uint32_t slot = slot_at(layout, row, j), column = layout.columns[slot];
      const std::uint32_t halo = layout.patch_halo[patch + 1] - layout.patch_halo[patch];
      ASSERT_LT(column, own + halo);
      const std::uint32_t other = column < own ? begin + column : layout.halo[layout.patch_halo[patch] + column - own];
      if (layout.neighbour_rows[slot] == mesh::kNone) {
        EXPECT_EQ(other, row) << "a padding slot names its own row";
        continue;
      }
      EXPECT_EQ(other, layout.neighbour_rows[slot]) << "the patch-local column is that row";
      EXPECT_TRUE(found.insert(layout.node_of_row[other]).second) << "no neighbour twice";
      EXPECT_EQ(layout.slot(row, other), slot);
    }
    EXPECT_EQ(found, node == mesh::kNone ? std::set<std::uint32_t>{} : neighbours[node]) << "row " << row;
  }
  for (std::uint32_t slice = 0; slice < layout.row_count / kSliceRows; ++slice) {
    std::size_t longest = 0;
    for (std::uint32_t row = slice * kSliceRows; row < (slice + 1) * kSliceRows; ++row) {
      const std::uint32_t node = layout.node_of_row[row];
      if (node != mesh::kNone) longest = std::max(longest, neighbours[node].size());
    }
    EXPECT_EQ(slice_width(layout, slice * kSliceRows), longest) << "a slice is as wide as its longest row";
  }
}

/// Storage::kEdges: expects an edge within a patch once, an edge between patches in both rows, each in its section.
void check_edges(const mesh::Mesh& mesh, const Layout& layout) {
  const auto neighbours = neighbours_of(mesh);
  ASSERT_EQ(layout.slice_begin.size(), layout.row_count / kEdgeSliceRows + 1);
  ASSERT_EQ(layout.slice_halo.size(), layout.row_count / kEdgeSliceRows);
  ASSERT_EQ(layout.slot_count(), layout.slice_begin.back() * kEdgeSliceRows);
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> found;  // (node that stores it, the other)
  for (std::uint32_t slot = 0; slot < layout.slot_count(); ++slot) {
    const std::uint32_t j = slot / kEdgeSliceRows;
    const auto slice = static_cast<std::uint32_t>(
        std::upper_bound(layout.slice_begin.begin(), layout.slice_begin.end(), j) - layout.slice_begin.begin() - 1);
    const std::uint32_t row = slice * kEdgeSliceRows + slot % kEdgeSliceRows, patch = layout.patch_of_row(row);
    const std::uint32_t begin = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - begin;
    const std::uint32_t column = layout.columns[slot], other = layout.neighbour_rows[slot];
    if (other == mesh::kNone) {
      EXPECT_EQ(begin + column, row) << "a padding slot names its own row";
      continue;
    }
    EXPECT_EQ(other, column < own ? begin + column : layout.halo[layout.patch_halo[patch] + column - own]);
    EXPECT_EQ(column < own, j < layout.slice_halo[slice]) << "each section its own kind";
    EXPECT_EQ(layout.slot(row, other), slot);
    ++found[{layout.node_of_row[row], layout.node_of_row[other]}];
  }
  for (std::uint32_t node = 0; node < mesh.nodes.size(); ++node) {
    for (const std::uint32_t other : neighbours[node]) {
      const std::uint32_t row = layout.row_of_node[node], other_row = layout.row_of_node[other];
      const int stored = found[{node, other}], mirrored = found[{other, node}];
      if (layout.patch_of_row(row) == layout.patch_of_row(other_row)) {
        EXPECT_EQ(stored + mirrored, 1) << "nodes " << node << " and " << other;
      } else {
        EXPECT_EQ(stored, 1) << "nodes " << node << " and " << other;
      }
      int places = 0;
      layout.for_each_place(row, other_row, [&](std::uint32_t slot, bool transposed) {
        EXPECT_EQ(layout.neighbour_rows[slot], transposed ? row : other_row);
        ++places;
      });
      EXPECT_EQ(places, stored + mirrored);
    }
  }
  std::set<std::uint32_t> boundary, expected(layout.halo.begin(), layout.halo.end());
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    for (std::uint32_t i = layout.patch_boundary[patch]; i < layout.patch_boundary[patch + 1]; ++i) {
      boundary.insert(layout.patch_rows[patch] + layout.boundary[i]);
    }
  }
  EXPECT_EQ(boundary, expected) << "what one patch reads another publishes";
}

/// Storage::kTiles: expects that the read slots give each block once, and that no two lanes add to one row at once.
void check_tiles(const mesh::Mesh& mesh, const Layout& layout) {
  const auto neighbours = neighbours_of(mesh);
  ASSERT_EQ(layout.slice_read.size(), layout.row_count / kSliceRows);
  ASSERT_EQ(layout.used_twice.size(), layout.slice_begin.back());
  ASSERT_EQ(layout.tile_rows % kSliceRows, 0u);
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> given;  // (row, the neighbour whose block it gets)
  for (std::uint32_t slice = 0; slice < layout.row_count / kSliceRows; ++slice) {
    ASSERT_LE(layout.slice_read[slice], layout.slice_begin[slice + 1]);
    const std::uint32_t patch_row = layout.patch_rows[layout.patch_of_row(slice * kSliceRows)];
    const auto tile_of = [&](std::uint32_t row) { return (row - patch_row) / layout.tile_rows; };
    for (std::uint32_t j = layout.slice_begin[slice]; j < layout.slice_begin[slice + 1]; ++j) {
      std::set<std::uint32_t> added_to;
      for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
        const std::uint32_t row = slice * kSliceRows + lane, other = layout.neighbour_rows[j * kSliceRows + lane];
        const bool read = j < layout.slice_read[slice], twice = (layout.used_twice[j] >> lane & 1) != 0;
        if (read && other != mesh::kNone) ++given[{row, other}];
        if (!twice) continue;
        ASSERT_TRUE(read && other != mesh::kNone);
        EXPECT_TRUE(layout.in_one_patch(row, other) && tile_of(row) == tile_of(other)) << "rows of one tile";
        EXPECT_TRUE(added_to.insert(other).second) << "row " << other << " is added to by two lanes";
        ++given[{other, row}];
      }
    }
  }
  for (std::uint32_t node = 0; node < mesh.nodes.size(); ++node) {
    for (const std::uint32_t other : neighbours[node]) {
      const auto once = given.find({layout.row_of_node[node], layout.row_of_node[other]});
      EXPECT_TRUE(once != given.end() && once->second == 1) << "nodes " << node << " and " << other;
    }
  }
}

void check_halo(const mesh::Mesh& mesh, const Layout& layout) {
  const auto neighbours = neighbours_of(mesh);
  ASSERT_EQ(layout.patch_halo.size(), layout.patch_count + 1);
  ASSERT_EQ(layout.patch_halo.back(), layout.halo.size());
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    std::set<std::uint32_t> expected;
    for (std::uint32_t row = layout.patch_rows[patch]; row < layout.patch_rows[patch + 1]; ++row) {
      if (layout.node_of_row[row] == mesh::kNone) continue;
      for (const std::uint32_t node : neighbours[layout.node_of_row[row]]) {
        const std::uint32_t other = layout.row_of_node[node];
        if (layout.patch_of_row(other) != patch) expected.insert(other);
      }
    }
    std::vector<std::uint32_t> halo(layout.halo.begin() + layout.patch_halo[patch],
                                    layout.halo.begin() + layout.patch_halo[patch + 1]);
    if (layout.storage == Storage::kRows) std::sort(halo.begin(), halo.end());
    EXPECT_EQ(halo, std::vector<std::uint32_t>(expected.begin(), expected.end())) << "ascending, and nothing else";
  }
}

void check(const mesh::Mesh& mesh, std::uint32_t patches) {
  SCOPED_TRACE(testing::Message() << mesh.nodes.size() << " nodes, " << patches << " patches");
  const Layout layout = make_layout(mesh, patches);
  ASSERT_EQ(layout.patch_count, patches);
  check_rows(mesh, layout);
  check_slots(mesh, layout);
  check_halo(mesh, layout);
  const Layout edges = make_layout(mesh, patches, Storage::kEdges);
  check_rows(mesh, edges);
  check_edges(mesh, edges);
  check_halo(mesh, edges);
  const Layout tiles = make_layout(mesh, patches, Storage::kTiles);
  check_rows(mesh, tiles);
  check_slots(mesh, tiles);
  check_tiles(mesh, tiles);
  check_halo(mesh, tiles);
}

TEST(Layout, SharesEdgesOutSoThatSlicesHaveLittlePadding) {
  const Layout layout = make_layout(mesh::testing::unit_grid(16), 2, Storage::kEdges);
  const auto padding = std::count(layout.neighbour_rows.begin(), layout.neighbour_rows.end(), mesh::kNone);
  EXPECT_LT(static_cast<double>(padding), 0.05 * layout.slot_count());
}

/// The corners of quadratic tetrahedra have more than twice as many neighbours as the nodes on edges.
TEST(Layout, RowsOfQuadraticElementsLeaveLittlePadding) {
  const Layout layout = make_layout(mesh::testing::unit_grid(10, mesh::Shape::kQuadraticTetrahedron), 12);
  const auto padding = std::count(layout.neighbour_rows.begin(), layout.neighbour_rows.end(), mesh::kNone);
  EXPECT_LT(static_cast<double>(padding), 0.25 * layout.slot_count());
}

/// A node with a hundred neighbours: its slice is too wide for an order by bank or tile.
TEST(Layout, VeryWideSlicesKeepTheirOrder) {
  constexpr std::uint32_t kRing = 100;
  mesh::Mesh mesh;
  mesh.nodes = {{0, 0, 0}, {0, 0, 1}};
  mesh::ElementBlock block;
  for (std::uint32_t i = 0; i < kRing; ++i) {
    const double angle = 2 * 3.14159265358979 * i / kRing;
    mesh.nodes.push_back({std::cos(angle), std::sin(angle), 0});
    const std::uint32_t nodes[] = {0, 2 + i, 2 + (i + 1) % kRing, 1};
    block.nodes.insert(block.nodes.end(), nodes, nodes + 4);
  }
  mesh.blocks.push_back(block);
  check(mesh, 1);
  check(mesh, 2);
}

/// Returns how many reads queue on average when eight threads read the vectors of a column: the number of different
/// vectors in the fullest of eight banks. The least is 1; a random order has 1.5.
double reads_per_column(const Layout& layout) {
  constexpr std::uint32_t kBanks = 8;
  double reads = 0;
  for (std::uint32_t first = 0; first < layout.slot_count(); first += kBanks) {
    std::array<std::set<std::uint32_t>, kBanks> asked;
    for (std::uint32_t slot = first; slot < first + kBanks; ++slot) {
      asked[layout.columns[slot] % kBanks].insert(layout.columns[slot]);
    }
    reads += static_cast<double>(std::max_element(asked.begin(), asked.end(), [](const auto& a, const auto& b) {
                                   return a.size() < b.size();
                                 })->size());
  }
  return reads / (layout.slot_count() / kBanks);
}

TEST(Layout, HasFewBankConflicts) {
  EXPECT_LT(reads_per_column(make_layout(mesh::testing::unit_grid(24), 36)), 1.2);
  EXPECT_LT(reads_per_column(make_layout(mesh::testing::random_mesh(1, 16, 0.6), 8)), 1.2);
}

TEST(Layout, TilesReadTwoOfThreeBlocks) {
  const Layout layout = make_layout(mesh::testing::unit_grid(24), 4, Storage::kTiles);
  EXPECT_EQ(layout.tile_rows, 256u);
  EXPECT_LT(layout.read_slot_count(), 0.67 * layout.slot_count());
}

/// Each patch computes the elements that touch its rows, and finds each of its own edges once.
TEST(PatchElements, EveryPatchAddsToItsOwnEdgesOnly) {
  const mesh::Mesh mesh = mesh::testing::random_mesh(2, 5, 0.6);
  const Layout layout = make_layout(mesh, 3, Storage::kEdges);
  const auto elements = mesh::element_nodes(mesh);
  std::vector<std::uint32_t> rows;
  for (const auto& nodes : elements) {
    for (const std::uint32_t node : nodes) rows.push_back(layout.row_of_node[node]);
  }
  const PatchElements by_patch = order_by_patch(layout, rows, 4);
  const std::size_t stride = by_patch.order.size();
  std::vector<std::uint32_t> placed(4 * stride, 0);
  for (std::size_t e = 0; e < stride; ++e) {
    for (std::size_t k = 0; by_patch.order[e] != mesh::kNone && k < 4; ++k) {
      placed[k * stride + e] = rows[4 * by_patch.order[e] + k];
    }
  }
  const std::vector<std::uint32_t> places = pair_places(layout, by_patch, placed, 4);
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t begin = by_patch.ranges[2 * patch], end = by_patch.ranges[2 * patch + 1];
    EXPECT_EQ(begin % kSliceRows, 0u);
    const auto is_own = [&](std::uint32_t row) { return layout.patch_of_row(row) == patch; };
    std::multiset<std::uint32_t> computed, expected;
    for (std::uint32_t e = 0; e < elements.size(); ++e) {
      if (std::any_of(&rows[4 * e], &rows[4 * e] + 4, is_own)) expected.insert(e);
    }
    for (std::uint32_t e = begin; e < end; ++e) {
      computed.insert(by_patch.order[e]);
      std::size_t pair = 0;
      for (std::size_t k = 0; k < 4; ++k) {
        for (std::size_t l = k + 1; l < 4; ++l, ++pair) {
          const std::uint32_t row_k = placed[k * stride + e], row_l = placed[l * stride + e];
          const std::uint32_t place = places[pair * stride + e];
          ASSERT_EQ(place != kNoPlace, is_own(row_k) || is_own(row_l));
          if (place == kNoPlace) continue;
          const bool transposed = place % 2 != 0;
          EXPECT_TRUE(is_own(transposed ? row_l : row_k));
          EXPECT_EQ(layout.neighbour_rows[place / 2], transposed ? row_k : row_l);
        }
      }
    }
    EXPECT_EQ(computed, expected);
  }
  EXPECT_TRUE(std::all_of(places.begin(), places.end(),
                          [&](std::uint32_t place) { return place == kNoPlace || place / 2 < layout.slot_count(); }));
}

TEST(Layout, HoldsItsInvariantsOnGrids) {
  for (const std::uint32_t cells : {1u, 3u, 8u}) {
    for (const std::uint32_t patches : {1u, 2u, 3u, 7u}) check(mesh::testing::unit_grid(cells), patches);
  }
}

TEST(Layout, HoldsItsInvariantsOnMeshesWithoutAnyRegularity) {
  for (std::uint32_t seed = 0; seed < 6; ++seed) {
    for (const std::uint32_t patches : {1u, 2u, 5u, 16u}) check(mesh::testing::random_mesh(seed, 6, 0.5), patches);
  }
}

TEST(Layout, MorePatchesThanNodesLeavesPatchesOfPaddingAlone) { check(mesh::testing::unit_grid(1), 12); }

TEST(Layout, OnePatchHasNoHalo) { EXPECT_TRUE(make_layout(mesh::testing::unit_grid(4), 1).halo.empty()); }

TEST(Layout, IsTheSameForTheSameMesh) {
  const mesh::Mesh mesh = mesh::testing::random_mesh(5, 6, 0.6);
  const Layout a = make_layout(mesh, 4), b = make_layout(mesh, 4);
  EXPECT_EQ(a.row_of_node, b.row_of_node);
  EXPECT_EQ(a.columns, b.columns);
}

/// In each column, few of the eight rows that a device reads together share a bank.
TEST(Layout, NeighboursAreSpreadOverBanks) {
  const Layout layout = make_layout(mesh::testing::unit_grid(8), 2);
  std::uint32_t reads = 0, together = 0;
  for (std::uint32_t patch = 0, slice = 0; patch < layout.patch_count; ++patch) {
    for (; slice < layout.patch_rows[patch + 1] / kSliceRows; ++slice) {
      for (std::uint32_t j = layout.slice_begin[slice]; j < layout.slice_begin[slice + 1]; ++j) {
        for (std::uint32_t first = 0; first < kSliceRows; first += 8) {
          std::array<std::uint32_t, 8> count{};
          for (std::uint32_t lane = first; lane < first + 8; ++lane) {
            const std::uint32_t slot = j * kSliceRows + lane;
            if (layout.neighbour_rows[slot] != mesh::kNone) ++count[layout.columns[slot] % 8];
          }
          ++reads;
          together += *std::max_element(count.begin(), count.end());
        }
      }
    }
  }
  // In a random order the fullest of eight banks has 2.6 of eight reads.
  EXPECT_LT(together, 1.7 * reads);
}

TEST(LayoutDeathTest, AssertsWhatKernelsRelyOn) {
  const Layout good = make_layout(mesh::testing::unit_grid(4), 2);
  check_layout(good);
  const auto broken = [&](const auto& spoil) {
    Layout layout = good;
    spoil(layout);
    return layout;
  };
  EXPECT_DEATH(check_layout(broken([](Layout& l) { --l.patch_rows[1]; })), "patches start at slices");
  EXPECT_DEATH(check_layout(broken([](Layout& l) { l.patch_halo.pop_back(); })), "each range has an offset");
  EXPECT_DEATH(check_layout(broken([](Layout& l) { l.slice_begin.back() += 1; })), "the ranges cover all items");
  EXPECT_DEATH(check_layout(broken([](Layout& l) { l.columns[0] = l.row_count; })), "local numbers of the patch");
  EXPECT_DEATH(check_layout(broken([](Layout& l) { std::swap(l.row_of_node[0], l.row_of_node[1]); })), "inverse");
  EXPECT_DEATH(check_layout(broken([](Layout& l) { l.used_twice.push_back(0); })), "only tiles share blocks");
  EXPECT_DEATH(static_cast<void>(good.slot(0, 0)), "couples the two nodes");
}

TEST(LayoutDeathTest, AssertsTheOrderOfRowsAndNeighbours) {
  const mesh::Mesh mesh = mesh::testing::unit_grid(4);
  const auto broken = [&](Storage storage, const auto& spoil) {
    Layout layout = make_layout(mesh, 2, storage);
    spoil(layout);
    return layout;
  };
  const auto fails = [&](Storage storage, const char* words, const auto& spoil) {
    EXPECT_DEATH(check_layout(broken(storage, spoil)), words);
  };
  fails(Storage::kRows, "gap rows are the last ones", [](Layout& l) {
    // The first node of patch 0 moves to its last row, which was a gap.
    const std::uint32_t last = l.patch_rows[1] - 1, node = l.node_of_row[0];
    ASSERT_EQ(l.node_of_row[last], mesh::kNone);
    l.node_of_row[0] = mesh::kNone;
    l.node_of_row[last] = node;
    l.row_of_node[node] = last;
  });
  fails(Storage::kRows, "each node has one row", [](Layout& l) {
    *std::find(l.node_of_row.begin(), l.node_of_row.end(), mesh::kNone) = 0;  // the first gap row
  });
  for (const Storage storage : {Storage::kTiles, Storage::kEdges}) {
    fails(storage, "halos ascend", [](Layout& l) { std::swap(l.halo[0], l.halo[1]); });
  }
  fails(Storage::kEdges, "boundaries ascend", [](Layout& l) { std::swap(l.boundary[0], l.boundary[1]); });
  fails(Storage::kEdges, "boundaries name own rows", [](Layout& l) { l.boundary[0] = l.patch_rows[1]; });
  fails(Storage::kEdges, "edges within the patch come before", [](Layout& l) {
    for (std::size_t slice = 0; slice < l.slice_halo.size(); ++slice) l.slice_halo[slice] = l.slice_begin[slice];
  });
  fails(Storage::kEdges, "neighbours ascend", [](Layout& l) {
    std::swap(l.columns[0], l.columns[kEdgeSliceRows]);
    std::swap(l.neighbour_rows[0], l.neighbour_rows[kEdgeSliceRows]);
  });
  static_cast<void>(make_layout(mesh, 2, Storage::kEdges).patch_of_row(0));
  EXPECT_DEATH(static_cast<void>(make_layout(mesh, 2).patch_of_row(1u << 20)), "belongs to a patch");
}

TEST(LayoutDeathTest, AssertsTheBitsOfTiles) {
  Layout layout = make_layout(mesh::testing::unit_grid(6), 2, Storage::kTiles);
  const std::uint32_t mirrored = layout.slice_read[0];
  ASSERT_LT(mirrored, layout.slice_begin[1]) << "the first slice has blocks that are not read";
  layout.used_twice[mirrored] = 1;
  EXPECT_DEATH(check_layout(layout), "only blocks that are read");
  layout.used_twice[mirrored] = 0;
  check_layout(layout);
  for (std::uint32_t j = layout.slice_begin[0]; j < mirrored; ++j) layout.used_twice[j] = 0xFFFFFFFFu;
  EXPECT_DEATH(check_layout(layout), "only a row of its own tile");
  layout.tile_rows = 2 * kMaxTileRows;
  EXPECT_DEATH(check_layout(layout), "room for the sums of a tile");
}

TEST(Records, BeginAtMultiplesOfFourAndHoldPointsAndParameters) {
  EXPECT_EQ(record_reals(10, 1, 2), 12u);
  EXPECT_EQ(record_reals(10, 1, 3), 16u);
  EXPECT_EQ(point_stride(10, 1), 10u);
  EXPECT_EQ(point_stride(22, 8), 24u);
  EXPECT_EQ(record_reals(22, 8, 2), 8 * 24u + 4);
}

TEST(Blocks, ComeBackAsTheyWereStored) {
  std::vector<float> blocks(9 * 3 * kSliceRows, 0);
  for (const std::size_t slot : {0u, 31u, 32u, 95u}) {
    const Mat3<float> m = Mat3<float>::Random();
    store_block<float>(blocks.data(), slot, m);
    EXPECT_EQ(load_block<float>(blocks.data(), slot), m);
  }
  EXPECT_EQ((load_block<float>(blocks.data(), 1)), (Mat3<float>(Mat3<float>::Zero()))) << "a neighbour is untouched";
}

}  // namespace
}  // namespace tensormass::matrix
