#include "mesh/adjacency.h"

#include <set>

#include <gtest/gtest.h>

#include "mesh/surface.h"
#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

class Adjacency : public testing::EveryMesh {
 protected:
  const Mesh mesh_ = testing::random_mesh(seed_, 3, 0.6, shape_);
};

std::vector<std::uint32_t> row(const Rows& rows, std::uint32_t i) { return {rows[i].begin(), rows[i].end()}; }

TEST_P(Adjacency, AgreesWithBruteForce) {
  std::vector<std::set<std::uint32_t>> elements(mesh_.nodes.size()), neighbours(mesh_.nodes.size());
  for_each_element(mesh_, [&](std::uint32_t element, const Topology&, std::span<const std::uint32_t> nodes) {
    for (const std::uint32_t a : nodes) {
      elements[a].insert(element);
      for (const std::uint32_t b : nodes) {
        if (a != b) neighbours[a].insert(b);
      }
    }
  });
  const Rows of_elements = node_elements(mesh_);
  const Rows of_neighbours = node_neighbours(mesh_);
  ASSERT_EQ(of_elements.size(), mesh_.nodes.size());
  ASSERT_EQ(of_neighbours.size(), mesh_.nodes.size());
  for (std::uint32_t node = 0; node < mesh_.nodes.size(); ++node) {
    EXPECT_EQ(row(of_elements, node), std::vector<std::uint32_t>(elements[node].begin(), elements[node].end()));
    EXPECT_EQ(row(of_neighbours, node), std::vector<std::uint32_t>(neighbours[node].begin(), neighbours[node].end()));
  }
}

TEST_P(Adjacency, TrianglesOfVerticesAgreeWithBruteForce) {
  const Surface surface = boundary(mesh_);
  const auto vertex_count = static_cast<std::uint32_t>(surface.nodes.size());
  const Rows rows = vertex_triangles(surface.triangles, vertex_count);
  ASSERT_EQ(rows.size(), vertex_count);
  for (std::uint32_t vertex = 0; vertex < vertex_count; ++vertex) {
    std::vector<std::uint32_t> expected;
    for (std::uint32_t i = 0; i < surface.triangles.size(); ++i) {
      const Triangle& triangle = surface.triangles[i];
      if (std::find(triangle.begin(), triangle.end(), vertex) != triangle.end()) expected.push_back(i);
    }
    EXPECT_EQ(row(rows, vertex), expected);
  }
}

TENSORMASS_EVERY_MESH(Adjacency);

}  // namespace
}  // namespace tensormass::mesh
