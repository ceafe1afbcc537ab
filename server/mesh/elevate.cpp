#include "mesh/elevate.h"

#include <algorithm>
#include <map>
#include <utility>

#include <fmt/format.h>

#include "mesh/adjacency.h"
#include "mesh/problem.h"

namespace tensormass::mesh {
namespace {

constexpr const Topology& kLinear = topology(Shape::kTetrahedron);
constexpr const Topology& kQuadratic = topology(Shape::kQuadraticTetrahedron);

Result<void> check_shapes(const Mesh& mesh, std::string_view where) {
  Problem other;
  for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t>) {
    if (&shape == &kLinear || &shape == &kQuadratic) return;
    other.add([&] {
      return fmt::format("{}: element {} is of shape {}, and only tetrahedra can be made quadratic", where, element,
                         shape.name);
    });
  });
  if (other.count == 0) return {};
  return invalid(other.text("mesh the body with tetrahedra, or leave the field out"));
}

/// Numbers the middles of edges. In a linear tetrahedron all pairs of nodes are edges, so the edges at a node lead to
/// its neighbours.
class Middles {
 public:
  /// linear: a mesh of linear tetrahedra. given: edges that have a node in the middle already.
  Middles(const Mesh& linear, const std::map<EdgeEnds, std::uint32_t>& given)
      : neighbours_(node_neighbours(linear)), node_(neighbours_.items.size(), kNone) {
    auto next = static_cast<std::uint32_t>(linear.nodes.size());
    for (std::uint32_t low = 0; low < neighbours_.size(); ++low) {
      for (std::uint32_t at = neighbours_.offsets[low]; at < neighbours_.offsets[low + 1]; ++at) {
        const EdgeEnds edge{low, neighbours_.items[at]};
        if (edge[1] < low) continue;
        if (const auto found = given.find(edge); found != given.end()) {
          node_[at] = found->second;
        } else {
          node_[at] = next++;
          added.push_back(edge);
        }
      }
    }
  }
  std::uint32_t operator()(const EdgeEnds& edge) const {
    const auto begin = neighbours_.items.begin();
    const auto found =
        std::lower_bound(begin + neighbours_.offsets[edge[0]], begin + neighbours_.offsets[edge[0] + 1], edge[1]);
    return node_[static_cast<std::size_t>(found - begin)];
  }

  std::vector<EdgeEnds> added;  ///< in the order of the new nodes

 private:
  Rows neighbours_;
  std::vector<std::uint32_t> node_;  ///< [item of neighbours_] the node in the middle; kNone towards lower neighbours
};

}  // namespace

Result<ElevatedMesh> elevate(Mesh mesh, std::string_view where, std::size_t max_nodes) {
  TM_RETURN_IF_ERROR(check_shapes(mesh, where));
  std::map<EdgeEnds, std::uint32_t> given;
  Mesh linear{std::move(mesh.nodes), {}};
  for (const ElementBlock& block : mesh.blocks) {
    if (block.shape == Shape::kTetrahedron) {
      linear.blocks.push_back(block);
      continue;
    }
    const std::span<const std::uint32_t> all(block.nodes);
    for (std::size_t first = 0; first < all.size(); first += kQuadratic.node_count) {
      const auto nodes = all.subspan(first, kQuadratic.node_count);
      for (std::size_t e = 0; e < kQuadratic.edges.size(); ++e) {
        given.emplace(ends_of(kQuadratic.edges[e], nodes), nodes[kQuadratic.corner_count + e]);
      }
    }
  }
  Middles middles(linear, given);
  mesh.nodes = std::move(linear.nodes);
  if (mesh.nodes.size() + middles.added.size() > max_nodes) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{}: the mesh has {} nodes and {} edges, so {} nodes as quadratic elements; "
                            "limits::kMaxNodes is {}; use a coarser mesh",
                            where, mesh.nodes.size(), middles.added.size(), mesh.nodes.size() + middles.added.size(),
                            max_nodes));
  }
  for (const EdgeEnds& edge : middles.added) mesh.nodes.push_back(0.5 * (mesh.nodes[edge[0]] + mesh.nodes[edge[1]]));
  for (ElementBlock& block : mesh.blocks) {
    if (block.shape != Shape::kTetrahedron) continue;
    ElementBlock quadratic{Shape::kQuadraticTetrahedron, {}};
    quadratic.nodes.reserve(std::size_t{element_count(block)} * kQuadratic.node_count);
    const std::span<const std::uint32_t> all(block.nodes);
    for (std::size_t first = 0; first < all.size(); first += kLinear.node_count) {
      const auto corners = all.subspan(first, kLinear.node_count);
      quadratic.nodes.insert(quadratic.nodes.end(), corners.begin(), corners.end());
      for (const Edge& edge : kQuadratic.edges) quadratic.nodes.push_back(middles(ends_of(edge, corners)));
    }
    block = std::move(quadratic);
  }
  return ElevatedMesh{std::move(mesh), std::move(middles.added)};
}

}  // namespace tensormass::mesh
