#pragma once

#include <cstdint>
#include <limits>
#include <span>

#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// Volume, distortion and size of an element.
struct ElementGeometry {
  double volume_m3 = 0.0;  ///< integral of the Jacobian's determinant; exact also for curved faces
  /// The smallest Jacobian determinant at the element's corners and mid-edge nodes, divided by 6: the signed volume of
  /// the tetrahedron that the edges at that node span. For a linear tetrahedron it is the element's volume.
  double min_jacobian_m3 = std::numeric_limits<double>::infinity();
  std::uint32_t min_jacobian_node = 0;  ///< index within the element
  double max_edge_m = 0.0;              ///< longest edge, measured between its corners
};

/// Measures an element of `mesh` with the given mesh nodes.
///
/// For a quadratic element with straight edges, the Jacobian at the corners is positive as long as each mid-edge node
/// lies between the quarter points of its edge.
ElementGeometry element_geometry(const Mesh& mesh, const Topology& shape, std::span<const std::uint32_t> nodes);

/// Returns the smallest Jacobian determinant at the four points of full quadrature of a quadratic tetrahedron, divided
/// by 6.
double min_jacobian_of_points_m3(const Mesh& mesh, std::span<const std::uint32_t> nodes);

/// Returns the cosine of the smallest dihedral angle, from −1 (180°) to 1 (0°). Each face counts as plane through its
/// corners.
double max_dihedral_cosine(const Mesh& mesh, const Topology& shape, std::span<const std::uint32_t> nodes);

}  // namespace tensormass::mesh
