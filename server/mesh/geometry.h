#pragma once

#include <cstdint>
#include <limits>
#include <span>

#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// What an element's nodes span.
struct ElementGeometry {
  double volume_m3 = 0.0;  ///< the integral of the Jacobian's determinant, exact where faces or edges are curved, too
  /// The least determinant of the Jacobian at the element's nodes, as the signed volume of a tetrahedron with the same
  /// edges there: of a tetrahedron its own. At the corners, in a quadratic shape at the mid-edge nodes, too.
  double min_jacobian_m3 = std::numeric_limits<double>::infinity();
  std::uint32_t min_jacobian_node = 0;  ///< local
  double max_edge_m = 0.0;              ///< between corners
};

/// `nodes` of an element of `mesh`. The Jacobian at a node is positive as long as the mid-edge nodes of a straight edge
/// lie between its quarter points.
ElementGeometry element_geometry(const Mesh& mesh, const Topology& shape, std::span<const std::uint32_t> nodes);

/// The cosine of the smallest angle between two faces, each taken plane through its corners; from -1 (180°) to 1 (0°).
double max_dihedral_cosine(const Mesh& mesh, const Topology& shape, std::span<const std::uint32_t> nodes);

}  // namespace tensormass::mesh
