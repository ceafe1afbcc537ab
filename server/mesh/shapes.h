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

inline constexpr std::size_t kMaxFaceNodes = 6;
inline constexpr std::size_t kMaxFaceCorners = 4;
inline constexpr std::size_t kMaxFaces = 6;

/// A face of an element: a triangle (3 nodes), a quadrilateral (4) or a quadratic triangle (6). Its local nodes are the
/// corners, counter-clockwise seen from outside, then the middles of its sides from corner i to corner i + 1.
struct Face {
  std::uint8_t node_count = 0;
  std::array<std::uint8_t, kMaxFaceNodes> nodes{};

  constexpr std::uint8_t corner_count() const { return node_count == 6 ? 3 : node_count; }
};

/// The plane triangles that stand for a quadratic triangle, in its nodes.
inline constexpr std::array<std::array<std::uint8_t, 3>, 4> kQuadraticFaceTriangles{
    {{0, 3, 5}, {3, 1, 4}, {5, 4, 2}, {3, 4, 5}}};

/// An edge of an element: its corners and the two faces that meet in it (indices into `Topology::faces`).
struct Edge {
  std::array<std::uint8_t, 2> nodes{};
  std::array<std::uint8_t, 2> faces{};
};

/// Four local nodes that span a tetrahedron of positive volume in a properly wound element.
using Simplex = std::array<std::uint8_t, 4>;

/// Local nodes are in VTK order: the corners, then the middles of the edges. The node in the middle of `edges[i]` is
/// corner_count + i, in a shape that has such nodes.
struct Topology {
  std::string_view name;
  std::uint32_t node_count = 0;
  std::uint32_t corner_count = 0;
  std::span<const Face> faces;
  std::span<const Edge> edges;
  /// A decomposition into tetrahedra, for point location. Where quadrilateral faces are not plane, it differs from the
  /// element by slivers along them, and a strongly distorted element may hold one of negative volume.
  std::span<const Simplex> simplices;
  /// A corner and its three neighbours: the edges to them have the determinant of the Jacobian there, up to a positive
  /// factor. An element is admitted if all are positive. In a tetrahedron they are all the same, so that one will do;
  /// in a pyramid the four of the base are exact (up to a positive factor det J is bilinear over the base). In wedge
  /// and hexahedron they are the usual test: of unit cubes whose corners are moved at random by up to 0.5 in each
  /// direction it admits 59 %, of which 0.4 % fold over somewhere inside, none of them at a point of 2×2×2 Gauss.
  std::span<const Simplex> corner_frames;

  constexpr bool has_mid_edge_nodes() const { return node_count > corner_count; }
};

namespace detail {

/// VTK_TETRA: (x1 - x0) · ((x2 - x0) × (x3 - x0)) > 0.
inline constexpr std::array<Face, 4> kTetrahedronFaces{{
    {3, {0, 2, 1}},
    {3, {0, 1, 3}},
    {3, {1, 2, 3}},
    {3, {0, 3, 2}},
}};
inline constexpr std::array<Edge, 6> kTetrahedronEdges{{
    {{0, 1}, {0, 1}},
    {{1, 2}, {0, 2}},
    {{0, 2}, {0, 3}},
    {{0, 3}, {1, 3}},
    {{1, 3}, {1, 2}},
    {{2, 3}, {2, 3}},
}};
inline constexpr std::array<Simplex, 1> kTetrahedronSimplices{{{0, 1, 2, 3}}};

/// VTK_PYRAMID: the base 0 1 2 3 counter-clockwise seen from the apex 4.
inline constexpr std::array<Face, 5> kPyramidFaces{{
    {4, {0, 3, 2, 1}},
    {3, {0, 1, 4}},
    {3, {1, 2, 4}},
    {3, {2, 3, 4}},
    {3, {3, 0, 4}},
}};
inline constexpr std::array<Edge, 8> kPyramidEdges{{
    {{0, 1}, {0, 1}},
    {{1, 2}, {0, 2}},
    {{2, 3}, {0, 3}},
    {{3, 0}, {0, 4}},
    {{0, 4}, {4, 1}},
    {{1, 4}, {1, 2}},
    {{2, 4}, {2, 3}},
    {{3, 4}, {3, 4}},
}};
inline constexpr std::array<Simplex, 2> kPyramidSimplices{{{0, 1, 2, 4}, {0, 2, 3, 4}}};
inline constexpr std::array<Simplex, 4> kPyramidCorners{{{0, 1, 3, 4}, {1, 2, 0, 4}, {2, 3, 1, 4}, {3, 0, 2, 4}}};

/// VTK_WEDGE with the base 0 1 2 counter-clockwise seen from the triangle 3 4 5: (x1 - x0) × (x2 - x0) · (x3 - x0) > 0.
/// VTK's documentation says the opposite (the normal of 0 1 2 points outward), but with VTK's own shape functions, and
/// in meshio, Gmsh, CalculiX (C3D6) and scikit-fem, that order has a negative Jacobian.
inline constexpr std::array<Face, 5> kWedgeFaces{{
    {3, {0, 2, 1}},
    {3, {3, 4, 5}},
    {4, {0, 1, 4, 3}},
    {4, {1, 2, 5, 4}},
    {4, {2, 0, 3, 5}},
}};
inline constexpr std::array<Edge, 9> kWedgeEdges{{
    {{0, 1}, {0, 2}},
    {{1, 2}, {0, 3}},
    {{2, 0}, {0, 4}},
    {{3, 4}, {1, 2}},
    {{4, 5}, {1, 3}},
    {{5, 3}, {1, 4}},
    {{0, 3}, {2, 4}},
    {{1, 4}, {2, 3}},
    {{2, 5}, {3, 4}},
}};
inline constexpr std::array<Simplex, 3> kWedgeSimplices{{{0, 1, 2, 3}, {1, 2, 3, 4}, {2, 3, 4, 5}}};
inline constexpr std::array<Simplex, 6> kWedgeCorners{
    {{0, 1, 2, 3}, {1, 2, 0, 4}, {2, 0, 1, 5}, {3, 5, 4, 0}, {4, 3, 5, 1}, {5, 4, 3, 2}}};

/// VTK_HEXAHEDRON: the base 0 1 2 3 counter-clockwise seen from the opposite face 4 5 6 7.
inline constexpr std::array<Face, 6> kHexahedronFaces{{
    {4, {0, 3, 2, 1}},
    {4, {4, 5, 6, 7}},
    {4, {0, 1, 5, 4}},
    {4, {1, 2, 6, 5}},
    {4, {2, 3, 7, 6}},
    {4, {3, 0, 4, 7}},
}};
inline constexpr std::array<Edge, 12> kHexahedronEdges{{
    {{0, 1}, {0, 2}},
    {{1, 2}, {0, 3}},
    {{2, 3}, {0, 4}},
    {{3, 0}, {0, 5}},
    {{4, 5}, {1, 2}},
    {{5, 6}, {1, 3}},
    {{6, 7}, {1, 4}},
    {{7, 4}, {1, 5}},
    {{0, 4}, {2, 5}},
    {{1, 5}, {2, 3}},
    {{2, 6}, {3, 4}},
    {{3, 7}, {4, 5}},
}};
/// About the diagonal 0 6 (Kuhn).
inline constexpr std::array<Simplex, 6> kHexahedronSimplices{
    {{0, 1, 2, 6}, {0, 2, 3, 6}, {0, 3, 7, 6}, {0, 7, 4, 6}, {0, 4, 5, 6}, {0, 5, 1, 6}}};
inline constexpr std::array<Simplex, 8> kHexahedronCorners{
    {{0, 1, 3, 4}, {1, 2, 0, 5}, {2, 3, 1, 6}, {3, 0, 2, 7}, {4, 7, 5, 0}, {5, 4, 6, 1}, {6, 5, 7, 2}, {7, 6, 4, 3}}};

/// VTK_QUADRATIC_TETRA: corners as the tetrahedron, whose edges it shares.
inline constexpr std::array<Face, 4> kQuadraticTetrahedronFaces{{
    {6, {0, 2, 1, 6, 5, 4}},
    {6, {0, 1, 3, 4, 8, 7}},
    {6, {1, 2, 3, 5, 9, 8}},
    {6, {0, 3, 2, 7, 9, 6}},
}};
/// Four at the corners, and the octahedron between them about its diagonal 4 9.
inline constexpr std::array<Simplex, 8> kQuadraticTetrahedronSimplices{
    {{0, 4, 6, 7}, {4, 1, 5, 8}, {6, 5, 2, 9}, {7, 8, 9, 3}, {4, 5, 6, 9}, {4, 8, 5, 9}, {4, 7, 8, 9}, {4, 6, 7, 9}}};

}  // namespace detail

/// All shapes, in the order of `Shape`.
inline constexpr std::array<Topology, 5> kShapes{{
    {"tetrahedron", 4, 4, detail::kTetrahedronFaces, detail::kTetrahedronEdges, detail::kTetrahedronSimplices,
     detail::kTetrahedronSimplices},
    {"pyramid", 5, 5, detail::kPyramidFaces, detail::kPyramidEdges, detail::kPyramidSimplices, detail::kPyramidCorners},
    {"wedge", 6, 6, detail::kWedgeFaces, detail::kWedgeEdges, detail::kWedgeSimplices, detail::kWedgeCorners},
    {"hexahedron", 8, 8, detail::kHexahedronFaces, detail::kHexahedronEdges, detail::kHexahedronSimplices,
     detail::kHexahedronCorners},
    {"quadratic tetrahedron", 10, 4, detail::kQuadraticTetrahedronFaces, detail::kTetrahedronEdges,
     detail::kQuadraticTetrahedronSimplices, detail::kTetrahedronSimplices},
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
