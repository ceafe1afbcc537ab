#pragma once

#include <array>
#include <cstdint>
#include <string_view>
#include <vector>

#include "core/limits.h"
#include "core/result.h"
#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// A mesh whose linear tetrahedra have become quadratic.
struct ElevatedMesh {
  Mesh mesh;
  /// [added node] the edge in whose middle the node is. The added nodes are the last of the mesh.
  std::vector<EdgeEnds> middle_of;
};

/// Makes the linear tetrahedra of a mesh quadratic: each of their edges gets a node in its middle, which all elements
/// at the edge share. Blocks, elements and corners keep their order.
///
/// The new nodes follow the mesh's own, ordered by the lower end of their edge, then by the higher one. This order
/// depends on the edges alone, so a client that has the linear mesh can number the nodes itself.
///
/// Quadratic tetrahedra stay as they are. If a linear one has an edge in common with them, it takes their mid-edge
/// node.
///
/// The mesh must be admitted. `where` names the field in messages. Errors: an element of another shape, more than
/// `max_nodes` nodes.
Result<ElevatedMesh> elevate(Mesh mesh, std::string_view where, std::size_t max_nodes = limits::kMaxNodes);

}  // namespace tensormass::mesh
