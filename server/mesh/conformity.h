#pragma once

#include <string_view>

#include "mesh/finding.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Where faces meet without being one face.
struct Conformity {
  Finding overlapping;  ///< more than two elements at a face, or two on one side of it
  /// Faces that lie on each other and share some of their nodes only: a triangle on a quadrilateral, a linear face on a
  /// quadratic one.
  Finding nonconforming;
};

/// Takes a mesh whose elements were found sound one by one; names `body`. A face in the middle of another that shares
/// fewer than three nodes with it ("hanging nodes") is not found: it would take geometry. O(n log n).
Conformity check_conformity(const Mesh& mesh, std::string_view body);

}  // namespace tensormass::mesh
