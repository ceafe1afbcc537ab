#pragma once

#include <string_view>

#include "mesh/mesh.h"
#include "mesh/problem.h"

namespace tensormass::mesh {

/// Faces of neighbouring elements that touch without being one common face.
struct Conformity {
  Problem overlapping;  ///< more than two elements at a face, or two on the same side of it
  /// Faces that lie on each other and share only some of their nodes: a triangle on a quadrilateral, a linear face on a
  /// quadratic one.
  Problem nonconforming;
};

/// Checks that neighbouring elements share whole faces. `body` names the mesh in messages. O(n log n).
///
/// Needs elements that are sound one by one (admission.h). Does not find "hanging nodes": a face within another that
/// shares fewer than three nodes with it would take geometry to find.
Conformity check_conformity(const Mesh& mesh, std::string_view body);

}  // namespace tensormass::mesh
