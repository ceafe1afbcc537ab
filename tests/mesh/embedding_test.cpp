#include "mesh/embedding.h"

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

std::vector<Vector3d> random_points(std::uint32_t seed, std::size_t count, double low, double high) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(low, high);
  std::vector<Vector3d> points(count);
  for (Vector3d& point : points) point = {uniform(random), uniform(random), uniform(random)};
  return points;
}

Vector3d carried(const Embedding& embedding, std::size_t point, const std::vector<Vector3d>& nodes) {
  Vector3d x = Vector3d::Zero();
  for (int k = 0; k < 4; ++k) x += embedding.weights[point][k] * nodes[embedding.nodes[point][k]];
  return x;
}

double least_weight(const Embedding& embedding, std::size_t point) {
  return *std::min_element(embedding.weights[point].begin(), embedding.weights[point].end());
}

/// Returns the distance from a tetrahedron: the smallest among projections on the hull of 1 to 4 corners (active sets).
/// Slow, and it shares nothing with the code under test.
double brute_distance(const Vector3d& p, const std::array<Vector3d, 4>& corners) {
  double best = std::numeric_limits<double>::infinity();
  for (unsigned set = 1; set < 16; ++set) {
    std::vector<Vector3d> x;
    for (int k = 0; k < 4; ++k) {
      if (set >> k & 1) x.push_back(corners[k]);
    }
    const auto edges = static_cast<Eigen::Index>(x.size()) - 1;
    Eigen::MatrixXd basis(3, edges);
    for (Eigen::Index i = 0; i < edges; ++i) basis.col(i) = x[static_cast<std::size_t>(i) + 1] - x[0];
    const Eigen::VectorXd w =
        edges > 0 ? Eigen::VectorXd((basis.transpose() * basis).inverse() * basis.transpose() * (p - x[0]))
                  : Eigen::VectorXd(0);
    if (edges > 0 && (w.minCoeff() < 0.0 || w.sum() > 1.0)) continue;
    best = std::min(best, (x[0] + basis * w - p).norm());
  }
  return best;
}

class Embed : public testing::EveryMesh {
 protected:
  const Mesh mesh_ = testing::random_mesh(seed_, 3, 0.5, shape_);
  const std::vector<std::span<const std::uint32_t>> nodes_of_ = element_nodes(mesh_);

  double distance_from(const Vector3d& point, std::uint32_t element) const {
    double best = std::numeric_limits<double>::infinity();
    const auto x = [&](std::uint8_t local) { return mesh_.nodes[nodes_of_[element][local]]; };
    for (const Simplex& s : topology(shape_).simplices) {
      best = std::min(best, brute_distance(point, {x(s[0]), x(s[1]), x(s[2]), x(s[3])}));
    }
    return best;
  }
  double distance_from_mesh(const Vector3d& point) const {
    double distance = std::numeric_limits<double>::infinity();
    for (std::uint32_t element = 0; element < nodes_of_.size(); ++element) {
      distance = std::min(distance, distance_from(point, element));
    }
    return distance;
  }
};

TEST_P(Embed, FindsTheContainingOrNearestElement) {
  std::vector<Vector3d> points = random_points(seed_, 300, -0.2, 1.2);
  // The tetrahedra of a quadratic hexahedron have edges of half its size, so points far from the mesh are refused.
  std::erase_if(points, [&](const Vector3d& point) { return distance_from_mesh(point) > 0.3; });
  const Embedding embedding = embed(mesh_, points, "test points").value();
  double farthest = 0.0;
  int inside = 0;
  for (std::size_t i = 0; i < points.size(); ++i) {
    EXPECT_LT((carried(embedding, i, mesh_.nodes) - points[i]).norm(), 1e-12);
    const auto& nodes = nodes_of_[embedding.elements[i]];
    for (const std::uint32_t node : embedding.nodes[i]) EXPECT_EQ(std::count(nodes.begin(), nodes.end(), node), 1);
    const double distance = distance_from_mesh(points[i]);
    EXPECT_NEAR(distance_from(points[i], embedding.elements[i]), distance, 1e-12);
    EXPECT_EQ(least_weight(embedding, i) >= 0.0, distance < 1e-12);
    inside += distance < 1e-12;
    farthest = std::max(farthest, distance);
  }
  EXPECT_GT(inside, 20);
  EXPECT_LT(static_cast<std::size_t>(inside) + 20, points.size());
  EXPECT_NEAR(embedding.max_distance_m, farthest, 1e-12);
}

TEST_P(Embed, FollowsAnAffineMotionExactly) {
  const std::vector<Vector3d> points = random_points(seed_ + 100, 100, 0.0, 1.0);
  const Embedding embedding = embed(mesh_, points, "test points").value();
  Eigen::Matrix3d stretch;
  stretch << 1.2, 0.3, -0.1, 0.0, 0.9, 0.2, 0.4, 0.0, 1.1;
  std::vector<Vector3d> moved;
  for (const Vector3d& node : mesh_.nodes) moved.push_back(stretch * node + Vector3d(1.0, 2.0, 3.0));
  for (std::size_t i = 0; i < points.size(); ++i) {
    EXPECT_LT((carried(embedding, i, moved) - (stretch * points[i] + Vector3d(1.0, 2.0, 3.0))).norm(), 1e-11);
  }
}

TENSORMASS_EVERY_MESH(Embed);

TEST(EmbedOutside, PrefersTheElementThatExtrapolatesLeast) {
  // These points are nearest to a corner of the cube that six elements share, or to an edge that two share.
  const Mesh mesh = testing::unit_grid(1);
  const std::vector<Vector3d> points{{1.1, 1.15, 1.2}, {1.3, 1.2, 1.1}, {1.1, 0.5, 1.2}, {1.2, 0.5, 1.1}};
  const Embedding embedding = embed(mesh, points, "test points").value();
  for (std::size_t i = 0; i < points.size(); ++i) {
    const double distance = (points[i] - points[i].cwiseMin(1.0)).norm();
    double greatest = -std::numeric_limits<double>::infinity(), smallest = -greatest;
    for (const auto& nodes : element_nodes(mesh)) {
      const std::array<Vector3d, 4> x{mesh.nodes[nodes[0]], mesh.nodes[nodes[1]], mesh.nodes[nodes[2]],
                                      mesh.nodes[nodes[3]]};
      if (brute_distance(points[i], x) > distance + 1e-12) continue;
      Eigen::Matrix4d system;
      for (int k = 0; k < 4; ++k) system.col(k) << x[k], 1.0;
      const double least =
          (system.inverse() * Eigen::Vector4d(points[i].x(), points[i].y(), points[i].z(), 1.0)).minCoeff();
      greatest = std::max(greatest, least);
      smallest = std::min(smallest, least);
    }
    EXPECT_LT(smallest, greatest - 0.01);
    EXPECT_NEAR(least_weight(embedding, i), greatest, 1e-12);
  }
}

TEST(EmbedOutside, RefusesAPointFarAway) {
  const Mesh mesh = testing::unit_grid(4);
  const double limit = kMaxEmbeddingEdges * std::sqrt(3.0) / 4.0;
  const std::vector<Vector3d> near{{0.1, 0.1, 1.0 + 0.99 * limit}},
      far{{0.5, 0.5, 0.5}, {0.1, 0.1, 1.0 + 1.01 * limit}};
  EXPECT_TRUE(embed(mesh, near, "the skin of body 'liver'"));
  const Result<Embedding> refused = embed(mesh, far, "the skin of body 'liver'");
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("point 1 of the skin of body 'liver'"), std::string::npos);
}

TEST(EmbedDistorted, DropsInvertedTetrahedraOfTheDecomposition) {
  // This hexahedron is valid, but one of its tetrahedra has a negative volume.
  const Mesh reference = tests::reference_element(Shape::kHexahedron);
  Mesh mesh = reference;
  mesh.nodes[4] = {-0.6, 0.6, 0.3};
  ASSERT_TRUE(admit(mesh, "cell"));
  const auto volume = [&](const auto& nodes) {
    return six_volumes(mesh.nodes[nodes[0]], mesh.nodes[nodes[1]], mesh.nodes[nodes[2]], mesh.nodes[nodes[3]]);
  };
  const auto simplices = topology(Shape::kHexahedron).simplices;
  ASSERT_TRUE(std::any_of(simplices.begin(), simplices.end(), [&](const Simplex& s) { return volume(s) < -0.2; }));

  std::vector<Vector3d> points;
  for (const Vector3d& r : random_points(1, 500, 0.0, 1.0)) {  // mapped from the unit cube
    Vector3d& x = points.emplace_back(Vector3d::Zero());
    for (std::size_t corner = 0; corner < 8; ++corner) {
      const Eigen::Array3d at = reference.nodes[corner].array();
      x += (at * r.array() + (1.0 - at) * (1.0 - r.array())).prod() * mesh.nodes[corner];
    }
  }
  const Embedding embedding = embed(mesh, points, "test points").value();
  for (std::size_t i = 0; i < points.size(); ++i) {
    EXPECT_GT(volume(embedding.nodes[i]), 0.0);
    EXPECT_LT((carried(embedding, i, mesh.nodes) - points[i]).norm(), 1e-12);
  }
}

TEST(EmbedNothing, IsEmpty) {
  const Embedding embedding = embed(testing::unit_grid(1), {}, "no points").value();
  EXPECT_TRUE(embedding.nodes.empty());
  EXPECT_EQ(embedding.max_distance_m, 0.0);
}

}  // namespace
}  // namespace tensormass::mesh
