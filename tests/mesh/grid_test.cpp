#include "mesh/grid.h"

#include <limits>
#include <map>
#include <set>
#include <tuple>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "mesh/shapes.h"
#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

TEST(Grid, NodesRunXFastest) {
  const Mesh mesh = make_grid({1.0, 2.0, 3.0}, {4.0, 6.0, 8.0}, 2, 3, 4).value();
  ASSERT_EQ(mesh.nodes.size(), 3u * 4u * 5u);
  EXPECT_EQ(mesh.nodes[1 + 3 * (2 + 4 * 3)], Eigen::Vector3d(3.0, 6.0, 9.0));
  EXPECT_EQ(mesh.nodes.back(), Eigen::Vector3d(5.0, 8.0, 11.0));
}

class GridOf : public ::testing::TestWithParam<Shape> {
 protected:
  const Topology& shape_ = topology(GetParam());
  const Mesh mesh_ = make_grid({0.0, 0.0, 0.0}, {4.0, 6.0, 8.0}, 2, 3, 4, GetParam()).value();
};

TEST_P(GridOf, ElementsFillTheBoxAndArePositivelyWound) {
  static const std::map<Shape, std::uint32_t> kElementsOfACell{{Shape::kTetrahedron, 6},
                                                               {Shape::kPyramid, 6},
                                                               {Shape::kWedge, 2},
                                                               {Shape::kHexahedron, 1},
                                                               {Shape::kQuadraticTetrahedron, 6},
                                                               {Shape::kQuadraticHexahedron, 1}};
  ASSERT_EQ(mesh_.blocks.size(), 1u);
  EXPECT_EQ(mesh_.blocks[0].shape, GetParam());
  EXPECT_EQ(element_count(mesh_), kElementsOfACell.at(GetParam()) * 2u * 3u * 4u);
  const Result<MeshReport> report = admit(mesh_, "box");
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_NEAR(report->volume_m3, 4.0 * 6.0 * 8.0, 1e-12);
  EXPECT_EQ(report->component_count, 1u);
}

TEST_P(GridOf, CornersAreNumberedAlikeForEveryShape) {
  const Mesh tetrahedra = make_grid({0.0, 0.0, 0.0}, {4.0, 6.0, 8.0}, 2, 3, 4).value();
  ASSERT_GE(mesh_.nodes.size(), tetrahedra.nodes.size());
  EXPECT_TRUE(std::equal(tetrahedra.nodes.begin(), tetrahedra.nodes.end(), mesh_.nodes.begin()));
  std::set<std::array<double, 3>> places;
  for (const Eigen::Vector3d& node : mesh_.nodes) places.insert({node.z(), node.y(), node.x()});
  EXPECT_EQ(places.size(), mesh_.nodes.size());
  // The remaining nodes follow, x fastest.
  EXPECT_TRUE(std::is_sorted(
      mesh_.nodes.begin() + static_cast<long>(tetrahedra.nodes.size()), mesh_.nodes.end(),
      [](const auto& a, const auto& b) { return std::tuple(a.z(), a.y(), a.x()) < std::tuple(b.z(), b.y(), b.x()); }));
}

TEST_P(GridOf, FacesConformAcrossCells) {
  std::map<std::set<std::uint32_t>, int> uses;
  for_each_element(mesh_, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Face& face : shape.faces) {
      std::set<std::uint32_t> key;
      for (int i = 0; i < face.node_count; ++i) key.insert(nodes[face.nodes[i]]);
      ++uses[key];
    }
  });
  int outside = 0;
  for (const auto& [key, count] : uses) {
    ASSERT_LE(count, 2);
    if (count == 2) continue;
    ++outside;  // a face of one element must lie in a side of the box
    bool in_side = false;
    for (int axis = 0; axis < 3; ++axis) {
      for (const double side : {0.0, mesh_.nodes[2 + 3 * (3 + 4 * 4)][axis]}) {
        in_side |= std::all_of(key.begin(), key.end(), [&](auto node) { return mesh_.nodes[node][axis] == side; });
      }
    }
    EXPECT_TRUE(in_side);
  }
  const int sides_xy = 2 * 2 * 3, sides_z = 2 * 4 * (2 + 3);
  static const std::map<Shape, std::pair<int, int>> kFacesOfASide{{Shape::kTetrahedron, {2, 2}},
                                                                  {Shape::kPyramid, {1, 1}},
                                                                  {Shape::kWedge, {2, 1}},
                                                                  {Shape::kHexahedron, {1, 1}},
                                                                  {Shape::kQuadraticTetrahedron, {2, 2}},
                                                                  {Shape::kQuadraticHexahedron, {1, 1}}};
  const auto [across_z, along_z] = kFacesOfASide.at(GetParam());
  EXPECT_EQ(outside, across_z * sides_xy + along_z * sides_z);
}

TEST_P(GridOf, MidEdgeNodesAreInTheMiddle) {
  for_each_element(mesh_, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (std::uint32_t i = shape.corner_count; i < shape.node_count; ++i) {
      const auto [a, b] = shape.edges[i - shape.corner_count].nodes;
      EXPECT_EQ(mesh_.nodes[nodes[i]], 0.5 * (mesh_.nodes[nodes[a]] + mesh_.nodes[nodes[b]]));
    }
  });
}

INSTANTIATE_TEST_SUITE_P(Shapes, GridOf, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST(Grid, RefusesInvalidBoxes) {
  const Eigen::Vector3d zero = Eigen::Vector3d::Zero(), one = Eigen::Vector3d::Ones();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto message = [](const Result<Mesh>& mesh) { return mesh ? std::string("accepted") : mesh.error().message; };
  EXPECT_NE(message(make_grid(zero, one, 1, 0, 1)).find("cells_y is 0"), std::string::npos);
  EXPECT_NE(message(make_grid(zero, {1.0, 1.0, -1.0}, 1, 1, 1)).find("size_m.z is -1"), std::string::npos);
  EXPECT_NE(message(make_grid(zero, {nan, 1.0, 1.0}, 1, 1, 1)).find("size_m.x"), std::string::npos);
  EXPECT_NE(message(make_grid({0.0, nan, 0.0}, one, 1, 1, 1)).find("origin_m.y"), std::string::npos);
  const Result<Mesh> huge = make_grid(zero, one, 0xFFFFFFFFu, 0xFFFFFFFFu, 0xFFFFFFFFu);
  EXPECT_NE(message(huge).find("kMaxNodes"), std::string::npos);
  EXPECT_EQ(huge.error().code, ErrorCode::kResourceExhausted);
  // This grid is within the limits as linear tetrahedra, but not with mid-edge nodes.
  const Result<Mesh> fine = make_grid(zero, one, 204, 204, 204, Shape::kQuadraticTetrahedron);
  EXPECT_NE(message(fine).find("68417929 nodes"), std::string::npos) << message(fine);
  // Hexahedra have no nodes in the centres of faces and cells.
  const Result<Mesh> hexahedra = make_grid(zero, one, 260, 260, 260, Shape::kQuadraticHexahedron);
  EXPECT_NE(message(hexahedra).find("70913961 nodes"), std::string::npos) << message(hexahedra);
}

}  // namespace
}  // namespace tensormass::mesh
