#include "mesh/shapes.h"

#include <algorithm>
#include <map>
#include <set>

#include <gtest/gtest.h>

#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

const std::map<Shape, double> kReferenceVolume{{Shape::kTetrahedron, 1.0 / 6.0},
                                               {Shape::kPyramid, 4.0 / 3.0},
                                               {Shape::kWedge, 0.5},
                                               {Shape::kHexahedron, 1.0},
                                               {Shape::kQuadraticTetrahedron, 1.0 / 6.0},
                                               {Shape::kQuadraticHexahedron, 1.0}};

class EveryShape : public ::testing::TestWithParam<Shape> {
 protected:
  const Topology& shape_ = topology(GetParam());
  const std::vector<Eigen::Vector3d> nodes_ = tests::reference_element(GetParam()).nodes;
};

TEST_P(EveryShape, SimplicesFillTheElement) {
  double volume = 0.0;
  for (const Simplex& s : shape_.simplices) {
    const double six = six_volumes(nodes_[s[0]], nodes_[s[1]], nodes_[s[2]], nodes_[s[3]]);
    EXPECT_GT(six, 0.0);
    volume += six / 6.0;
  }
  EXPECT_NEAR(volume, kReferenceVolume.at(GetParam()), 1e-15);
}

TEST_P(EveryShape, SimplicesMeetInWholeTriangles) {
  std::map<std::set<int>, int> uses;
  for (const Simplex& s : shape_.simplices) {
    for (int left_out = 0; left_out < 4; ++left_out) {
      std::set<int> triangle(s.begin(), s.end());
      triangle.erase(s[left_out]);
      ++uses[triangle];
    }
  }
  std::size_t outside = 0, expected = 0;
  for (const auto& [triangle, count] : uses) {
    EXPECT_LE(count, 2);
    outside += count == 1;
  }
  for (const Face& face : shape_.faces) expected += face.node_count - 2;
  EXPECT_EQ(outside, expected);
}

TEST_P(EveryShape, FacesCloseAndPointOutward) {
  Eigen::Vector3d center = Eigen::Vector3d::Zero();
  for (const Eigen::Vector3d& node : nodes_) center += node / static_cast<double>(nodes_.size());
  std::map<std::pair<int, int>, int> directed;
  for (const Face& face : shape_.faces) {
    const int corners = face.corner_count();
    for (int i = 0; i < corners; ++i) ++directed[{face.nodes[i], face.nodes[(i + 1) % corners]}];
    const Eigen::Vector3d& x0 = nodes_[face.nodes[0]];
    const Eigen::Vector3d normal = (nodes_[face.nodes[1]] - x0).cross(nodes_[face.nodes[2]] - x0);
    EXPECT_GT(normal.dot(x0 - center), 0.0);
  }
  for (const auto& [edge, count] : directed) {
    EXPECT_EQ(count, 1);
    EXPECT_EQ(directed.count({edge.second, edge.first}), 1u);
  }
}

TEST_P(EveryShape, EdgesAreThoseOfTheFaces) {
  std::map<std::set<int>, std::set<int>> faces_of_edge;
  for (std::size_t f = 0; f < shape_.faces.size(); ++f) {
    const Face& face = shape_.faces[f];
    const int corners = face.corner_count();
    for (int i = 0; i < corners; ++i) {
      faces_of_edge[{face.nodes[i], face.nodes[(i + 1) % corners]}].insert(static_cast<int>(f));
    }
  }
  EXPECT_EQ(shape_.edges.size(), faces_of_edge.size());
  for (const Edge& edge : shape_.edges) {
    const std::set<int> faces{edge.faces[0], edge.faces[1]};
    EXPECT_EQ((faces_of_edge[{edge.nodes[0], edge.nodes[1]}]), faces);
  }
}

TEST_P(EveryShape, CornerFramesAreTheEdgesOfACorner) {
  std::map<int, std::set<int>> neighbours;
  for (const Edge& edge : shape_.edges) {
    neighbours[edge.nodes[0]].insert(edge.nodes[1]);
    neighbours[edge.nodes[1]].insert(edge.nodes[0]);
  }
  std::set<int> corners;
  for (const Simplex& s : shape_.corner_frames) {
    corners.insert(s[0]);
    EXPECT_EQ(neighbours[s[0]], (std::set<int>{s[1], s[2], s[3]}));
    EXPECT_GT(six_volumes(nodes_[s[0]], nodes_[s[1]], nodes_[s[2]], nodes_[s[3]]), 0.0);
  }
  EXPECT_EQ(corners.size(), shape_.corner_frames.size());
}

TEST_P(EveryShape, MidEdgeNodesFollowTheEdges) {
  ASSERT_EQ(shape_.node_count, shape_.corner_count + (shape_.has_mid_edge_nodes() ? shape_.edges.size() : 0));
  for (const Face& face : shape_.faces) {
    EXPECT_EQ(face.node_count, face.corner_count() * (shape_.has_mid_edge_nodes() ? 2 : 1));
    if (!shape_.has_mid_edge_nodes()) continue;
    for (int i = 0; i < face.corner_count(); ++i) {
      const std::uint8_t a = face.nodes[i], b = face.nodes[(i + 1) % face.corner_count()];
      const auto edge = std::find_if(shape_.edges.begin(), shape_.edges.end(), [&](const Edge& e) {
        return std::minmax(e.nodes[0], e.nodes[1]) == std::minmax(a, b);
      });
      EXPECT_EQ(face.nodes[face.corner_count() + i], shape_.corner_count + (edge - shape_.edges.begin()));
    }
  }
}

INSTANTIATE_TEST_SUITE_P(Shapes, EveryShape, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST(QuadraticHexahedron, HasItsMidEdgeNodesInVtkOrder) {
  const std::vector<std::array<std::uint8_t, 2>> vtk{{0, 1}, {1, 2}, {2, 3}, {3, 0}, {4, 5}, {5, 6},
                                                     {6, 7}, {7, 4}, {0, 4}, {1, 5}, {2, 6}, {3, 7}};
  const auto edges = topology(Shape::kQuadraticHexahedron).edges;
  for (std::size_t i = 0; i < vtk.size(); ++i) EXPECT_EQ(edges[i].nodes, vtk[i]);
}

TEST(QuadraticTetrahedron, HasItsMidEdgeNodesInVtkOrder) {
  const std::vector<std::array<std::uint8_t, 2>> vtk{{0, 1}, {1, 2}, {0, 2}, {0, 3}, {1, 3}, {2, 3}};
  const auto edges = topology(Shape::kQuadraticTetrahedron).edges;
  for (std::size_t i = 0; i < vtk.size(); ++i) EXPECT_EQ(edges[i].nodes, vtk[i]);
}

}  // namespace
}  // namespace tensormass::mesh
