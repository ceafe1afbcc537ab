#include "mesh/elevate.h"

#include <map>
#include <set>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

ElevatedMesh elevated(const Mesh& mesh) {
  Result<ElevatedMesh> result = elevate(mesh, "here");
  if (!result) throw std::runtime_error(result.error().message);
  return std::move(*result);
}

/// All edges of a mesh, found by brute force.
std::set<EdgeEnds> edges_of(const Mesh& mesh) {
  std::set<EdgeEnds> edges;
  for_each_element(mesh, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Edge& edge : shape.edges) {
      const std::uint32_t a = nodes[edge.nodes[0]], b = nodes[edge.nodes[1]];
      edges.insert({std::min(a, b), std::max(a, b)});
    }
  });
  return edges;
}

class ElevatedRandomMesh : public ::testing::TestWithParam<std::uint32_t> {
 protected:
  const Mesh linear_ = testing::random_mesh(GetParam(), 3, 0.6);
  const ElevatedMesh elevated_ = elevated(linear_);
  const Mesh& quadratic_ = elevated_.mesh;
};

TEST_P(ElevatedRandomMesh, HasOneNodeInTheMiddleOfEachEdgeInTheOrderOfItsEnds) {
  const std::set<EdgeEnds> edges = edges_of(linear_);  // ordered by the lower end, then by the higher
  EXPECT_EQ(elevated_.middle_of, std::vector<EdgeEnds>(edges.begin(), edges.end()));
  ASSERT_EQ(quadratic_.nodes.size(), linear_.nodes.size() + edges.size());
  EXPECT_TRUE(std::equal(linear_.nodes.begin(), linear_.nodes.end(), quadratic_.nodes.begin()));
  std::size_t node = linear_.nodes.size();
  for (const auto& [a, b] : edges) {
    EXPECT_EQ(quadratic_.nodes[node++], 0.5 * (linear_.nodes[a] + linear_.nodes[b]));
  }
}

TEST_P(ElevatedRandomMesh, KeepsElementsAndCornersInTheirOrder) {
  ASSERT_EQ(quadratic_.blocks.size(), 1u);
  EXPECT_EQ(quadratic_.blocks[0].shape, Shape::kQuadraticTetrahedron);
  ASSERT_EQ(element_count(quadratic_), element_count(linear_));
  const auto corners_of = element_nodes(linear_), nodes_of = element_nodes(quadratic_);
  const Topology& shape = topology(Shape::kQuadraticTetrahedron);
  for (std::size_t e = 0; e < nodes_of.size(); ++e) {
    EXPECT_TRUE(std::equal(corners_of[e].begin(), corners_of[e].end(), nodes_of[e].begin()));
    for (std::size_t i = 0; i < shape.edges.size(); ++i) {
      const std::uint32_t a = nodes_of[e][shape.edges[i].nodes[0]], b = nodes_of[e][shape.edges[i].nodes[1]];
      const EdgeEnds edge = elevated_.middle_of[nodes_of[e][4 + i] - linear_.nodes.size()];
      EXPECT_EQ(edge, (EdgeEnds{std::min(a, b), std::max(a, b)}));
    }
  }
}

TEST_P(ElevatedRandomMesh, IsAdmittedWithTheSameVolumeAndAngles) {
  const auto before = admit(linear_, "body"), after = admit(quadratic_, "body");
  ASSERT_TRUE(before);
  ASSERT_TRUE(after) << after.error().message;
  EXPECT_NEAR(after->volume_m3, before->volume_m3, 1e-14);
  EXPECT_EQ(after->component_count, before->component_count);
  EXPECT_EQ(after->min_dihedral_angle_deg, before->min_dihedral_angle_deg);
}

INSTANTIATE_TEST_SUITE_P(Seeds, ElevatedRandomMesh, ::testing::Range(0u, 4u));

/// Numbers the middles in another order than make_grid does, but makes the same elements.
TEST(Elevate, AGridOfTetrahedraIsTheGridOfQuadraticOnes) {
  const Mesh quadratic = testing::unit_grid(4, Shape::kQuadraticTetrahedron);  // quarters are exact
  const Mesh mine = elevated(testing::unit_grid(4)).mesh;
  ASSERT_EQ(mine.nodes.size(), quadratic.nodes.size());
  ASSERT_EQ(element_count(mine), element_count(quadratic));
  const auto mine_of = element_nodes(mine), theirs_of = element_nodes(quadratic);
  for (std::size_t e = 0; e < mine_of.size(); ++e) {
    for (std::size_t k = 0; k < 10; ++k) EXPECT_EQ(mine.nodes[mine_of[e][k]], quadratic.nodes[theirs_of[e][k]]);
  }
}

TEST(Elevate, QuadraticTetrahedraStayAsTheyAre) {
  const Mesh quadratic = testing::random_mesh(1, 2, 0.5, Shape::kQuadraticTetrahedron);
  const ElevatedMesh result = elevated(quadratic);
  EXPECT_TRUE(result.middle_of.empty());
  EXPECT_EQ(result.mesh.nodes, quadratic.nodes);
  EXPECT_EQ(result.mesh.blocks[0].nodes, quadratic.blocks[0].nodes);
}

/// A linear tetrahedron meets a quadratic one, whose edges are bent, at the edge between nodes 0 and 1.
TEST(Elevate, ALinearTetrahedronTakesTheMidEdgeNodeOfAQuadraticOne) {
  Mesh mesh = tests::reference_element(Shape::kQuadraticTetrahedron);
  mesh.nodes[4] += Eigen::Vector3d(0, 0.05, 0.05);
  mesh.nodes.insert(mesh.nodes.end(), {{0, -1, 0}, {0, 0, -1}});  // 10, 11
  mesh.blocks.push_back({Shape::kTetrahedron, {1, 0, 11, 10}});
  ASSERT_TRUE(admit(mesh, "body")) << admit(mesh, "body").error().message;
  const ElevatedMesh result = elevated(mesh);
  EXPECT_EQ(result.middle_of, (std::vector<EdgeEnds>{{0, 10}, {0, 11}, {1, 10}, {1, 11}, {10, 11}}));
  EXPECT_EQ(result.mesh.blocks[0].nodes, mesh.blocks[0].nodes);
  EXPECT_EQ(result.mesh.blocks[1].nodes, (std::vector<std::uint32_t>{1, 0, 11, 10, 4, 13, 15, 14, 12, 16}));
  EXPECT_TRUE(admit(result.mesh, "body")) << admit(result.mesh, "body").error().message;
}

TEST(Elevate, RefusesOtherShapes) {
  const Mesh mesh = tests::mixed_mesh();
  const Result<ElevatedMesh> result = elevate(mesh, "body 'liver'.element_order");
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::kInvalidArgument);
  const std::uint32_t tetrahedra = element_count(mesh.blocks[0]), others = element_count(mesh) - tetrahedra;
  for (const std::string& part :
       {std::string("body 'liver'.element_order: element ") + std::to_string(tetrahedra) + " is of shape pyramid",
        std::to_string(others) + " of this kind", std::string("mesh the body with tetrahedra")}) {
    EXPECT_NE(result.error().message.find(part), std::string::npos) << part << " in " << result.error().message;
  }
}

TEST(Elevate, RefusesMoreNodesThanTheLimit) {
  const Mesh mesh = tests::reference_element(Shape::kTetrahedron);
  EXPECT_TRUE(elevate(mesh, "here", 10));
  const Result<ElevatedMesh> result = elevate(mesh, "here", 9);
  ASSERT_FALSE(result);
  EXPECT_EQ(result.error().code, ErrorCode::kResourceExhausted);
  EXPECT_NE(result.error().message.find("here: the mesh has 4 nodes and 6 edges, so 10 nodes"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::mesh
