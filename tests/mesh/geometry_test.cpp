#include "mesh/geometry.h"

#include <algorithm>
#include <cmath>

#include <gtest/gtest.h>
#include <Eigen/LU>

#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

/// Moves the nodes of a reference element at random.
Mesh distorted(Shape shape, std::uint32_t seed, double reach) {
  Mesh mesh = tests::reference_element(shape);
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-reach, reach);
  for (Vector3d& node : mesh.nodes) node += Vector3d(uniform(random), uniform(random), uniform(random));
  return mesh;
}

ElementGeometry geometry(const Mesh& mesh) {
  return element_geometry(mesh, topology(mesh.blocks[0].shape), mesh.blocks[0].nodes);
}

/// Maps a point r of the reference elements of support/meshes.h to the element. The shape functions are written as
/// products over corners, so that they share nothing with the code under test. The pyramid's are rational (Bedrosian)
/// on a base from −1 to 1.
Vector3d map(const Mesh& mesh, const Vector3d& r) {
  const auto& x = mesh.nodes;
  const double l[4] = {1.0 - r.x() - r.y() - r.z(), r.x(), r.y(), r.z()};
  switch (mesh.blocks[0].shape) {
    case Shape::kTetrahedron:
      return l[0] * x[0] + l[1] * x[1] + l[2] * x[2] + l[3] * x[3];
    case Shape::kPyramid: {
      Vector3d sum = r.z() * x[4];
      const double top = 1.0 - r.z();
      const Mesh reference = tests::reference_element(Shape::kPyramid);
      for (std::size_t k = 0; k < 4; ++k) {
        const Vector3d& at = reference.nodes[k];
        sum += 0.25 * (top + at.x() * r.x()) * (top + at.y() * r.y()) / top * x[k];
      }
      return sum;
    }
    case Shape::kWedge: {
      Vector3d sum = Vector3d::Zero();
      const double triangle[3] = {1.0 - r.x() - r.y(), r.x(), r.y()};
      for (std::size_t k = 0; k < 3; ++k) sum += triangle[k] * ((1.0 - r.z()) * x[k] + r.z() * x[k + 3]);
      return sum;
    }
    case Shape::kHexahedron: {
      Vector3d sum = Vector3d::Zero();
      const Mesh reference = tests::reference_element(Shape::kHexahedron);
      for (std::size_t k = 0; k < 8; ++k) {
        const Eigen::Array3d at = reference.nodes[k].array();
        sum += (at * r.array() + (1.0 - at) * (1.0 - r.array())).prod() * x[k];
      }
      return sum;
    }
    case Shape::kQuadraticTetrahedron: {
      constexpr int kMiddles[6][2] = {{0, 1}, {1, 2}, {0, 2}, {0, 3}, {1, 3}, {2, 3}};
      Vector3d sum = Vector3d::Zero();
      for (std::size_t k = 0; k < 4; ++k) sum += l[k] * (2.0 * l[k] - 1.0) * x[k];
      for (std::size_t k = 0; k < 6; ++k) sum += 4.0 * l[kMiddles[k][0]] * l[kMiddles[k][1]] * x[k + 4];
      return sum;
    }
    case Shape::kQuadraticHexahedron: {
      Vector3d sum = Vector3d::Zero();
      const Mesh reference = tests::reference_element(Shape::kQuadraticHexahedron);
      const Eigen::Array3d to = 2.0 * r.array() - 1.0;
      for (std::size_t k = 0; k < 20; ++k) {
        const Eigen::Array3d at = 2.0 * reference.nodes[k].array() - 1.0;
        const double product = (at == 0.0).select(1.0 - to * to, 1.0 + at * to).prod();
        sum += product * (k < 8 ? ((at * to).sum() - 2.0) / 8.0 : 0.25) * x[k];
      }
      return sum;
    }
  }
  return Vector3d::Zero();
}

double jacobian_determinant(const Mesh& mesh, const Vector3d& r) {
  constexpr double kStep = 1e-5;
  Eigen::Matrix3d jacobian;
  for (int axis = 0; axis < 3; ++axis) {
    const Vector3d step = kStep * Vector3d::Unit(axis);
    jacobian.col(axis) = (map(mesh, r + step) - map(mesh, r - step)) / (2.0 * kStep);
  }
  return jacobian.determinant();
}

class Geometry : public testing::EveryMesh {
 protected:
  const Mesh mesh_ = distorted(shape_, seed_, 0.15);
  const Mesh reference_ = tests::reference_element(shape_);
};

TEST_P(Geometry, LeastJacobianAgreesWithTheShapeFunctions) {
  for (std::uint32_t variant = 0; variant < 20; ++variant) {
    const Mesh mesh = distorted(shape_, 20 * seed_ + variant, 0.3);
    double least = std::numeric_limits<double>::infinity();
    std::size_t where = 0;
    for (std::size_t node = 0; node < mesh.nodes.size(); ++node) {
      if (shape_ == Shape::kPyramid && node == 4) continue;  // the Jacobian has no limit at the apex
      const Vector3d& r = reference_.nodes[node];
      // The least Jacobian is the determinant times a constant, which the reference element gives.
      const double scale = geometry(reference_).min_jacobian_m3 / jacobian_determinant(reference_, r);
      const double determinant = scale * jacobian_determinant(mesh, r);
      if (determinant >= least - 1e-9) continue;
      least = determinant;
      where = node;
    }
    const ElementGeometry found = geometry(mesh);
    EXPECT_NEAR(found.min_jacobian_m3, least, 1e-7);
    EXPECT_EQ(found.min_jacobian_node, where);
  }
}

TEST_P(Geometry, VolumeIsTheIntegralOfTheJacobian) {
  // Integrates with the midpoint rule in a cube that is mapped to the reference element. The rule is of second order;
  // two step widths are extrapolated (Richardson).
  const auto integral = [&](int cells) {
    double sum = 0.0;
    for (int i = 0; i < cells * cells * cells; ++i) {
      const double u = (i % cells + 0.5) / cells, v = (i / cells % cells + 0.5) / cells,
                   w = (i / cells / cells + 0.5) / cells;
      Vector3d r(u, v, w);
      double scale = 1.0;
      if (shape_ == Shape::kPyramid) {
        r = {(2.0 * u - 1.0) * (1.0 - w), (2.0 * v - 1.0) * (1.0 - w), w};
        scale = 4.0 * (1.0 - w) * (1.0 - w);
      } else if (shape_ == Shape::kWedge) {
        r = {u, v * (1.0 - u), w};
        scale = 1.0 - u;
      } else if (topology(shape_).corner_count == 4) {
        r = {u, v * (1.0 - u), w * (1.0 - u) * (1.0 - v)};
        scale = (1.0 - u) * (1.0 - u) * (1.0 - v);
      }
      sum += scale * jacobian_determinant(mesh_, r);
    }
    return sum / (cells * cells * cells);
  };
  const double expected = (4.0 * integral(24) - integral(12)) / 3.0;
  EXPECT_NEAR(geometry(mesh_).volume_m3, expected, 1e-5);
}

TEST_P(Geometry, DoesNotDependOnTheNumberingOfTheElement) {
  Mesh turned = mesh_;
  turned.blocks[0].nodes = testing::turned(shape_);
  const ElementGeometry a = geometry(mesh_), b = geometry(turned);
  EXPECT_NEAR(a.volume_m3, b.volume_m3, 1e-15);
  EXPECT_NEAR(a.min_jacobian_m3, b.min_jacobian_m3, 1e-15);
  EXPECT_EQ(a.max_edge_m, b.max_edge_m);
  if (shape_ == Shape::kTetrahedron) return;  // the same at every node
  EXPECT_EQ(mesh_.blocks[0].nodes[a.min_jacobian_node], turned.blocks[0].nodes[b.min_jacobian_node]);
}

TENSORMASS_EVERY_MESH(Geometry);

TEST(QuadraticGeometry, MidEdgeNodesMayLieBetweenTheQuarterPoints) {
  for (const auto& [at, good] : {std::pair(0.24, false), {0.26, true}, {0.74, true}, {0.76, false}}) {
    Mesh mesh = tests::reference_element(Shape::kQuadraticTetrahedron);
    mesh.nodes[4] = {at, 0.0, 0.0};
    EXPECT_EQ(geometry(mesh).min_jacobian_m3 > 0.0, good) << at;
    mesh = tests::reference_element(Shape::kQuadraticHexahedron);
    mesh.nodes[8] = {at, 0.0, 0.0};
    EXPECT_EQ(geometry(mesh).min_jacobian_m3 > 0.0, good) << at;
  }
}

}  // namespace
}  // namespace tensormass::mesh
