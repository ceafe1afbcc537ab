#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// The element on the other side of a face.
struct FaceNeighbour {
  std::uint32_t element = kNone;  ///< kNone on the boundary
  std::uint32_t face = 0;         ///< index into its `Topology::faces`
};

/// What cuts need to know of a mesh: its edges, and what meets at them. Never changes.
class CutTopology {
 public:
  /// The mesh must be admitted, and must stay unchanged as long as this object lives.
  explicit CutTopology(const Mesh& mesh);

  const Mesh& mesh() const { return *mesh_; }
  std::uint32_t node_count() const { return static_cast<std::uint32_t>(mesh_->nodes.size()); }
  std::uint32_t element_count() const { return static_cast<std::uint32_t>(nodes_of_.size()); }
  std::uint32_t edge_count() const { return static_cast<std::uint32_t>(edges_.size()); }

  const Topology& shape(std::uint32_t element) const { return *shape_of_[element]; }
  std::span<const std::uint32_t> nodes(std::uint32_t element) const { return nodes_of_[element]; }
  /// The mesh edges of an element, in the order of `Topology::edges`.
  std::span<const std::uint32_t> edges(std::uint32_t element) const { return element_edges_[element]; }
  FaceNeighbour neighbour(std::uint32_t element, std::uint32_t face) const {
    return neighbours_[first_face_[element] + face];
  }
  /// A number that both elements of a face have for it.
  std::uint32_t face_index(std::uint32_t element, std::uint32_t face) const;

  /// Edges are ordered by their lower end, then by the higher one.
  EdgeEnds ends(std::uint32_t edge) const { return edges_[edge]; }
  /// The node in the middle of an edge; kNone in a mesh of linear shapes.
  std::uint32_t middle(std::uint32_t edge) const { return middles_[edge]; }
  /// Returns the edge between two nodes, or kNone.
  std::uint32_t edge_between(std::uint32_t a, std::uint32_t b) const;

  /// Elements of each edge and of each node, ascending.
  std::span<const std::uint32_t> elements_of_edge(std::uint32_t edge) const { return edge_elements_[edge]; }
  std::span<const std::uint32_t> elements_of_node(std::uint32_t node) const { return node_elements_[node]; }

 private:
  const Mesh* mesh_;
  std::vector<const Topology*> shape_of_;
  std::vector<std::span<const std::uint32_t>> nodes_of_;
  std::vector<EdgeEnds> edges_;
  std::vector<std::uint32_t> middles_;
  Rows element_edges_, edge_elements_, node_elements_;
  std::vector<std::uint32_t> first_face_;
  std::vector<FaceNeighbour> neighbours_;
};

}  // namespace tensormass::mesh
