#include "mesh/cut_parts.h"

#include <map>
#include <random>

#include <gtest/gtest.h>

#include "cut_reference.h"
#include "physics/element/hexahedron.h"
#include "physics/element/linear_tetrahedron.h"
#include "physics/element/pyramid.h"
#include "physics/element/wedge.h"
#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

/// An element alone, under a random affine map of its grid's cell.
struct Alone {
  const Topology& shape;
  std::vector<Vector3d> nodes;

  Alone(Shape of_shape, std::uint32_t seed) : shape(topology(of_shape)) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<double> uniform(-0.3, 0.3);
    const Eigen::Matrix3d map =
        Eigen::Matrix3d::Identity() + Eigen::Matrix3d::NullaryExpr([&] { return uniform(random); });
    const Mesh grid = testing::unit_grid(1, of_shape);
    for (std::uint32_t k = 0; k < shape.node_count; ++k) {
      nodes.push_back(map * grid.nodes[grid.blocks[0].nodes[k]] + Vector3d(5, -7, 3));
    }
  }

  testing::Polyhedron polyhedron() const {
    std::vector<testing::Polyhedron::Polygon> faces;
    for (const Face& face : shape.faces) {
      auto& polygon = faces.emplace_back();
      for (std::size_t i = 0; i < face.corner_count(); ++i) polygon.push_back(nodes[face.nodes[i]]);
    }
    return testing::Polyhedron(faces);
  }
};

ElementCut random_cut(const Topology& shape, std::uint32_t cut_edges, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(0.05, 0.95);
  ElementCut cut{.shape = &shape, .cut_edges = cut_edges, .crossings = {}};
  for (std::size_t i = 0; i < shape.edges.size(); ++i) {
    if (cut.is_cut(i)) cut.crossings[i] = uniform(random);
  }
  return cut;
}

/// Visits every set of cut edges of a shape, with random crossings.
template <class Visitor>
void for_each_cut(const Topology& shape, Visitor&& visit) {
  std::mt19937 random(1);
  for (std::uint32_t bits = 0; bits < 1u << shape.edges.size(); ++bits) visit(random_cut(shape, bits, random));
}

class PartsOf : public ::testing::TestWithParam<Shape> {
 protected:
  const Topology& shape_ = topology(GetParam());
};
INSTANTIATE_TEST_SUITE_P(Shapes, PartsOf, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST_P(PartsOf, AreCornersThatHangTogether) {
  for_each_cut(shape_, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    const std::vector<std::size_t> lowest = testing::reference_labels(shape_, cut.cut_edges);
    std::map<std::size_t, std::uint8_t> number;
    for (std::size_t corner = 0; corner < shape_.corner_count; ++corner) {
      const auto next = static_cast<std::uint8_t>(number.size());
      ASSERT_EQ(labels.part[corner], number.try_emplace(lowest[corner], next).first->second);
    }
    ASSERT_EQ(labels.count, number.size());
    std::uint32_t all = 0;
    for (std::uint8_t part = 0; part < labels.count; ++part) all += labels.corners(part);
    ASSERT_EQ(all, (1u << shape_.corner_count) - 1);
  });
}

TEST_P(PartsOf, HaveAllSharesTogether) {
  const Alone element(GetParam(), 3);
  for_each_cut(shape_, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    const auto shares = part_shares(cut, labels, element.nodes);
    double volume = 0.0;
    std::array<double, kMaxElementNodes> nodes{};
    for (std::size_t part = 0; part < labels.count; ++part) {
      ASSERT_GT(shares[part].volume, 1e-6);
      volume += shares[part].volume;
      for (std::size_t k = 0; k < shape_.node_count; ++k) {
        ASSERT_GT(shares[part].nodes[k], 0.0);
        nodes[k] += shares[part].nodes[k];
      }
    }
    ASSERT_NEAR(volume, 1.0, 1e-14);
    for (std::size_t k = 0; k < shape_.node_count; ++k) ASSERT_NEAR(nodes[k], 1.0, 1e-14);
  });
}

/// The surface of a part is closed, winds outward, and encloses the part's share.
TEST_P(PartsOf, EncloseTheirVolume) {
  const Alone element(GetParam(), 4);
  const double whole = element.polyhedron().integrals().first;
  for_each_cut(shape_, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    const auto shares = part_shares(cut, labels, element.nodes);
    std::array<double, kMaxElementParts> volume{};
    const auto add = [&](const CutTriangle& triangle) {
      std::array<Vector3d, 3> x;
      for (std::size_t i = 0; i < 3; ++i) {
        const auto weights = point_weights(cut, labels, triangle.points[i]);
        x[i].setZero();
        double sum = 0.0;
        for (std::size_t k = 0; k < shape_.node_count; ++k) {
          x[i] += weights[k] * element.nodes[k];
          sum += weights[k];
        }
        ASSERT_NEAR(sum, 1.0, 1e-14);
      }
      volume[triangle.part] += six_volumes(element.nodes[0], x[0], x[1], x[2]) / 6.0;
    };
    std::array<CutTriangle, kMaxSheetTriangles> sheet;
    for (std::size_t i = 0, count = sheet_triangles(cut, labels, sheet); i < count; ++i) add(sheet[i]);
    for (std::size_t f = 0; f < shape_.faces.size(); ++f) {
      std::array<CutTriangle, kMaxFaceTriangles> face;
      for (std::size_t i = 0, count = face_triangles(cut, labels, f, face); i < count; ++i) add(face[i]);
    }
    for (std::size_t part = 0; part < labels.count; ++part) {
      ASSERT_NEAR(volume[part] / whole, shares[part].volume, 1e-13);
    }
  });
}

/// A plane cuts an element with plane faces into what polyhedral clipping says.
TEST_P(PartsOf, ArePolyhedraClippedByAPlane) {
  std::mt19937 random(7);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  int parted = 0;
  for (std::uint32_t seed = 0; seed < 300; ++seed) {
    const Alone element(GetParam(), seed);
    Vector3d inside = Vector3d::Zero();
    double sum = 0.0;
    for (std::size_t k = 0; k < shape_.corner_count; ++k) {
      const double weight = uniform(random);
      inside += weight * element.nodes[k];
      sum += weight;
    }
    const Vector3d normal = Vector3d::NullaryExpr([&] { return uniform(random) - 0.5; }).normalized();
    const double offset = normal.dot(inside / sum);
    ElementCut cut{.shape = &shape_, .cut_edges = 0, .crossings = {}};
    for (std::size_t i = 0; i < shape_.edges.size(); ++i) {
      const auto [a, b] = shape_.edges[i].nodes;
      const double at_a = normal.dot(element.nodes[a]) - offset, at_b = normal.dot(element.nodes[b]) - offset;
      if ((at_a < 0) == (at_b < 0)) continue;
      cut.cut_edges |= 1u << i;
      cut.crossings[i] = at_a / (at_a - at_b);
    }
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    ASSERT_EQ(labels.count, 2);
    ++parted;
    const auto shares = part_shares(cut, labels, element.nodes);
    const auto [whole, whole_moment] = element.polyhedron().integrals();
    const auto [below, below_moment] = element.polyhedron().below(normal, offset).integrals();
    const std::size_t part = normal.dot(element.nodes[0]) < offset ? 0 : 1;
    EXPECT_NEAR(shares[part].volume, below / whole, 1e-12);
    EXPECT_NEAR(shares[1 - part].volume, 1.0 - below / whole, 1e-12);
    // Rational and quadratic functions are not integrated exactly.
    if (shape_.has_mid_edge_nodes() || shape_.corner_count == 5) continue;
    Vector3d moment = Vector3d::Zero();
    for (std::size_t k = 0; k < shape_.node_count; ++k) {
      moment += shares[part].nodes[k] / shape_.node_count * (element.nodes[k] - element.nodes[0]);
    }
    EXPECT_LT((moment * whole - (below_moment - below * element.nodes[0])).norm() / whole, 1e-12);
  }
  EXPECT_EQ(parted, 300);
}

TEST_P(PartsOf, DoNotFeelAnEdgeThatSeparatesNothing) {
  const Alone element(GetParam(), 5);
  std::mt19937 random(2);
  int compared = 0;
  for_each_cut(shape_, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    if (labels.count == 1) return;
    for (std::size_t i = 0; i < shape_.edges.size(); ++i) {
      ElementCut more = cut;
      more.cut_edges |= 1u << i;
      more.crossings[i] = 0.3;
      bool separates = cut.is_cut(i) || label_parts(shape_, more.cut_edges).count > labels.count;
      for (const Face& face : shape_.faces) {
        int cuts = 0;
        bool has = false;
        for (std::size_t e = 0; e < shape_.edges.size(); ++e) {
          const auto [a, b] = shape_.edges[e].nodes;
          const auto end = face.nodes.begin() + face.corner_count();
          const bool of_face =
              std::find(face.nodes.begin(), end, a) != end && std::find(face.nodes.begin(), end, b) != end;
          cuts += of_face && more.is_cut(e);
          has |= of_face && e == i;
        }
        separates |= has && cuts > 1;
      }
      if (separates) continue;
      ++compared;
      const auto before = part_shares(cut, labels, element.nodes), after = part_shares(more, labels, element.nodes);
      for (std::size_t part = 0; part < labels.count; ++part) {
        ASSERT_NEAR(before[part].volume, after[part].volume, 1e-14);
        if (shape_.node_count != 4) continue;
        for (std::size_t k = 0; k < 4; ++k) ASSERT_NEAR(before[part].nodes[k], after[part].nodes[k], 1e-14);
      }
    }
  });
  EXPECT_TRUE(compared > 0 || shape_.corner_count == 4);
}

TEST_P(PartsOf, ShareEachQuadraturePoint) {
  std::vector<Vector3d> points;
  for (const double x : {0.1, 0.2}) {
    for (const double z : {0.15, 0.25}) points.push_back({x, 0.2, z});
  }
  points.push_back({9.0, 9.0, 9.0});  // nearest to nothing
  std::vector<std::array<double, kMaxElementParts>> shares(points.size());
  for_each_cut(shape_, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape_, cut.cut_edges);
    point_shares(cut, labels, points, shares);
    for (const auto& of_point : shares) {
      double sum = 0.0;
      for (std::size_t part = 0; part < kMaxElementParts; ++part) {
        ASSERT_GE(of_point[part], 0.0);
        ASSERT_TRUE(part < labels.count || of_point[part] == 0.0);
        sum += of_point[part];
      }
      ASSERT_NEAR(sum, 1.0, 1e-14);
    }
  });
}

TEST(PartsOfATetrahedron, AreThoseOfTheReference) {
  const Topology& shape = topology(Shape::kTetrahedron);
  const Alone element(Shape::kTetrahedron, 6);
  for_each_cut(shape, [&](const ElementCut& cut) {
    const PartLabels labels = label_parts(shape, cut.cut_edges);
    const auto shares = part_shares(cut, labels, element.nodes);
    std::array<double, 6> crossings{};
    std::copy_n(cut.crossings.begin(), 6, crossings.begin());
    const testing::ReferenceTetrahedron reference(cut.cut_edges, crossings);
    for (std::uint8_t part = 0; part < labels.count; ++part) {
      double volume = 0.0;
      Eigen::Vector4d moment = Eigen::Vector4d::Zero();
      for (std::size_t corner = 0; corner < 4; ++corner) {
        if (labels.part[corner] != part) continue;
        volume += reference.volume[corner];
        moment += reference.moment[corner];
      }
      ASSERT_NEAR(shares[part].volume, volume, 1e-14);
      for (int k = 0; k < 4; ++k) ASSERT_NEAR(shares[part].nodes[static_cast<std::size_t>(k)], 4.0 * moment[k], 1e-14);
    }
  });
}

TEST(PartsOfAPoint, FollowTheNearerCorner) {
  // A hexahedron cut at 0.4 across x. One point has parts of both sides nearest to it, the other only of one.
  const Topology& shape = topology(Shape::kHexahedron);
  ElementCut cut{.shape = &shape, .cut_edges = 0, .crossings = {}};
  const Mesh grid = testing::unit_grid(1, Shape::kHexahedron);
  for (std::size_t i = 0; i < shape.edges.size(); ++i) {
    const double a = grid.nodes[grid.blocks[0].nodes[shape.edges[i].nodes[0]]].x();
    const double b = grid.nodes[grid.blocks[0].nodes[shape.edges[i].nodes[1]]].x();
    if (a == b) continue;
    cut.cut_edges |= 1u << i;
    cut.crossings[i] = a < b ? 0.4 : 0.6;
  }
  const std::vector<Vector3d> points{{0.2, 0.5, 0.5}, {0.8, 0.5, 0.5}};
  std::vector<std::array<double, kMaxElementParts>> shares(2);
  point_shares(cut, label_parts(shape, cut.cut_edges), points, shares);
  EXPECT_GT(shares[0][0], 0.5);
  EXPECT_EQ(shares[1][0], 0.0);
  EXPECT_NEAR(shares[1][1], 1.0, 1e-14);
}

/// server/mesh may not include physics, so this test keeps the two formulas equal.
template <class Element>
void expect_values(Shape of_shape) {
  std::mt19937 random(5);
  std::uniform_real_distribution<double> uniform(0.0, 0.5);
  for (int i = 0; i < 20; ++i) {
    const Vector3d at(uniform(random), uniform(random), uniform(random));
    double expected[Element::kNodes];
    Element::values(at, expected);
    const auto values = corner_values(topology(of_shape), at);
    for (int k = 0; k < Element::kNodes; ++k) EXPECT_NEAR(values[static_cast<std::size_t>(k)], expected[k], 1e-15);
  }
}

TEST(CornerValues, AreThoseOfPhysics) {
  expect_values<physics::LinearTetrahedron>(Shape::kTetrahedron);
  expect_values<physics::Pyramid>(Shape::kPyramid);
  expect_values<physics::Wedge>(Shape::kWedge);
  expect_values<physics::Hexahedron>(Shape::kHexahedron);
}

}  // namespace
}  // namespace tensormass::mesh
