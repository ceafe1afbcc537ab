#include "mesh/conformity.h"

#include <cmath>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

std::string refusal(const Mesh& mesh) {
  const Result<MeshReport> report = admit(mesh, "liver");
  return report ? std::string() : report.error().message;
}

void expect_nonconforming(const Mesh& mesh, std::initializer_list<std::string_view> parts) {
  const std::string message = refusal(mesh);
  for (const std::string_view part : parts) {
    EXPECT_NE(message.find(part), std::string::npos) << "'" << part << "' is not in: " << message;
  }
  EXPECT_NE(message.find("put a pyramid between"), std::string::npos) << message;
}

/// Returns a hexahedron on [0, 1]³ with node 8 above its top face 4 5 6 7.
Mesh hexahedron_and_apex() {
  Mesh mesh = tests::reference_element(Shape::kHexahedron);
  mesh.nodes.push_back({0.5, 0.5, 2.0});
  return mesh;
}

TEST(Conformity, AdmitsAMixedMesh) {
  const Mesh mixed = tests::mixed_mesh();
  const MeshReport report = admit(mixed, "liver").value();
  EXPECT_NEAR(report.volume_m3, 4 * 2 * 3 * std::pow(0.5, 3), 1e-12);
  EXPECT_EQ(report.component_count, 1u);
  for (const ElementBlock& block : mixed.blocks) EXPECT_GE(element_count(block), 8u) << topology(block.shape).name;
  EXPECT_EQ(refusal(tests::mixed_mesh(0.2)), "");
  Mesh mesh = hexahedron_and_apex();
  mesh.blocks.push_back({Shape::kPyramid, {4, 5, 6, 7, 8}});
  EXPECT_EQ(refusal(mesh), "");
}

TEST(Conformity, RefusesTrianglesOnAQuadrilateral) {
  Mesh mesh = hexahedron_and_apex();
  mesh.blocks.push_back({Shape::kTetrahedron, {4, 5, 6, 8, 4, 6, 7, 8}});
  expect_nonconforming(mesh, {"element 0 (hexahedron, face 4 5 6 7)", "element 1 (tetrahedron, face 4 6 5)", "'liver'",
                              "(2 of this kind)"});
  mesh.blocks.back().nodes = {5, 6, 7, 8, 5, 7, 4, 8};  // the other diagonal
  expect_nonconforming(mesh, {"(2 of this kind)"});
}

TEST(Conformity, RefusesQuadrilateralsThatShareThreeCorners) {
  Mesh mesh = hexahedron_and_apex();
  for (const double x : {0.0, 1.0}) {
    for (const double y : {0.0, 1.0}) mesh.nodes.push_back({x, y, 3.0});
  }
  mesh.nodes[8] = {0.9, 0.9, 1.0};
  mesh.blocks.push_back({Shape::kHexahedron, {4, 5, 8, 7, 9, 11, 12, 10}});
  expect_nonconforming(mesh, {"face 4 5 6 7", "face 4 7 8 5"});
}

/// Returns a quadratic tetrahedron above the triangle 0 1 2, and a node below it that belongs to no element yet.
Mesh quadratic_and_linear() {
  Mesh mesh = tests::reference_element(Shape::kQuadraticTetrahedron);
  mesh.nodes.push_back({0.2, 0.2, -1.0});
  return mesh;
}

TEST(Conformity, RefusesALinearFaceOnAQuadraticOne) {
  Mesh mesh = quadratic_and_linear();
  mesh.blocks.push_back({Shape::kTetrahedron, {0, 2, 1, 10}});
  expect_nonconforming(mesh, {"quadratic tetrahedron, face 0 2 1 6 5 4", "tetrahedron, face 0 1 2"});
}

TEST(Conformity, RefusesLinearFacesOnPartsOfAQuadraticOne) {
  Mesh mesh = quadratic_and_linear();
  mesh.blocks.push_back({Shape::kTetrahedron, {0, 6, 4, 10}});
  expect_nonconforming(mesh, {"quadratic tetrahedron, face 0 2 1 6 5 4", "tetrahedron, face 0 4 6"});
  mesh.blocks.back().nodes = {6, 5, 4, 10};
  expect_nonconforming(mesh, {"tetrahedron, face 6 4 5"});
}

/// A linear face on all of an eight-node face, on a half of it, and on a quarter.
TEST(Conformity, RefusesLinearFacesOnAQuadraticQuadrilateral) {
  Mesh mesh = tests::reference_element(Shape::kQuadraticHexahedron);
  mesh.nodes.push_back({0.5, 0.5, -1.0});
  mesh.blocks.push_back({Shape::kPyramid, {3, 2, 1, 0, 20}});
  expect_nonconforming(mesh, {"quadratic hexahedron, face 0 3 2 1 11 10 9 8", "pyramid, face 3 0 1 2"});
  mesh.blocks.back() = {Shape::kTetrahedron, {1, 3, 2, 20}};
  expect_nonconforming(mesh, {"quadratic hexahedron, face 0 3 2 1 11 10 9 8", "tetrahedron, face 1 2 3"});
  mesh.nodes.push_back({0.5, 0.5, 0.0});
  mesh.blocks.back() = {Shape::kPyramid, {11, 21, 8, 0, 20}};
  expect_nonconforming(mesh, {"quadratic hexahedron, face 0 3 2 1 11 10 9 8", "pyramid, face 11 0 8 21"});
}

TEST(Conformity, RefusesQuadraticNeighboursWithMidEdgeNodesOfTheirOwn) {
  Mesh mesh = make_grid({0, 0, 0}, {1, 1, 1}, 1, 1, 1, Shape::kQuadraticTetrahedron).value();
  ASSERT_EQ(refusal(mesh), "");
  mesh.nodes.push_back(
      mesh.nodes[mesh.blocks[0].nodes[4 + 2]]);  // the middle of 0 2, which lies within the cell's side
  mesh.blocks[0].nodes[4 + 2] = static_cast<std::uint32_t>(mesh.nodes.size() - 1);
  expect_nonconforming(mesh, {"element 0 (quadratic tetrahedron", "same mid-edge nodes"});
}

TEST(Conformity, RefusesOverlappingElements) {
  Mesh mesh = tests::reference_element(Shape::kTetrahedron);
  mesh.nodes.push_back({0.2, 0.2, 0.5});
  mesh.blocks[0].nodes = {0, 1, 2, 3, 0, 1, 2, 4};
  EXPECT_NE(refusal(mesh).find("elements 0 and 1 of body 'liver' lie on the same side of their face (0, 2, 1)"),
            std::string::npos)
      << refusal(mesh);
  mesh.nodes.push_back({0.2, 0.2, -0.5});
  mesh.blocks[0].nodes.insert(mesh.blocks[0].nodes.end(), {0, 2, 1, 5});
  EXPECT_NE(refusal(mesh).find("belongs to 3 elements, among them 0, 1 and 2"), std::string::npos) << refusal(mesh);
}

class ConformityOfEveryMesh : public testing::EveryMesh {};

TEST_P(ConformityOfEveryMesh, FindsNothingInRandomMeshes) {
  EXPECT_EQ(refusal(testing::random_mesh(seed_, 3, 0.6, shape_)), "");
}

TEST_P(ConformityOfEveryMesh, MatchesFacesInAnyNodeOrder) {
  // Rotates the local numbering of each of the grid's elements a random number of times.
  Mesh mesh = testing::unit_grid(2, shape_);
  const std::vector<std::uint32_t> turned = testing::turned(shape_);
  auto& nodes = mesh.blocks[0].nodes;
  std::mt19937 random(seed_);
  for (std::size_t first = 0; first < nodes.size(); first += turned.size()) {
    for (std::uint32_t times = random() % 4; times > 0; --times) {
      const std::vector<std::uint32_t> old(nodes.begin() + static_cast<long>(first),
                                           nodes.begin() + static_cast<long>(first + turned.size()));
      for (std::size_t i = 0; i < turned.size(); ++i) nodes[first + i] = old[turned[i]];
    }
  }
  EXPECT_EQ(refusal(mesh), "");
}

TENSORMASS_EVERY_MESH(ConformityOfEveryMesh);

}  // namespace
}  // namespace tensormass::mesh
