#include "mesh/shapes.h"

#include <algorithm>
#include <map>
#include <set>

#include <gtest/gtest.h>

namespace tensormass::mesh {
namespace {

// Corners of each shape's reference element, in the order of `Shape`.
const std::vector<std::vector<Eigen::Vector3d>> kReference{
    {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}},
};
const std::vector<double> kReferenceVolume{1.0 / 6.0};

class EveryShape : public ::testing::TestWithParam<std::size_t> {
 protected:
  const Topology& shape() const { return kShapes[GetParam()]; }
  const std::vector<Eigen::Vector3d>& corners() const { return kReference[GetParam()]; }
};

TEST_P(EveryShape, SimplicesFillTheElement) {
  double volume = 0.0;
  for (const Simplex& s : shape().simplices) {
    const double six = six_volumes(corners()[s[0]], corners()[s[1]], corners()[s[2]], corners()[s[3]]);
    EXPECT_GT(six, 0.0);
    volume += six / 6.0;
  }
  EXPECT_NEAR(volume, kReferenceVolume[GetParam()], 1e-15);
}

TEST_P(EveryShape, FacesCloseAndLookOutward) {
  Eigen::Vector3d center = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& corner : corners()) center += corner / static_cast<double>(corners().size());
  std::map<std::pair<int, int>, int> directed;
  for (const Face& face : shape().faces) {
    for (int i = 0; i < face.node_count; ++i) ++directed[{face.nodes[i], face.nodes[(i + 1) % face.node_count]}];
    const Eigen::Vector3d& x0 = corners()[face.nodes[0]];
    const Eigen::Vector3d normal = (corners()[face.nodes[1]] - x0).cross(corners()[face.nodes[2]] - x0);
    EXPECT_GT(normal.dot(x0 - center), 0.0);
  }
  for (const auto& [edge, count] : directed) {
    EXPECT_EQ(count, 1);
    EXPECT_EQ(directed.count({edge.second, edge.first}), 1u);
  }
}

TEST_P(EveryShape, EdgesAreThoseOfTheFaces) {
  std::map<std::set<int>, std::set<int>> faces_of_edge;
  for (std::size_t f = 0; f < shape().faces.size(); ++f) {
    const Face& face = shape().faces[f];
    for (int i = 0; i < face.node_count; ++i) {
      faces_of_edge[{face.nodes[i], face.nodes[(i + 1) % face.node_count]}].insert(static_cast<int>(f));
    }
  }
  EXPECT_EQ(shape().edges.size(), faces_of_edge.size());
  for (const Edge& edge : shape().edges) {
    const std::set<int> faces{edge.faces[0], edge.faces[1]};
    EXPECT_EQ((faces_of_edge[{edge.nodes[0], edge.nodes[1]}]), faces);
  }
}

INSTANTIATE_TEST_SUITE_P(Shapes, EveryShape, ::testing::Range(std::size_t{0}, kShapes.size()),
                         [](const auto& shape) { return std::string(kShapes[shape.param].name); });

}  // namespace
}  // namespace tensormass::mesh
