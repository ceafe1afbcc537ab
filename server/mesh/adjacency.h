#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Lists of indices, one a row (compressed sparse rows).
struct Rows {
  std::vector<std::uint32_t> offsets{0};  ///< [row_count + 1]
  std::vector<std::uint32_t> items;

  std::uint32_t size() const { return static_cast<std::uint32_t>(offsets.size() - 1); }
  std::span<const std::uint32_t> operator[](std::uint32_t row) const {
    return {items.data() + offsets[row], items.data() + offsets[row + 1]};
  }
};

/// Elements of every node, ascending.
Rows node_elements(const Mesh& mesh);

/// Nodes that share an element with a node, ascending, without the node itself.
Rows node_neighbours(const Mesh& mesh);
/// The same where `node_elements(mesh)` is at hand.
Rows node_neighbours(const Mesh& mesh, const Rows& elements);

/// Triangles of every vertex, ascending.
Rows vertex_triangles(std::span<const Triangle> triangles, std::uint32_t vertex_count);

}  // namespace tensormass::mesh
