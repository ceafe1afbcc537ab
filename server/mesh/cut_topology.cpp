#include "mesh/cut_topology.h"

#include <algorithm>

#include "core/assert.h"
#include "mesh/faces.h"

namespace tensormass::mesh {

CutTopology::CutTopology(const Mesh& mesh)
    : mesh_(&mesh), nodes_of_(element_nodes(mesh)), node_elements_(mesh::node_elements(mesh)) {
  for_each_element(mesh, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    shape_of_.push_back(&shape);
    first_face_.push_back(static_cast<std::uint32_t>(neighbours_.size()));
    neighbours_.resize(neighbours_.size() + shape.faces.size());
    for (const Edge& edge : shape.edges) edges_.push_back(ends_of(edge, nodes));
  });
  std::sort(edges_.begin(), edges_.end());
  edges_.erase(std::unique(edges_.begin(), edges_.end()), edges_.end());

  middles_.assign(edges_.size(), kNone);
  for (std::uint32_t element = 0; element < element_count(); ++element) {
    const Topology& shape = this->shape(element);
    for (std::size_t i = 0; i < shape.edges.size(); ++i) {
      const auto [low, high] = ends_of(shape.edges[i], nodes(element));
      const std::uint32_t edge = edge_between(low, high);
      element_edges_.items.push_back(edge);
      if (shape.has_mid_edge_nodes()) middles_[edge] = nodes(element)[shape.corner_count + i];
    }
    element_edges_.offsets.push_back(static_cast<std::uint32_t>(element_edges_.items.size()));
  }

  edge_elements_.offsets.assign(edges_.size() + 1, 0);
  for (const std::uint32_t edge : element_edges_.items) ++edge_elements_.offsets[edge + 1];
  for (std::size_t i = 0; i < edges_.size(); ++i) edge_elements_.offsets[i + 1] += edge_elements_.offsets[i];
  edge_elements_.items.resize(element_edges_.items.size());
  std::vector<std::uint32_t> next(edge_elements_.offsets.begin(), edge_elements_.offsets.end() - 1);
  for (std::uint32_t element = 0; element < element_count(); ++element) {
    for (const std::uint32_t edge : edges(element)) edge_elements_.items[next[edge]++] = element;
  }

  match_faces(mesh, [&](std::span<const ElementFace> same) {
    if (same.size() != 2) return;
    for (std::size_t i = 0; i < 2; ++i) {
      neighbours_[first_face_[same[i].element] + same[i].face] = {same[1 - i].element, same[1 - i].face};
    }
  });
}

std::uint32_t CutTopology::face_index(std::uint32_t element, std::uint32_t face) const {
  const std::uint32_t own = first_face_[element] + face;
  const FaceNeighbour other = neighbours_[own];
  return other.element == kNone ? own : std::min(own, first_face_[other.element] + other.face);
}

std::uint32_t CutTopology::edge_between(std::uint32_t a, std::uint32_t b) const {
  const EdgeEnds ends{std::min(a, b), std::max(a, b)};
  const auto found = std::lower_bound(edges_.begin(), edges_.end(), ends);
  return found != edges_.end() && *found == ends ? static_cast<std::uint32_t>(found - edges_.begin()) : kNone;
}

}  // namespace tensormass::mesh
