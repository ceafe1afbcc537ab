#include "mesh/surface.h"

#include <algorithm>

#include "mesh/shapes.h"

namespace tensormass::mesh {
namespace {

/// Visits the triangles of a boundary face, in the order of the face.
///
///   visit(i, j, k)   is called for each triangle with indices into face.nodes
template <class Visitor>
void for_each_triangle(const BoundaryFace& face, Visitor&& visit) {
  const FaceNodes& nodes = face.nodes;
  if (nodes.size() == 3) visit(0, 1, 2);
  if (nodes.size() == 4) {
    const auto first = static_cast<std::uint32_t>(std::min_element(nodes.begin(), nodes.end()) - nodes.begin());
    visit(first, (first + 1) % 4, (first + 2) % 4);
    visit(first, (first + 2) % 4, (first + 3) % 4);
  }
  if (nodes.size() > kMaxFaceCorners) {
    for (const auto& [i, j, k] : quadratic_face_triangles(nodes.size())) visit(i, j, k);
  }
}

/// A directed edge of a triangle. Its key is the same in both directions.
struct HalfEdge {
  std::uint64_t key;
  std::uint32_t triangle;
  std::uint32_t side;
};

}  // namespace

std::vector<std::array<std::uint32_t, 3>> edge_neighbours(std::span<const Triangle> triangles) {
  // Sorts all directed edges by key and pairs those that run in opposite directions.
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

std::vector<BoundaryFace> boundary_faces(const Mesh& mesh) {
  std::vector<std::uint8_t> flags(element_count(mesh), 0);  // bit f is set if face f is on the boundary
  static_assert(kMaxFaces <= 8);
  match_faces(mesh, [&](std::span<const ElementFace> same) {
    if (same.size() == 1) flags[same[0].element] |= static_cast<std::uint8_t>(1u << same[0].face);
  });
  std::vector<BoundaryFace> faces;
  for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (std::uint32_t f = 0; f < shape.faces.size(); ++f) {
      if ((flags[element] >> f & 1) == 0) continue;
      faces.push_back({element, f, face_nodes(shape.faces[f], nodes)});
    }
  });
  return faces;
}

std::vector<Triangle> face_triangles(const FaceNodes& nodes) {
  std::vector<Triangle> triangles;
  for_each_triangle({kNone, kNone, nodes}, [&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
    triangles.push_back({nodes[i], nodes[j], nodes[k]});
  });
  return triangles;
}

Surface boundary(const Mesh& mesh) { return surface_of(mesh, boundary_faces(mesh)); }

Surface surface_of(const Mesh& mesh, std::span<const BoundaryFace> faces) {
  Surface surface;
  for (const BoundaryFace& face : faces) {
    const FaceNodes& nodes = face.nodes;
    for_each_triangle(face, [&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
      surface.triangles.push_back({nodes[i], nodes[j], nodes[k]});
      surface.triangle_elements.push_back(face.element);
    });
  }

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
