#include "model/tetrahedron_rings.h"

#include <algorithm>
#include <cmath>
#include <span>
#include <tuple>

#include "mesh/shapes.h"
#include "model/clusters.h"

namespace tensormass::model {

namespace {

constexpr std::size_t kLeastTetrahedra = 2;

constexpr const mesh::Topology& kTetrahedron = mesh::topology(mesh::Shape::kTetrahedron);

/// An edge of a tetrahedron.
struct EdgeOfElement {
  mesh::EdgeEnds ends;
  std::uint32_t element;
};

/// An edge and its tetrahedra, in ascending order.
struct SharedEdge {
  std::int64_t length;  ///< in units of the longest edge × 1e-6
  std::span<const EdgeOfElement> elements;
};

std::vector<EdgeOfElement> edges_of_tetrahedra(const mesh::Mesh& mesh) {
  std::vector<EdgeOfElement> edges;
  mesh::for_each_element(mesh,
                         [&](std::uint32_t element, const mesh::Topology& shape, std::span<const std::uint32_t> nodes) {
                           if (&shape != &kTetrahedron) return;
                           for (const mesh::Edge& edge : shape.edges)
                             edges.push_back({mesh::ends_of(edge, nodes), element});
                         });
  std::sort(edges.begin(), edges.end(), [](const EdgeOfElement& a, const EdgeOfElement& b) {
    return std::tie(a.ends, a.element) < std::tie(b.ends, b.element);
  });
  return edges;
}

/// Returns the edges, the longest first.
std::vector<SharedEdge> sorted_edges(const mesh::Mesh& mesh, std::span<const EdgeOfElement> of_elements) {
  std::vector<double> lengths;
  std::vector<SharedEdge> edges;
  double longest = 0;
  for (std::size_t begin = 0, end = 0; begin < of_elements.size(); begin = end) {
    const auto& ends = of_elements[begin].ends;
    while (end < of_elements.size() && of_elements[end].ends == ends) ++end;
    edges.push_back({0, of_elements.subspan(begin, end - begin)});
    lengths.push_back((mesh.nodes[ends[1]] - mesh.nodes[ends[0]]).norm());
    longest = std::max(longest, lengths.back());
  }
  for (std::size_t i = 0; i < edges.size(); ++i) edges[i].length = std::llround(1e6 * lengths[i] / longest);
  std::stable_sort(edges.begin(), edges.end(),
                   [](const SharedEdge& a, const SharedEdge& b) { return a.length > b.length; });
  return edges;
}

bool same_material(const Material& a, const Material& b) {
  return same_dilatation(a, b) && a.parameters == b.parameters;
}

}  // namespace

std::vector<ElementRing> ring_tetrahedra(const ReadBody& body) {
  if (body.quadrature != physics::Quadrature::kSelective) return {};
  const std::vector<EdgeOfElement> of_elements = edges_of_tetrahedra(body.mesh);
  const auto nodes_of = mesh::element_nodes(body.mesh);
  std::vector<bool> taken(mesh::element_count(body.mesh), false);
  std::vector<ElementRing> rings;
  const std::vector<SharedEdge> edges = sorted_edges(body.mesh, of_elements);
  for (std::size_t size = kMaxClusterElements; size >= kLeastTetrahedra; --size) {
    for (const SharedEdge& edge : edges) {
      ElementRing ring;
      std::vector<std::uint32_t> nodes;
      for (const EdgeOfElement& one : edge.elements) {
        if (taken[one.element] || ring.size() == kMaxClusterElements) continue;
        if (!ring.empty() && !same_material(body.material(ring[0]), body.material(one.element))) continue;
        std::vector<std::uint32_t> with = nodes;
        for (const std::uint32_t node : nodes_of[one.element]) {
          if (std::find(with.begin(), with.end(), node) == with.end()) with.push_back(node);
        }
        if (with.size() > kClusterNodes) continue;
        nodes = with;
        ring.push_back(one.element);
      }
      if (ring.size() < size) continue;
      for (const std::uint32_t element : ring) taken[element] = true;
      rings.push_back(std::move(ring));
    }
  }
  std::sort(rings.begin(), rings.end());
  return rings;
}

}  // namespace tensormass::model
