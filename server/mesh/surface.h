#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/faces.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// A face that belongs to one element only.
struct BoundaryFace {
  std::uint32_t element;
  std::uint32_t face;  ///< index into the shape's `Topology::faces`
  FaceNodes nodes;     ///< 3 (triangle), 4 (quadrilateral) or 6 (quadratic triangle), winding outward
};

/// Returns the boundary faces in the order of elements, and of Topology::faces within an element. Tractions and
/// pressures act on them.
std::vector<BoundaryFace> boundary_faces(const Mesh& mesh);

/// The boundary faces as triangles over compact vertices. A quadrilateral is split along the diagonal through its
/// lowest node, a quadratic triangle into four: the surface depends only on the mesh.
struct Surface {
  std::vector<std::uint32_t> nodes;              ///< [vertex_count] the mesh node of each vertex, ascending
  std::vector<Triangle> triangles;               ///< [triangle_count] indices into `nodes`, outward winding
  std::vector<std::uint32_t> triangle_elements;  ///< [triangle_count] the element behind each triangle, ascending
  /// [triangle_count] the triangle across the edge from corner i to corner i + 1. It is kNone unless exactly two
  /// triangles meet at the edge and run along it in opposite directions.
  std::vector<std::array<std::uint32_t, 3>> neighbours;
  Rows vertex_triangles;  ///< [vertex_count] triangles of each vertex, ascending
};

/// Returns Surface::neighbours of triangles.
std::vector<std::array<std::uint32_t, 3>> edge_neighbours(std::span<const Triangle> triangles);

/// Returns the triangles of a face, in the order of its nodes. Numbers: mesh nodes, outward winding.
std::vector<Triangle> face_triangles(const FaceNodes& nodes);

/// Returns faces as triangles, in their order. faces: of elements in ascending order
Surface surface_of(const Mesh& mesh, std::span<const BoundaryFace> faces);
/// Returns the boundary as triangles, in the order of `boundary_faces`.
Surface boundary(const Mesh& mesh);

}  // namespace tensormass::mesh
