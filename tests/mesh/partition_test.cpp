#include "mesh/partition.h"

#include <numeric>

#include <gtest/gtest.h>

#include "mesh/adjacency.h"
#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

void expect_permutation(std::vector<std::uint32_t> order, std::size_t count) {
  std::sort(order.begin(), order.end());
  std::vector<std::uint32_t> expected(count);
  std::iota(expected.begin(), expected.end(), 0u);
  EXPECT_EQ(order, expected);
}

TEST(Partition, PatchesAreEqualInSizeAndHoldEveryNodeOnce) {
  const Mesh mesh = testing::random_mesh(1, 6, 0.8);
  for (const std::uint32_t patch_count : {1u, 2u, 3u, 7u, 16u, 100u}) {
    const Partition result = partition(mesh.nodes, patch_count, 8);
    expect_permutation(result.order, mesh.nodes.size());
    ASSERT_EQ(result.offsets.size(), patch_count + 1);
    EXPECT_EQ(result.offsets.front(), 0u);
    EXPECT_EQ(result.offsets.back(), mesh.nodes.size());
    for (std::uint32_t patch = 0; patch < patch_count; ++patch) {
      const std::size_t size = result.offsets[patch + 1] - result.offsets[patch];
      EXPECT_GE(size, mesh.nodes.size() / patch_count);
      EXPECT_LE(size, mesh.nodes.size() / patch_count + 1);
    }
  }
}

TEST(Partition, MorePatchesThanNodesLeavesSomeEmpty) {
  const Mesh mesh = testing::unit_grid(1);
  const Partition result = partition(mesh.nodes, 20, 4);
  expect_permutation(result.order, 8);
  for (std::uint32_t patch = 0; patch < 20; ++patch) {
    EXPECT_LE(result.offsets[patch + 1] - result.offsets[patch], 1u);
  }
}

TEST(Partition, PatchesAreCompact) {
  // A long beam in four patches must be cut across its length into quarters.
  const Mesh mesh = make_grid({0, 0, 0}, {8.0, 1.0, 0.8}, 64, 8, 6).value();
  const Partition result = partition(mesh.nodes, 4, 32);
  for (std::uint32_t patch = 0; patch < 4; ++patch) {
    Eigen::AlignedBox3d box;
    for (std::uint32_t i = result.offsets[patch]; i < result.offsets[patch + 1]; ++i) {
      box.extend(mesh.nodes[result.order[i]]);
    }
    EXPECT_NEAR(box.sizes().x(), 2.0, 8.0 / 64);
  }
}

TEST(Partition, CutsFewEdges) {
  // A patch has 216 nodes, at best 6 × 6 × 6. A random partition cuts 96 % of the edges, slabs cut about 40 %.
  const Mesh mesh = testing::unit_grid(17);
  const Partition result = partition(mesh.nodes, 27, 32);
  std::vector<std::uint32_t> patch_of(mesh.nodes.size());
  for (std::uint32_t patch = 0; patch < 27; ++patch) {
    for (std::uint32_t i = result.offsets[patch]; i < result.offsets[patch + 1]; ++i) patch_of[result.order[i]] = patch;
  }
  const Rows neighbours = node_neighbours(mesh);
  std::size_t cut = 0;
  for (std::uint32_t node = 0; node < neighbours.size(); ++node) {
    for (const std::uint32_t other : neighbours[node]) cut += patch_of[node] != patch_of[other];
  }
  EXPECT_LT(static_cast<double>(cut) / static_cast<double>(neighbours.items.size()), 0.30);
}

TEST(Partition, TiesAreBrokenByIndex) {
  const std::vector<Eigen::Vector3d> same(100, Eigen::Vector3d(1.0, 2.0, 3.0));
  std::vector<std::uint32_t> expected(100);
  std::iota(expected.begin(), expected.end(), 0u);
  EXPECT_EQ(bisection_order(same, 8), expected);
}

TEST(Partition, LeavesAreFullAndAscending) {
  const Mesh mesh = testing::random_mesh(2, 5, 0.9);
  constexpr std::uint32_t kLeaf = 32;
  const std::vector<std::uint32_t> order = bisection_order(mesh.nodes, kLeaf);
  expect_permutation(order, mesh.nodes.size());
  for (std::size_t first = 0; first < order.size(); first += kLeaf) {
    const auto end = std::min<std::size_t>(first + kLeaf, order.size());
    EXPECT_TRUE(std::is_sorted(order.begin() + static_cast<long>(first), order.begin() + static_cast<long>(end)));
  }
  EXPECT_FALSE(std::is_sorted(order.begin(), order.end()));
}

TEST(Partition, CutsAtAWholeNumberOfLeaves) {
  EXPECT_EQ(bisection_cut(100, 8), 56u);  // 13 leaves: 7 to the left
  EXPECT_EQ(bisection_cut(16, 8), 8u);
  EXPECT_EQ(bisection_cut(9, 8), 8u);
  EXPECT_EQ(bisection_cut(8, 8), 8u);  // a leaf
  EXPECT_EQ(bisection_cut(0xFFFFFFFFu, 1), 0x80000000u);
}

TEST(Partition, NoPointsGiveAnEmptyOrder) { EXPECT_TRUE(bisection_order({}, 4).empty()); }

}  // namespace
}  // namespace tensormass::mesh
