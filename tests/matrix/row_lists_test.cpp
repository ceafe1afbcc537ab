#include "matrix/row_lists.h"

#include <array>
#include <cmath>
#include <map>
#include <numbers>
#include <tuple>

#include <gtest/gtest.h>

#include "matrix/row_elements.h"
#include "mesh/random_mesh.h"
#include "mesh/shapes.h"

/// Lists of rows against the elements themselves: each node of each element is listed once, in its row, and knows the
/// slots of the other nodes.
namespace tensormass::matrix {
namespace {

constexpr std::uint32_t kNodes = 4;

/// Tetrahedra of a mesh in two groups by turns, as ElementRows wants them.
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
      views.push_back({kNodes, count, count, rows[g]});
    }
  }
  std::array<std::vector<std::uint32_t>, 2> rows;
  std::vector<ElementRows> views;
};

void check(const mesh::Mesh& mesh, std::uint32_t patches, bool finishes, std::uint32_t place_bits) {
  const Layout layout = make_layout(mesh, patches);
  const Groups groups(mesh, layout);
  const GroupRowLists lists = make_row_lists(layout, groups.views, finishes);
  std::map<std::uint32_t, int> begun, finished;  // by slice
  for (std::size_t g = 0; g < 2; ++g) {
    const RowLists& group = lists.groups[g];
    ASSERT_EQ(group.place_bits, place_bits);
    ElementView<float> view{};
    view.place_bits = group.place_bits;
    view.places = group.places.data();
    std::map<std::pair<std::uint32_t, std::uint32_t>, int> found;  // element, node
    std::uint32_t list_end = 0, longest = kNoPlace;
    for (const ListedSlice& listed : group.slices) {
      const std::uint32_t slice = listed.slice(), patch = layout.patch_of_row(slice * kSliceRows);
      EXPECT_EQ(listed.list_begin, list_end);
      list_end = listed.list_end;
      EXPECT_LE(listed.list_end - listed.list_begin, longest) << "what is begun last ends soonest";
      longest = listed.list_end - listed.list_begin;
      EXPECT_EQ(listed.columns_begin, layout.slice_begin[slice]);
      EXPECT_EQ(listed.columns_end, layout.slice_begin[slice + 1]);
      EXPECT_EQ(listed.patch.row_begin, layout.patch_rows[patch]);
      EXPECT_EQ(listed.patch.row_end, layout.patch_rows[patch + 1]);
      EXPECT_EQ(listed.patch.halo_begin, layout.patch_halo[patch]);
      EXPECT_EQ(listed.is_begun(), begun[slice] > 0) << "the first group assigns, the others add";
      EXPECT_EQ(finished[slice], 0) << "nothing comes after the group that finishes";
      ++begun[slice];
      finished[slice] += listed.finishes() ? 1 : 0;
      for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
        const std::uint32_t row = slice * kSliceRows + lane;
        std::uint32_t before = 0;
        for (std::uint32_t column = listed.list_begin; column < listed.list_end; ++column) {
          const std::uint32_t element = group.listed[std::size_t{column} * kSliceRows + lane];
          if (element == kNoPlace) {
            before = kNoPlace;
            continue;
          }
          ASSERT_NE(before, kNoPlace) << "a list has no gap";
          EXPECT_TRUE(column == listed.list_begin || element > before) << "summed in the order of the elements";
          before = element;
          const Places<kNodes> places(Places<kNodes>::Packed::read(view, column, lane), view.place_bits);
          std::uint32_t own = 0;
          while (own + 1 < kNodes && !places.is_own(static_cast<int>(own))) ++own;
          for (std::uint32_t l = 0; l < kNodes; ++l) {
            const std::uint32_t other = groups.rows[g][std::size_t{l} * groups.views[g].stride + element];
            if (l == own) {
              EXPECT_EQ(other, row);
            } else {
              const std::uint32_t place = places.others()[(l == 0 ? own : l) - 1];
              EXPECT_EQ((layout.slice_begin[slice] + place) * kSliceRows + lane, layout.slot(row, other));
            }
          }
          ++found[{element, own}];
        }
      }
    }
    for (std::uint32_t e = 0; e < groups.views[g].element_count; ++e) {
      for (std::uint32_t k = 0; k < kNodes; ++k) EXPECT_EQ((found[{e, k}]), 1);
    }
  }
  ASSERT_EQ(lists.begun_slices.size(), finishes ? 0 : layout.row_count / kSliceRows);
  for (std::uint32_t slice = 0; slice < layout.row_count / kSliceRows; ++slice) {
    EXPECT_EQ(finished[slice], finishes && begun[slice] > 0 ? 1 : 0);
    if (!finishes) {
      EXPECT_EQ(lists.begun_slices[slice], begun[slice] > 0 ? 1 : 0);
    }
  }
}

TEST(RowLists, EveryNodeOfEveryElementIsListedOnceWithItsPlaces) {
  check(mesh::testing::random_mesh(3, 6, 0.7), 3, true, 8);
  check(mesh::testing::random_mesh(3, 6, 0.7), 3, false, 8);
}

/// Tetrahedra around an axis, whose nodes have as many neighbours as there are nodes around it.
mesh::Mesh wheel(std::uint32_t around) {
  mesh::Mesh mesh;
  mesh.nodes = {{0, 0, 0}, {0, 0, 1}};
  mesh::ElementBlock block{mesh::Shape::kTetrahedron, {}};
  for (std::uint32_t i = 0; i < around; ++i) {
    const double angle = 2 * std::numbers::pi * i / around;
    mesh.nodes.emplace_back(std::cos(angle), std::sin(angle), 0);
    block.nodes.insert(block.nodes.end(), {0, 2 + i, 2 + (i + 1) % around, 1});
  }
  mesh.blocks.push_back(block);
  return mesh;
}

TEST(RowLists, PlacesOfVeryWideRowsHaveMoreBits) {
  check(wheel(100), 2, true, 8);
  check(wheel(300), 2, true, 16);
}

TEST(RowListsDeathTest, AssertThatElementsNameRowsOfALayoutThatStoresThem) {
  const mesh::Mesh mesh = mesh::testing::unit_grid(2);
  const Layout layout = make_layout(mesh, 1);
  Groups groups(mesh, layout);
  EXPECT_DEATH(make_row_lists(make_layout(mesh, 1, Storage::kEdges), groups.views, false), "store all of their blocks");
  ++groups.views[0].element_count;
  EXPECT_DEATH(make_row_lists(layout, groups.views, false), "padding follows the elements");
  --groups.views[0].element_count;
  groups.rows[0][0] = layout.row_count;
  EXPECT_DEATH(make_row_lists(layout, groups.views, false), "name rows of the layout");
}

}  // namespace
}  // namespace tensormass::matrix
