#include "mesh/geometry.h"

#include <algorithm>
#include <array>
#include <cmath>

#include <Eigen/LU>

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;
using Nodes = std::span<const std::uint32_t>;

/// The positions of an element's nodes, by their local index.
class Positions {
 public:
  Positions(const Mesh& mesh, Nodes nodes) : mesh_(mesh), nodes_(nodes) {}
  const Vector3d& operator[](std::uint32_t local) const { return mesh_.nodes[nodes_[local]]; }

 private:
  const Mesh& mesh_;
  Nodes nodes_;
};

/// Takes the Jacobian determinant at a node into the minimum. A sixth of it is the volume of a tetrahedron with the
/// same edges.
void meet(ElementGeometry& geometry, std::uint32_t node, double determinant) {
  if (determinant / 6.0 >= geometry.min_jacobian_m3) return;
  geometry.min_jacobian_m3 = determinant / 6.0;
  geometry.min_jacobian_node = node;
}

/// Geometry of a shape without mid-edge nodes.
///
/// The volume follows from the divergence theorem with node 0 as the origin: faces that contain node 0 add nothing if
/// they are plane. A bilinear face encloses the mean of what its two triangulations enclose.
void linear_geometry(const Positions& x, const Topology& shape, ElementGeometry& geometry) {
  double six_volume = 0.0;
  for (const Face& face : shape.faces) {
    const auto triple = [&](int i, int j, int k) {
      return six_volumes(x[0], x[face.nodes[i]], x[face.nodes[j]], x[face.nodes[k]]);
    };
    six_volume += face.node_count == 3 ? triple(0, 1, 2)
                                       : 0.5 * (triple(0, 1, 2) + triple(0, 2, 3) + triple(1, 2, 3) + triple(1, 3, 0));
  }
  geometry.volume_m3 = six_volume / 6.0;
  for (const Simplex& s : shape.corner_frames) {
    meet(geometry, s[0], six_volumes(x[s[0]], x[s[1]], x[s[2]], x[s[3]]));
  }
}

/// Returns the Jacobians J_a of a quadratic tetrahedron at its corners a. The Jacobian is linear in space, so they
/// determine it everywhere. The derivative at corner a towards corner b is 4 x_mid − 3 x_a − x_b.
std::array<Eigen::Matrix3d, 4> corner_jacobians(const Positions& x, const Topology& shape) {
  std::array<std::array<Vector3d, 4>, 4> tangents;  // [from, to], zero from a corner to itself
  for (std::uint32_t corner = 0; corner < 4; ++corner) tangents[corner][corner].setZero();
  for (std::uint32_t i = 0; i < shape.edges.size(); ++i) {
    const auto [a, b] = shape.edges[i].nodes;
    const Vector3d& middle = x[shape.corner_count + i];
    tangents[a][b] = 4.0 * middle - 3.0 * x[a] - x[b];
    tangents[b][a] = 4.0 * middle - 3.0 * x[b] - x[a];
  }
  std::array<Eigen::Matrix3d, 4> jacobians;
  for (std::uint32_t corner = 0; corner < 4; ++corner) {
    const auto& to = tangents[corner];
    jacobians[corner] << to[1] - to[0], to[2] - to[0], to[3] - to[0];
  }
  return jacobians;
}

/// Geometry of a quadratic tetrahedron. The Jacobian's determinant is cubic; a rule over the corners and the face
/// centres integrates it exactly (Keast 1986, weights 1/240 and 9/240).
void quadratic_geometry(const Positions& x, const Topology& shape, ElementGeometry& geometry) {
  const std::array<Eigen::Matrix3d, 4> jacobians = corner_jacobians(x, shape);
  for (std::uint32_t corner = 0; corner < 4; ++corner) {
    const double determinant = jacobians[corner].determinant();
    meet(geometry, corner, determinant);
    geometry.volume_m3 += determinant / 240.0;
  }
  for (std::uint32_t i = 0; i < shape.edges.size(); ++i) {
    const auto [a, b] = shape.edges[i].nodes;
    meet(geometry, shape.corner_count + i, Eigen::Matrix3d(0.5 * (jacobians[a] + jacobians[b])).determinant());
  }
  for (const Face& face : shape.faces) {
    const Eigen::Matrix3d sum = jacobians[face.nodes[0]] + jacobians[face.nodes[1]] + jacobians[face.nodes[2]];
    geometry.volume_m3 += 9.0 / 240.0 * Eigen::Matrix3d(sum / 3.0).determinant();
  }
}

}  // namespace

ElementGeometry element_geometry(const Mesh& mesh, const Topology& shape, Nodes nodes) {
  const Positions x(mesh, nodes);
  ElementGeometry geometry;
  if (shape.has_mid_edge_nodes()) {
    quadratic_geometry(x, shape, geometry);
  } else {
    linear_geometry(x, shape, geometry);
  }
  double max_squared = 0.0;
  for (const Edge& edge : shape.edges) {
    max_squared = std::max(max_squared, (x[edge.nodes[1]] - x[edge.nodes[0]]).squaredNorm());
  }
  geometry.max_edge_m = std::sqrt(max_squared);
  return geometry;
}

double min_jacobian_of_points_m3(const Mesh& mesh, Nodes nodes) {
  const auto jacobians = corner_jacobians(Positions(mesh, nodes), topology(Shape::kQuadraticTetrahedron));
  const double far = (5.0 - std::sqrt(5.0)) / 20.0, near = 1.0 - 3.0 * far;
  const Eigen::Matrix3d sum = jacobians[0] + jacobians[1] + jacobians[2] + jacobians[3];
  double least = std::numeric_limits<double>::infinity();
  for (const Eigen::Matrix3d& jacobian : jacobians) {
    least = std::min(least, Eigen::Matrix3d(far * sum + (near - far) * jacobian).determinant() / 6.0);
  }
  return least;
}

double max_dihedral_cosine(const Mesh& mesh, const Topology& shape, Nodes nodes) {
  const Positions x(mesh, nodes);
  std::array<Vector3d, kMaxFaces> normals;
  for (std::size_t i = 0; i < shape.faces.size(); ++i) {
    const Face& face = shape.faces[i];
    // Newell's normal: exact for a triangle, the average normal of a face that is not plane.
    Vector3d normal = Vector3d::Zero();
    const Vector3d& origin = x[face.nodes[0]];
    for (std::uint32_t corner = 2; corner < face.corner_count(); ++corner) {
      normal += (x[face.nodes[corner - 1]] - origin).cross(x[face.nodes[corner]] - origin);
    }
    normals[i] = normal.normalized();
  }
  double cosine = -1.0;
  for (const Edge& edge : shape.edges) cosine = std::max(cosine, -normals[edge.faces[0]].dot(normals[edge.faces[1]]));
  return std::min(cosine, 1.0);
}

}  // namespace tensormass::mesh
