#include "model/tetrahedron_rings.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <numeric>
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

/// Calls visit(ends, element) for each edge of each linear tetrahedron, elements in ascending order.
template <class Visit>
void for_each_edge(const mesh::Mesh& mesh, Visit&& visit) {
  mesh::for_each_element(mesh,
                         [&](std::uint32_t element, const mesh::Topology& shape, std::span<const std::uint32_t> nodes) {
                           if (&shape != &kTetrahedron) return;
                           for (const mesh::Edge& edge : shape.edges) visit(mesh::ends_of(edge, nodes), element);
                         });
}

/// Returns the edges of all elements, ascending by their ends and then by element. Few edges have the same lower end,
/// so a sort of each such list takes a fraction of one of all.
std::vector<EdgeOfElement> edges_of_tetrahedra(const mesh::Mesh& mesh) {
  std::vector<std::size_t> ends(mesh.nodes.size() + 1, 0);  // [node] where the list of that lower end ends
  for_each_edge(mesh, [&](const mesh::EdgeEnds& edge, std::uint32_t) { ++ends[edge[0] + 1]; });
  std::partial_sum(ends.begin(), ends.end(), ends.begin());
  std::vector<EdgeOfElement> edges(ends.back());
  for_each_edge(mesh, [&](const mesh::EdgeEnds& edge, std::uint32_t element) {
    edges[ends[edge[0]]++] = {edge, element};
  });
  std::size_t begin = 0;
  for (const std::size_t end : std::span(ends).first(mesh.nodes.size())) {
    std::sort(edges.begin() + std::ptrdiff_t(begin), edges.begin() + std::ptrdiff_t(end),
              [](const EdgeOfElement& a, const EdgeOfElement& b) {
                return std::tie(a.ends[1], a.element) < std::tie(b.ends[1], b.element);
              });
    begin = end;
  }
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

/// Whether two elements of a body have the same law and moduli.
bool same_material(const ReadBody& body, std::uint32_t first, std::uint32_t second) {
  const Material &a = body.material(first), &b = body.material(second);
  return &a == &b || (same_dilatation(a, b) && a.parameters == b.parameters);
}

}  // namespace

std::vector<ElementRing> ring_tetrahedra(const ReadBody& body) {
  if (body.quadrature != physics::Quadrature::kSelective) return {};
  const std::vector<EdgeOfElement> of_elements = edges_of_tetrahedra(body.mesh);
  const auto nodes_of = mesh::element_nodes(body.mesh);
  std::vector<bool> taken(mesh::element_count(body.mesh), false);
  std::vector<ElementRing> rings;
  ElementRing ring;
  std::vector<std::uint32_t> nodes;
  const std::vector<SharedEdge> edges = sorted_edges(body.mesh, of_elements);
  for (std::size_t size = kMaxClusterElements; size >= kLeastTetrahedra; --size) {
    for (const SharedEdge& edge : edges) {
      const auto is_free = [&](const EdgeOfElement& one) { return !taken[one.element]; };
      if (std::size_t(std::ranges::count_if(edge.elements, is_free)) < size) continue;
      ring.clear();
      nodes.clear();
      for (const EdgeOfElement& one : edge.elements) {
        if (taken[one.element] || ring.size() == kMaxClusterElements) continue;
        if (!ring.empty() && !same_material(body, ring[0], one.element)) continue;
        const std::size_t before = nodes.size();
        for (const std::uint32_t node : nodes_of[one.element]) {
          if (std::find(nodes.begin(), nodes.end(), node) == nodes.end()) nodes.push_back(node);
        }
        if (nodes.size() > kClusterNodes) {
          nodes.resize(before);
          continue;
        }
        ring.push_back(one.element);
      }
      if (ring.size() < size) continue;
      for (const std::uint32_t element : ring) taken[element] = true;
      rings.push_back(ring);
    }
  }
  std::sort(rings.begin(), rings.end());
  return rings;
}

}  // namespace tensormass::model
