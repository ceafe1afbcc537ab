#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// The boundary of a mesh: the faces that belong to one element only, as triangles over compact vertices.
struct Surface {
  std::vector<std::uint32_t> nodes;              ///< [vertex_count] the mesh node of each vertex, ascending
  std::vector<Triangle> triangles;               ///< [triangle_count] indices into `nodes`, outward winding
  std::vector<std::uint32_t> triangle_elements;  ///< [triangle_count] the element behind each triangle, ascending
  /// [triangle_count] the triangle across the edge from corner i to corner i + 1; kNone where not exactly two triangles
  /// meet in an edge, in opposite directions.
  std::vector<std::array<std::uint32_t, 3>> neighbours;
  Rows vertex_triangles;  ///< [vertex_count] triangles of each vertex, ascending
};

/// Triangles come in the order of their element and its face: the same mesh gives the same surface.
Surface boundary(const Mesh& mesh);

}  // namespace tensormass::mesh
