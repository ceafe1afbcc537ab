#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// One list of indices for each row (compressed sparse rows).
struct Rows {
  std::vector<std::uint32_t> offsets{0};  ///< [row_count + 1]
  std::vector<std::uint32_t> items;

  std::uint32_t size() const { return static_cast<std::uint32_t>(offsets.size() - 1); }
  std::span<const std::uint32_t> operator[](std::uint32_t row) const {
    return {items.data() + offsets[row], items.data() + offsets[row + 1]};
  }
};

/// Returns the elements of every node, ascending. [node_count] rows.
Rows node_elements(const Mesh& mesh);

/// Returns the nodes that share an element with each node, ascending, without the node itself. [node_count] rows.
Rows node_neighbours(const Mesh& mesh);
/// The same for any sets of nodes, such as the elements of a mesh (element_nodes) and its clusters.
Rows node_neighbours(std::uint32_t node_count, std::span<const std::span<const std::uint32_t>> nodes_of);

/// Returns the triangles of every vertex, ascending. [vertex_count] rows.
Rows vertex_triangles(std::span<const Triangle> triangles, std::uint32_t vertex_count);

/// Returns the triangle across each edge of each triangle of a closed surface; edge i goes from corner i to the next.
///
/// Errors: an edge does not belong to exactly two triangles in opposite directions. `what` names the surface.
Result<std::vector<std::array<std::uint32_t, 3>>> triangle_neighbours(std::span<const Triangle> triangles,
                                                                      std::string_view what);

}  // namespace tensormass::mesh
