#include "mesh/adjacency.h"

#include <algorithm>
#include <map>
#include <utility>

#include <fmt/format.h>

#include "mesh/shapes.h"

namespace tensormass::mesh {
namespace {

/// Inverts the relation "item → rows": returns the items of each row, ascending. Makes two passes: one counts, one
/// fills.
///
///   visit_all(f)   must call f(item, rows of the item) in ascending order of items. It is called twice and must visit
///                  the same both times
template <class VisitAll>
Rows invert(std::uint32_t row_count, VisitAll&& visit_all) {
  Rows rows;
  rows.offsets.assign(row_count + std::size_t{1}, 0);
  visit_all([&](std::uint32_t, std::span<const std::uint32_t> members) {
    for (const std::uint32_t row : members) ++rows.offsets[row + 1];
  });
  for (std::uint32_t row = 0; row < row_count; ++row) rows.offsets[row + 1] += rows.offsets[row];
  rows.items.resize(rows.offsets.back());
  std::vector<std::uint32_t> next(rows.offsets.begin(), rows.offsets.end() - 1);
  visit_all([&](std::uint32_t item, std::span<const std::uint32_t> members) {
    for (const std::uint32_t row : members) rows.items[next[row]++] = item;
  });
  return rows;
}

}  // namespace

Rows node_elements(const Mesh& mesh) {
  return invert(static_cast<std::uint32_t>(mesh.nodes.size()), [&](auto&& add) {
    for_each_element(mesh, [&](std::uint32_t element, const Topology&, std::span<const std::uint32_t> nodes) {
      add(element, nodes);
    });
  });
}

Rows node_neighbours(const Mesh& mesh) {
  return node_neighbours(static_cast<std::uint32_t>(mesh.nodes.size()), element_nodes(mesh));
}

Rows node_neighbours(std::uint32_t node_count, std::span<const std::span<const std::uint32_t>> nodes_of) {
  const Rows elements = invert(node_count, [&](auto&& add) {
    for (std::uint32_t element = 0; element < nodes_of.size(); ++element) add(element, nodes_of[element]);
  });
  Rows rows;
  rows.offsets.reserve(node_count + std::size_t{1});
  std::vector<std::uint32_t> seen_by(node_count, kNone);
  for (std::uint32_t node = 0; node < node_count; ++node) {
    const auto first = static_cast<std::ptrdiff_t>(rows.items.size());
    seen_by[node] = node;
    for (const std::uint32_t element : elements[node]) {
      for (const std::uint32_t other : nodes_of[element]) {
        if (seen_by[other] == node) continue;
        seen_by[other] = node;
        rows.items.push_back(other);
      }
    }
    std::sort(rows.items.begin() + first, rows.items.end());
    rows.offsets.push_back(static_cast<std::uint32_t>(rows.items.size()));
  }
  return rows;
}

Rows vertex_triangles(std::span<const Triangle> triangles, std::uint32_t vertex_count) {
  return invert(vertex_count, [&](auto&& add) {
    for (std::uint32_t i = 0; i < triangles.size(); ++i) add(i, triangles[i]);
  });
}

Result<std::vector<std::array<std::uint32_t, 3>>> triangle_neighbours(std::span<const Triangle> triangles,
                                                                      std::string_view what) {
  using DirectedEdge = std::pair<std::uint32_t, std::uint32_t>;  // from, to
  const auto edge_of = [&](std::size_t t, std::size_t c) {
    return DirectedEdge{triangles[t][c], triangles[t][(c + 1) % 3]};
  };
  std::map<DirectedEdge, std::uint32_t> edges;
  for (std::uint32_t t = 0; t < triangles.size(); ++t) {
    for (std::size_t c = 0; c < 3; ++c) {
      const DirectedEdge edge = edge_of(t, c);
      if (!edges.emplace(edge, t).second) {
        return invalid(
            fmt::format("{}: two triangles run along the edge from vertex {} to vertex {} in the same "
                        "direction; give a surface whose triangles all turn the same way",
                        what, edge.first, edge.second));
      }
    }
  }
  std::vector<std::array<std::uint32_t, 3>> neighbours(triangles.size());
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    for (std::size_t c = 0; c < 3; ++c) {
      const auto [from, to] = edge_of(t, c);
      const auto across = edges.find({to, from});
      if (across == edges.end()) {
        return invalid(
            fmt::format("{}: the surface is open at the edge between vertices {} and {}; a solid needs a closed "
                        "surface, whose triangles share their vertices",
                        what, from, to));
      }
      neighbours[t][c] = across->second;
    }
  }
  return neighbours;
}

}  // namespace tensormass::mesh
