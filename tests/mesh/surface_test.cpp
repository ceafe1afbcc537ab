#include "mesh/surface.h"

#include <map>
#include <set>

#include <gtest/gtest.h>

#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

class Boundary : public ::testing::TestWithParam<std::uint32_t> {
 protected:
  const Mesh mesh_ = testing::random_mesh(GetParam(), 3, 0.5);
  const Surface surface_ = boundary(mesh_);

  Triangle mesh_triangle(std::uint32_t i) const {
    const Triangle& t = surface_.triangles[i];
    return {surface_.nodes[t[0]], surface_.nodes[t[1]], surface_.nodes[t[2]]};
  }
};

TEST_P(Boundary, IsEveryFaceOfExactlyOneElement) {
  // Brute force: faces in the order of elements, kept if no other element has the same three nodes.
  std::vector<std::pair<Triangle, std::uint32_t>> faces;
  for_each_element(mesh_, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Face& face : shape.faces) {
      faces.push_back({{nodes[face.nodes[0]], nodes[face.nodes[1]], nodes[face.nodes[2]]}, element});
    }
  });
  const auto key = [](Triangle triangle) { return std::set<std::uint32_t>(triangle.begin(), triangle.end()); };
  std::map<std::set<std::uint32_t>, int> uses;
  for (const auto& [triangle, element] : faces) ++uses[key(triangle)];
  std::erase_if(faces, [&](const auto& face) { return uses[key(face.first)] != 1; });

  ASSERT_EQ(surface_.triangles.size(), faces.size());
  for (std::uint32_t i = 0; i < faces.size(); ++i) {
    EXPECT_EQ(mesh_triangle(i), faces[i].first);
    EXPECT_EQ(surface_.triangle_elements[i], faces[i].second);
  }
}

TEST_P(Boundary, EnclosesTheVolumeFromOutside) {
  double enclosed_m3 = 0.0;  // divergence theorem; negative if the winding were inward
  for (std::uint32_t i = 0; i < surface_.triangles.size(); ++i) {
    const Triangle t = mesh_triangle(i);
    enclosed_m3 += mesh_.nodes[t[0]].dot(mesh_.nodes[t[1]].cross(mesh_.nodes[t[2]])) / 6.0;
  }
  EXPECT_NEAR(enclosed_m3, testing::volume_m3(mesh_), 1e-13);
}

TEST_P(Boundary, VerticesAreCompactAndAscending) {
  std::set<std::uint32_t> used;
  for (const Triangle& triangle : surface_.triangles) used.insert(triangle.begin(), triangle.end());
  EXPECT_EQ(used.size(), surface_.nodes.size());
  EXPECT_EQ(*used.rbegin(), surface_.nodes.size() - 1);
  EXPECT_TRUE(std::is_sorted(surface_.nodes.begin(), surface_.nodes.end()));
}

TEST_P(Boundary, NeighboursAreTheOtherTrianglesOfTheEdges) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, std::vector<std::uint32_t>> of_edge;  // directed
  for (std::uint32_t i = 0; i < surface_.triangles.size(); ++i) {
    for (int side = 0; side < 3; ++side) {
      of_edge[{surface_.triangles[i][side], surface_.triangles[i][(side + 1) % 3]}].push_back(i);
    }
  }
  for (std::uint32_t i = 0; i < surface_.triangles.size(); ++i) {
    for (int side = 0; side < 3; ++side) {
      const std::uint32_t a = surface_.triangles[i][side], b = surface_.triangles[i][(side + 1) % 3];
      const auto& across = of_edge[{b, a}];
      const bool manifold = across.size() == 1 && of_edge[{a, b}].size() == 1;
      EXPECT_EQ(surface_.neighbours[i][side], manifold ? across[0] : kNone);
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Seeds, Boundary, ::testing::Range(0u, 5u));

TEST(BoundaryOfGrid, IsAClosedBox) {
  const Surface surface = boundary(testing::unit_grid(4));
  EXPECT_EQ(surface.triangles.size(), 6u * 16u * 2u);
  EXPECT_EQ(surface.nodes.size(), 125u - 27u);
  for (const auto& sides : surface.neighbours) {
    for (const std::uint32_t neighbour : sides) EXPECT_NE(neighbour, kNone);
  }
}

TEST(BoundaryOfTwoTetrahedra, SharingAnEdgeIsToleratedAsNonManifold) {
  Mesh mesh;
  mesh.nodes = {{0, 0, 0}, {0, 0, 1}, {1, 0, 0}, {0, 1, 0}, {-1, 0, 0}, {0, -1, 0}};
  mesh.blocks.push_back({Shape::kTetrahedron, {0, 2, 3, 1, 0, 4, 5, 1}});
  const Surface surface = boundary(mesh);
  EXPECT_EQ(surface.triangles.size(), 8u);
  int open = 0;
  for (const auto& sides : surface.neighbours) open += static_cast<int>(std::count(sides.begin(), sides.end(), kNone));
  EXPECT_EQ(open, 4);
}

}  // namespace
}  // namespace tensormass::mesh
