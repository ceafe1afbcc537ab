#include "mesh/surface.h"

#include <algorithm>

#include "mesh/shapes.h"

namespace tensormass::mesh {
namespace {

/// A face as one of its elements sees it. Two elements share a face if the keys are equal.
struct HalfFace {
  std::array<std::uint32_t, kMaxFaceNodes> key;  ///< its nodes, ascending, then kNone
  std::uint32_t element;
  std::uint32_t face;
};

template <class Visitor>
void for_each_half_face(const Mesh& mesh, Visitor&& visit) {
  for_each_element(mesh,
                   [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> element_nodes) {
                     for (std::uint32_t face = 0; face < shape.faces.size(); ++face) {
                       const Face& corners = shape.faces[face];
                       HalfFace half{{}, element, face};
                       half.key.fill(kNone);
                       for (std::uint32_t i = 0; i < corners.node_count; ++i) {
                         half.key[i] = element_nodes[corners.nodes[i]];
                       }
                       std::sort(half.key.begin(), half.key.end());
                       visit(half);
                     }
                   });
}

/// One flag an element: bit f is set if its face f is on the boundary.
///
/// Faces are collected by their lowest node (a counting sort) and compared within these short lists.
std::vector<std::uint8_t> boundary_faces(const Mesh& mesh) {
  std::vector<std::uint32_t> offsets(mesh.nodes.size() + 1, 0);
  for_each_half_face(mesh, [&](const HalfFace& half) { ++offsets[half.key[0] + 1]; });
  for (std::size_t node = 0; node < mesh.nodes.size(); ++node) offsets[node + 1] += offsets[node];
  std::vector<HalfFace> halves(offsets.back());
  std::vector<std::uint32_t> next(offsets.begin(), offsets.end() - 1);
  for_each_half_face(mesh, [&](const HalfFace& half) { halves[next[half.key[0]]++] = half; });

  std::vector<std::uint8_t> flags(element_count(mesh), 0);
  for (std::size_t node = 0; node < mesh.nodes.size(); ++node) {
    const auto first = halves.begin() + offsets[node];
    const auto last = halves.begin() + offsets[node + 1];
    std::sort(first, last, [](const HalfFace& a, const HalfFace& b) { return a.key < b.key; });
    for (auto half = first; half != last;) {
      const auto end = std::find_if(half, last, [&](const HalfFace& other) { return other.key != half->key; });
      if (end - half == 1) flags[half->element] |= static_cast<std::uint8_t>(1u << half->face);
      half = end;
    }
  }
  return flags;
}

/// A directed edge of a triangle, found by its undirected key.
struct HalfEdge {
  std::uint64_t key;
  std::uint32_t triangle;
  std::uint32_t side;
};

std::vector<std::array<std::uint32_t, 3>> edge_neighbours(const std::vector<Triangle>& triangles) {
  std::vector<HalfEdge> edges;
  edges.reserve(3 * triangles.size());
  for (std::uint32_t triangle = 0; triangle < triangles.size(); ++triangle) {
    for (std::uint32_t side = 0; side < 3; ++side) {
      const auto [low, high] = std::minmax(triangles[triangle][side], triangles[triangle][(side + 1) % 3]);
      edges.push_back({std::uint64_t{low} << 32 | high, triangle, side});
    }
  }
  std::sort(edges.begin(), edges.end(), [](const HalfEdge& a, const HalfEdge& b) { return a.key < b.key; });

  std::vector<std::array<std::uint32_t, 3>> neighbours(triangles.size(), {kNone, kNone, kNone});
  for (auto edge = edges.begin(); edge != edges.end();) {
    const auto end = std::find_if(edge, edges.end(), [&](const HalfEdge& other) { return other.key != edge->key; });
    const auto start_of = [&](const HalfEdge& e) { return triangles[e.triangle][e.side]; };
    if (end - edge == 2 && start_of(edge[0]) != start_of(edge[1])) {
      neighbours[edge[0].triangle][edge[0].side] = edge[1].triangle;
      neighbours[edge[1].triangle][edge[1].side] = edge[0].triangle;
    }
    edge = end;
  }
  return neighbours;
}

}  // namespace

Surface boundary(const Mesh& mesh) {
  const std::vector<std::uint8_t> flags = boundary_faces(mesh);
  Surface surface;
  for_each_element(mesh,
                   [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> element_nodes) {
                     for (std::uint32_t face = 0; face < shape.faces.size(); ++face) {
                       if ((flags[element] >> face & 1) == 0) continue;
                       const Face& corners = shape.faces[face];
                       const auto node = [&](std::uint32_t i) { return element_nodes[corners.nodes[i]]; };
                       for (std::uint32_t i = 2; i < corners.node_count; ++i) {  // a fan about the first corner
                         surface.triangles.push_back({node(0), node(i - 1), node(i)});
                         surface.triangle_elements.push_back(element);
                       }
                     }
                   });

  std::vector<std::uint32_t> vertex_of(mesh.nodes.size(), kNone);
  for (const Triangle& triangle : surface.triangles) {
    for (const std::uint32_t node : triangle) vertex_of[node] = 0;
  }
  for (std::uint32_t node = 0; node < mesh.nodes.size(); ++node) {
    if (vertex_of[node] == kNone) continue;
    vertex_of[node] = static_cast<std::uint32_t>(surface.nodes.size());
    surface.nodes.push_back(node);
  }
  for (Triangle& triangle : surface.triangles) {
    for (std::uint32_t& vertex : triangle) vertex = vertex_of[vertex];
  }
  surface.neighbours = edge_neighbours(surface.triangles);
  surface.vertex_triangles = vertex_triangles(surface.triangles, static_cast<std::uint32_t>(surface.nodes.size()));
  return surface;
}

}  // namespace tensormass::mesh
