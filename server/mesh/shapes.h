#pragma once

#include <array>
#include <cassert>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "mesh/mesh.h"

/// The topology of every element shape. A new shape is one entry here; the rest of server/mesh reads this table and
/// knows no shape by name.
namespace tensormass::mesh {

inline constexpr std::size_t kMaxFaceNodes = 4;

/// A face of an element: its local nodes, counter-clockwise seen from outside.
struct Face {
  std::uint8_t node_count = 0;
  std::array<std::uint8_t, kMaxFaceNodes> nodes{};
};

/// An edge of an element with the two faces that meet in it (indices into `Topology::faces`).
struct Edge {
  std::array<std::uint8_t, 2> nodes{};
  std::array<std::uint8_t, 2> faces{};
};

/// Four local nodes with a positive volume in a properly wound element.
using Simplex = std::array<std::uint8_t, 4>;

struct Topology {
  std::string_view name;
  std::uint32_t node_count = 0;
  std::span<const Face> faces;
  std::span<const Edge> edges;
  /// A decomposition into tetrahedra: volume, winding and point location go through it.
  std::span<const Simplex> simplices;
};

namespace detail {

/// Tetrahedron in VTK node order: (x1 - x0) · ((x2 - x0) × (x3 - x0)) > 0.
inline constexpr std::array<Face, 4> kTetrahedronFaces{{
    {3, {0, 2, 1}},
    {3, {0, 1, 3}},
    {3, {1, 2, 3}},
    {3, {0, 3, 2}},
}};
inline constexpr std::array<Edge, 6> kTetrahedronEdges{{
    {{0, 1}, {0, 1}},
    {{0, 2}, {0, 3}},
    {{0, 3}, {1, 3}},
    {{1, 2}, {0, 2}},
    {{1, 3}, {1, 2}},
    {{2, 3}, {2, 3}},
}};
inline constexpr std::array<Simplex, 1> kTetrahedronSimplices{{{0, 1, 2, 3}}};

}  // namespace detail

/// All shapes, in the order of `Shape`.
inline constexpr std::array<Topology, 1> kShapes{{
    {"tetrahedron", 4, detail::kTetrahedronFaces, detail::kTetrahedronEdges, detail::kTetrahedronSimplices},
}};

constexpr const Topology& topology(Shape shape) { return kShapes[static_cast<std::size_t>(shape)]; }

inline std::uint32_t element_count(const ElementBlock& block) {
  return static_cast<std::uint32_t>(block.nodes.size() / topology(block.shape).node_count);
}

/// Elements of all blocks. An element's index counts through the blocks in their order.
inline std::uint32_t element_count(const Mesh& mesh) {
  std::uint32_t count = 0;
  for (const ElementBlock& block : mesh.blocks) count += element_count(block);
  return count;
}

/// Calls visit(element index, topology, nodes of the element) for every element in the order of its index.
template <class Visitor>
void for_each_element(const Mesh& mesh, Visitor&& visit) {
  std::uint32_t element = 0;
  for (const ElementBlock& block : mesh.blocks) {
    const Topology& shape = topology(block.shape);
    assert(block.nodes.size() % shape.node_count == 0);
    const std::uint32_t* nodes = block.nodes.data();
    for (std::uint32_t i = 0; i < element_count(block); ++i, nodes += shape.node_count, ++element) {
      visit(element, shape, std::span<const std::uint32_t>(nodes, shape.node_count));
    }
  }
}

/// The nodes of every element, by its index; valid as long as the mesh stands.
inline std::vector<std::span<const std::uint32_t>> element_nodes(const Mesh& mesh) {
  std::vector<std::span<const std::uint32_t>> nodes_of;
  nodes_of.reserve(element_count(mesh));
  for_each_element(
      mesh, [&](std::uint32_t, const Topology&, std::span<const std::uint32_t> nodes) { nodes_of.push_back(nodes); });
  return nodes_of;
}

/// Six times the signed volume of a tetrahedron; positive in VTK node order [m³].
inline double six_volumes(const Eigen::Vector3d& x0, const Eigen::Vector3d& x1, const Eigen::Vector3d& x2,
                          const Eigen::Vector3d& x3) {
  return (x1 - x0).dot((x2 - x0).cross(x3 - x0));
}

}  // namespace tensormass::mesh
