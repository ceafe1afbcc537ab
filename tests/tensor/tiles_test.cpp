#include "tensor/tiles.h"

#include <array>
#include <map>
#include <tuple>

#include <gtest/gtest.h>

#include "mesh/random_mesh.h"
#include "mesh/shapes.h"

/// Tiles against the elements themselves: every force and every edge tensor reaches its row once, and rows are finished
/// once.
namespace tensormass::tensor {
namespace {

constexpr std::uint32_t kNodes = 4;

/// Tetrahedra of a random mesh in two groups by turns, as ElementRows wants them.
struct Groups {
  explicit Groups(const mesh::Mesh& mesh, const Layout& layout) {
    std::uint32_t turn = 0;
    std::array<std::vector<std::array<std::uint32_t, kNodes>>, 2> elements;
    for (const auto& nodes : mesh::element_nodes(mesh)) {
      std::array<std::uint32_t, kNodes> element{};
      for (std::uint32_t k = 0; k < kNodes; ++k) element[k] = layout.row_of_node[nodes[k]];
      elements[turn++ % 3 == 0 ? 0 : 1].push_back(element);
    }
    for (std::size_t g = 0; g < 2; ++g) {
      const auto count = static_cast<std::uint32_t>(elements[g].size());
      rows[g].resize(std::size_t{kNodes} * count);
      for (std::uint32_t e = 0; e < count; ++e) {
        for (std::uint32_t k = 0; k < kNodes; ++k) rows[g][std::size_t{k} * count + e] = elements[g][e][k];
      }
      views.push_back({kNodes, count, count, rows[g], 0});
    }
  }
  std::uint32_t row(std::size_t g, std::uint32_t e, std::uint32_t k) const {
    return rows[g][std::size_t{k} * views[g].element_count + e];
  }
  std::array<std::vector<std::uint32_t>, 2> rows;
  std::vector<ElementRows> views;
};

/// What a place in a part's records is: element of the group, then its node or its pair.
struct Place {
  std::uint32_t element, component;
};
Place place_of(const GroupTiles& tiles, const TilePart& part, std::uint32_t offset, bool is_edge) {
  const std::uint32_t record = tile_record_reals(kNodes), inside = offset % record;
  EXPECT_LT(offset / record, part.element_count);
  const std::uint32_t first = is_edge ? edge_offset(kNodes, 0) : force_offset(0), size = is_edge ? 9 : 3;
  EXPECT_EQ((inside - first) % size, 0u);
  return {tiles.elements[part.element_begin + offset / record], (inside - first) / size};
}

void check(std::uint32_t capacity_reals, bool finishes) {
  SCOPED_TRACE(testing::Message() << capacity_reals << " reals, finishes " << finishes);
  const mesh::Mesh mesh = mesh::testing::random_mesh(3, 6, 0.7);
  const Layout layout = make_layout(mesh, 3);
  const Groups groups(mesh, layout);
  const Tiles tiles = make_tiles(layout, groups.views, capacity_reals, finishes);

  std::map<std::tuple<std::size_t, std::uint32_t, std::uint32_t>, int> forces;                // group, element, node
  std::map<std::tuple<std::size_t, std::uint32_t, std::uint32_t, std::uint32_t>, int> edges;  // .., row, other
  std::map<std::uint32_t, int> parts_before, finished;                                        // by slice
  for (std::size_t g = 0; g < 2; ++g) {
    const GroupTiles& group = tiles.groups[g];
    ASSERT_EQ(group.tile_parts.back(), group.parts.size());
    for (const TilePart& part : group.parts) {
      EXPECT_LE(part.element_count * tile_record_reals(kNodes), capacity_reals);
      EXPECT_EQ(part.list_begin % kTileAlignment, 0u);
      EXPECT_EQ(part.entry_begin % kTileAlignment, 0u);
      const std::uint32_t slots_begin = layout.slice_begin[part.slice_begin] * kSliceRows;
      const std::uint32_t slots = layout.slice_begin[part.slice_begin + part.slice_count] * kSliceRows - slots_begin;
      ASSERT_EQ(part.list_count, slots + part.slice_count * kSliceRows + 1);
      for (std::uint32_t list = 0; list + 1 < part.list_count; ++list) {
        for (std::uint32_t i = group.lists[part.list_begin + list]; i < group.lists[part.list_begin + list + 1]; ++i) {
          const std::uint32_t entry = group.entries[part.entry_begin + i];
          if (list >= slots) {
            const Place place = place_of(group, part, entry, false);
            EXPECT_EQ(groups.row(g, place.element, place.component), part.slice_begin * kSliceRows + list - slots);
            ++forces[{g, place.element, place.component}];
            continue;
          }
          const Place place = place_of(group, part, entry / 2, true);
          constexpr std::array<std::array<std::uint32_t, 2>, 6> kPairs{
              {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}}};
          const auto [k, l] = kPairs[place.component];
          const std::uint32_t slot = slots_begin + list;
          const std::uint32_t row = groups.row(g, place.element, entry % 2 != 0 ? l : k);
          const std::uint32_t other = groups.row(g, place.element, entry % 2 != 0 ? k : l);
          EXPECT_EQ(layout.slot(row, other), slot);
          ++edges[{g, place.element, row, other}];
        }
      }
      for (std::uint32_t s = part.slice_begin; s < part.slice_begin + part.slice_count; ++s) {
        EXPECT_EQ(part.adds != 0, parts_before[s] > 0) << "the first part of a tile assigns, the others add";
        EXPECT_EQ(finished[s], 0) << "nothing comes after the part that finishes";
        ++parts_before[s];
        finished[s] += part.finishes;
      }
    }
  }
  for (std::size_t g = 0; g < 2; ++g) {
    for (std::uint32_t e = 0; e < groups.views[g].element_count; ++e) {
      for (std::uint32_t k = 0; k < kNodes; ++k) {
        EXPECT_EQ((forces[{g, e, k}]), 1);
        for (std::uint32_t l = 0; l < kNodes; ++l) {
          if (l != k) EXPECT_EQ((edges[{g, e, groups.row(g, e, k), groups.row(g, e, l)}]), 1);
        }
      }
    }
  }
  std::map<std::uint32_t, bool> open;
  for (const std::uint32_t one : tiles.open_slices) open[one / 2] = one % 2 != 0;
  for (std::uint32_t slice = 0; slice < layout.row_count / kSliceRows; ++slice) {
    if (finishes) {
      EXPECT_EQ(finished[slice], parts_before[slice] > 0 ? 1 : 0);
      EXPECT_FALSE(open.contains(slice));
    } else {
      EXPECT_EQ(finished[slice], 0);
      ASSERT_TRUE(open.contains(slice));
      EXPECT_EQ(open[slice], parts_before[slice] > 0);
    }
  }
}

TEST(Tiles, EveryTensorReachesItsRowOnce) {
  check(kMaxTileReals, true);
  check(kMaxTileReals, false);
}

TEST(Tiles, WhatDoesNotFitAtOnceComesInParts) {
  check(20 * tile_record_reals(kNodes), true);
  check(tile_record_reals(kNodes), false);
}

}  // namespace
}  // namespace tensormass::tensor
