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

/// A Gauss point on [0, 1], and the quadratic Lagrange polynomials of 0, ½, 1 and their slopes there.
struct GaussPoint {
  double weight, value[3], slope[3];

  constexpr GaussPoint(double t, double w)
      : weight(w),
        value{(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)},
        slope{4 * t - 3, 4 - 8 * t, 4 * t - 1} {}
};
constexpr GaussPoint kGauss[3] = {{0.11270166537925831, 5.0 / 18}, {0.5, 8.0 / 18}, {0.88729833462074169, 5.0 / 18}};

/// The surface of a quadratic hexahedron as a lattice of 3×3×3 points without its centre. Lattice coordinates 0, 1, 2
/// are the reference coordinates 0, ½, 1, and a point's place is x + 3 y + 9 z. The element is quadratic along each
/// line of the lattice, so three points give the derivative along their line.
class QuadraticLattice {
 public:
  QuadraticLattice(const Positions& x, const Topology& shape) : shape_(shape) {
    // Relative to a node, so that far from the origin no digits are lost.
    for (std::uint32_t k = 0; k < shape.node_count; ++k) at_[place(k)] = x[k] - x[0];
    for (const Face& face : shape.faces) {  // what the shape functions give in its centre
      Vector3d& centre = at_[(place(face.nodes[0]) + place(face.nodes[2])) / 2];
      centre.setZero();
      for (std::uint32_t i = 0; i < face.node_count; ++i) {
        centre += (i < face.corner_count() ? -0.25 : 0.5) * at_[place(face.nodes[i])];
      }
    }
  }

  /// Returns det J at a local node.
  double determinant(std::uint32_t node) const {
    constexpr double kSlopes[3][3] = {{-3, 4, -1}, {-1, 0, 1}, {1, -4, 3}};  // at 0, ½, 1
    Eigen::Matrix3d jacobian = Eigen::Matrix3d::Zero();
    std::uint32_t stride = 1;
    for (int axis = 0; axis < 3; ++axis, stride *= 3) {
      const std::uint32_t along = place(node) / stride % 3, first = place(node) - along * stride;
      for (std::uint32_t i = 0; i < 3; ++i) jacobian.col(axis) += kSlopes[along][i] * at_[first + i * stride];
    }
    return jacobian.determinant();
  }

  /// Returns ∫ x · n da over a face. It has degree five in each direction, so 3×3 Gauss points are exact.
  double flux(const Face& face) const {
    const auto corner = [&](std::size_t i) { return static_cast<int>(place(face.nodes[i])); };
    const int origin = corner(0), step_r = (corner(1) - origin) / 2, step_s = (corner(3) - origin) / 2;
    double sum = 0.0;
    for (const GaussPoint& r : kGauss) {
      for (const GaussPoint& s : kGauss) {
        Vector3d x = Vector3d::Zero(), x_r = Vector3d::Zero(), x_s = Vector3d::Zero();
        for (int i = 0; i < 3; ++i) {
          for (int j = 0; j < 3; ++j) {
            const Vector3d& node = at_[static_cast<std::size_t>(origin + i * step_r + j * step_s)];
            x += r.value[i] * s.value[j] * node;
            x_r += r.slope[i] * s.value[j] * node;
            x_s += r.value[i] * s.slope[j] * node;
          }
        }
        sum += r.weight * s.weight * x.dot(x_r.cross(x_s));
      }
    }
    return sum;
  }

 private:
  std::uint32_t place(std::uint32_t node) const {
    constexpr std::uint32_t kCorners[8] = {0, 2, 8, 6, 18, 20, 26, 24};
    if (node < shape_.corner_count) return kCorners[node];
    const auto [a, b] = shape_.edges[node - shape_.corner_count].nodes;
    return (kCorners[a] + kCorners[b]) / 2;
  }

  const Topology& shape_;
  std::array<Vector3d, 27> at_;  // [m], relative to node 0
};

/// Geometry of a quadratic hexahedron. The volume follows from the divergence theorem.
void quadratic_hexahedron_geometry(const Positions& x, const Topology& shape, ElementGeometry& geometry) {
  const QuadraticLattice lattice(x, shape);
  for (std::uint32_t k = 0; k < shape.node_count; ++k) meet(geometry, k, lattice.determinant(k));
  for (const Face& face : shape.faces) geometry.volume_m3 += lattice.flux(face) / 3.0;
}

/// Geometry of a quadratic tetrahedron. The Jacobian's determinant is cubic; a rule over the corners and the face
/// centres integrates it exactly (Keast 1986, weights 1/240 and 9/240).
void quadratic_tetrahedron_geometry(const Positions& x, const Topology& shape, ElementGeometry& geometry) {
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
  if (!shape.has_mid_edge_nodes()) {
    linear_geometry(x, shape, geometry);
  } else if (shape.corner_count == 4) {
    quadratic_tetrahedron_geometry(x, shape, geometry);
  } else {
    quadratic_hexahedron_geometry(x, shape, geometry);
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
