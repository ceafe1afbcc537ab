#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "core/assert.h"
#include "mesh/mesh.h"

/// The topology of every element shape. A new shape is one entry in kShapes; the rest of server/mesh reads that table
/// and names no shape.
namespace tensormass::mesh {

inline constexpr std::size_t kMaxFaceNodes = 8;
inline constexpr std::size_t kMaxFaceCorners = 4;
inline constexpr std::size_t kMaxFaces = 6;

/// A face of an element: a triangle (3 nodes), a quadrilateral (4), a quadratic triangle (6) or a quadratic
/// quadrilateral (8).
///
/// Local nodes list the corners first, counter-clockwise seen from outside. Then come the middles of the sides; side i
/// runs from corner i to corner i + 1.
struct Face {
  std::uint8_t node_count = 0;
  std::array<std::uint8_t, kMaxFaceNodes> nodes{};

  constexpr bool is_quadratic() const { return node_count > kMaxFaceCorners; }
  constexpr std::uint8_t corner_count() const {
    return is_quadratic() ? static_cast<std::uint8_t>(node_count / 2) : node_count;
  }
};

/// Three nodes of a face, as indices into its nodes.
using FaceTriangle = std::array<std::uint8_t, 3>;

namespace detail {
inline constexpr std::array<FaceTriangle, 4> kTrianglesOfTriangle{{{0, 3, 5}, {3, 1, 4}, {5, 4, 2}, {3, 4, 5}}};
inline constexpr std::array<FaceTriangle, 6> kTrianglesOfQuadrilateral{
    {{0, 4, 7}, {4, 1, 5}, {5, 2, 6}, {7, 6, 3}, {4, 5, 6}, {4, 6, 7}}};
}  // namespace detail

/// Returns the plane triangles that approximate a quadratic face of 6 or 8 nodes: one at each corner, then those
/// between the middles of the sides.
constexpr std::span<const FaceTriangle> quadratic_face_triangles(std::size_t node_count) {
  if (node_count == 6) return detail::kTrianglesOfTriangle;
  return detail::kTrianglesOfQuadrilateral;
}

/// An edge of an element: its two corners, and the two faces that meet at it (indices into `Topology::faces`).
struct Edge {
  std::array<std::uint8_t, 2> nodes{};
  std::array<std::uint8_t, 2> faces{};
};

/// Four local nodes that span a tetrahedron. In an element wound as VTK says its volume is positive.
using Simplex = std::array<std::uint8_t, 4>;

/// Local node numbers follow VTK: the corners, then the middles of the edges. If a shape has mid-edge nodes, the one on
/// `edges[i]` is corner_count + i.
struct Topology {
  std::string_view name;
  std::uint32_t node_count = 0;
  std::uint32_t corner_count = 0;
  std::span<const Face> faces;
  std::span<const Edge> edges;
  /// A decomposition into tetrahedra, for point location. If quadrilateral faces are not plane, it differs from the
  /// element by slivers along them. In a strongly distorted element a tetrahedron may have negative volume.
  std::span<const Simplex> simplices;
  /// Corners with their three neighbours. The volume spanned has the sign of the Jacobian's determinant at the corner,
  /// and an element is admitted if all are positive. How much this test shows:
  ///
  ///   tetrahedron        the Jacobian is constant, so one frame is enough
  ///   pyramid            exact: up to a positive factor, det J is bilinear over the base, so its four corners suffice
  ///   wedge, hexahedron  the usual test; not exact. A test with unit cubes whose corners were moved at random by up to
  ///                      0.5 in each direction: 59 % were admitted. Of those, 0.4 % folded somewhere inside, but never
  ///                      at a point of 2×2×2 Gauss quadrature.
  std::span<const Simplex> corner_frames;

  constexpr bool has_mid_edge_nodes() const { return node_count > corner_count; }
};

namespace detail {

/// VTK_TETRA: (x1 − x0) · ((x2 − x0) × (x3 − x0)) > 0.
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

/// VTK_PYRAMID: the base 0 1 2 3 is counter-clockwise seen from the apex 4.
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

/// VTK_WEDGE, the base 0 1 2 counter-clockwise seen from the triangle 3 4 5: (x1 − x0) × (x2 − x0) · (x3 − x0) > 0.
/// VTK's documentation says the opposite (the normal of 0 1 2 points outward). But VTK's own shape functions, meshio,
/// Gmsh, CalculiX (C3D6) and scikit-fem then have a negative Jacobian.
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

/// VTK_HEXAHEDRON: the base 0 1 2 3 is counter-clockwise seen from the opposite face 4 5 6 7.
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
/// Kuhn's six tetrahedra around the diagonal 0 6.
inline constexpr std::array<Simplex, 6> kHexahedronSimplices{
    {{0, 1, 2, 6}, {0, 2, 3, 6}, {0, 3, 7, 6}, {0, 7, 4, 6}, {0, 4, 5, 6}, {0, 5, 1, 6}}};
inline constexpr std::array<Simplex, 8> kHexahedronCorners{
    {{0, 1, 3, 4}, {1, 2, 0, 5}, {2, 3, 1, 6}, {3, 0, 2, 7}, {4, 7, 5, 0}, {5, 4, 6, 1}, {6, 5, 7, 2}, {7, 6, 4, 3}}};

/// VTK_QUADRATIC_TETRA: corners and edges as in the linear tetrahedron.
inline constexpr std::array<Face, 4> kQuadraticTetrahedronFaces{{
    {6, {0, 2, 1, 6, 5, 4}},
    {6, {0, 1, 3, 4, 8, 7}},
    {6, {1, 2, 3, 5, 9, 8}},
    {6, {0, 3, 2, 7, 9, 6}},
}};
/// Four tetrahedra at the corners, and the octahedron between them, cut around its diagonal 4 9.
inline constexpr std::array<Simplex, 8> kQuadraticTetrahedronSimplices{
    {{0, 4, 6, 7}, {4, 1, 5, 8}, {6, 5, 2, 9}, {7, 8, 9, 3}, {4, 5, 6, 9}, {4, 8, 5, 9}, {4, 7, 8, 9}, {4, 6, 7, 9}}};

/// VTK_QUADRATIC_HEXAHEDRON: corners and edges as in the hexahedron.
inline constexpr std::array<Face, 6> kQuadraticHexahedronFaces{{
    {8, {0, 3, 2, 1, 11, 10, 9, 8}},
    {8, {4, 5, 6, 7, 12, 13, 14, 15}},
    {8, {0, 1, 5, 4, 8, 17, 12, 16}},
    {8, {1, 2, 6, 5, 9, 18, 13, 17}},
    {8, {2, 3, 7, 6, 10, 19, 14, 18}},
    {8, {3, 0, 4, 7, 11, 16, 15, 19}},
}};
/// Eight tetrahedra at the corners, and the cuboctahedron between them, cut into the tetrahedra from its corner 8 to
/// the triangles of its other faces.
inline constexpr std::array<Simplex, 22> kQuadraticHexahedronSimplices{
    {{0, 8, 11, 16},  {1, 9, 8, 17},   {2, 10, 9, 18},  {3, 11, 10, 19}, {4, 15, 12, 16}, {5, 12, 13, 17},
     {6, 13, 14, 18}, {7, 14, 15, 19}, {8, 9, 10, 18},  {8, 10, 11, 19}, {8, 12, 15, 16}, {8, 13, 12, 17},
     {8, 14, 13, 18}, {8, 15, 14, 19}, {8, 12, 13, 14}, {8, 12, 14, 15}, {8, 9, 18, 13},  {8, 9, 13, 17},
     {8, 10, 19, 14}, {8, 10, 14, 18}, {8, 11, 16, 15}, {8, 11, 15, 19}}};

}  // namespace detail

/// All shapes, in the order of `Shape`.
inline constexpr std::array<Topology, 6> kShapes{{
    {"tetrahedron", 4, 4, detail::kTetrahedronFaces, detail::kTetrahedronEdges, detail::kTetrahedronSimplices,
     detail::kTetrahedronSimplices},
    {"pyramid", 5, 5, detail::kPyramidFaces, detail::kPyramidEdges, detail::kPyramidSimplices, detail::kPyramidCorners},
    {"wedge", 6, 6, detail::kWedgeFaces, detail::kWedgeEdges, detail::kWedgeSimplices, detail::kWedgeCorners},
    {"hexahedron", 8, 8, detail::kHexahedronFaces, detail::kHexahedronEdges, detail::kHexahedronSimplices,
     detail::kHexahedronCorners},
    {"quadratic tetrahedron", 10, 4, detail::kQuadraticTetrahedronFaces, detail::kTetrahedronEdges,
     detail::kQuadraticTetrahedronSimplices, detail::kTetrahedronSimplices},
    {"quadratic hexahedron", 20, 8, detail::kQuadraticHexahedronFaces, detail::kHexahedronEdges,
     detail::kQuadraticHexahedronSimplices, detail::kHexahedronCorners},
}};

constexpr const Topology& topology(Shape shape) { return kShapes[static_cast<std::size_t>(shape)]; }

/// Returns the number of elements of a block.
inline std::uint32_t element_count(const ElementBlock& block) {
  return static_cast<std::uint32_t>(block.nodes.size() / topology(block.shape).node_count);
}

/// Returns the number of elements of all blocks.
inline std::uint32_t element_count(const Mesh& mesh) {
  std::uint32_t count = 0;
  for (const ElementBlock& block : mesh.blocks) count += element_count(block);
  return count;
}

/// Visits every element in the order of its index, which counts through the blocks.
///
///   visit(element index, topology, mesh nodes of the element)   is called once for each element
template <class Visitor>
void for_each_element(const Mesh& mesh, Visitor&& visit) {
  std::uint32_t element = 0;
  for (const ElementBlock& block : mesh.blocks) {
    const Topology& shape = topology(block.shape);
    TM_ASSERT(block.nodes.size() % shape.node_count == 0, "a block lists all nodes of each of its elements");
    const std::uint32_t* nodes = block.nodes.data();
    for (std::uint32_t i = 0; i < element_count(block); ++i, nodes += shape.node_count, ++element) {
      visit(element, shape, std::span<const std::uint32_t>(nodes, shape.node_count));
    }
  }
}

/// Returns views of the mesh nodes of every element, by element index. They are valid as long as the mesh is unchanged.
inline std::vector<std::span<const std::uint32_t>> element_nodes(const Mesh& mesh) {
  std::vector<std::span<const std::uint32_t>> nodes_of;
  nodes_of.reserve(element_count(mesh));
  for_each_element(
      mesh, [&](std::uint32_t, const Topology&, std::span<const std::uint32_t> nodes) { nodes_of.push_back(nodes); });
  return nodes_of;
}

/// The two ends of an edge, the lower node first.
using EdgeEnds = std::array<std::uint32_t, 2>;

/// Returns the ends of an element's edge. nodes: mesh nodes of the element.
inline EdgeEnds ends_of(const Edge& edge, std::span<const std::uint32_t> nodes) {
  const auto [low, high] = std::minmax(nodes[edge.nodes[0]], nodes[edge.nodes[1]]);
  return {low, high};
}

/// Returns six times the signed volume of a tetrahedron [m³]; positive in VTK node order.
inline double six_volumes(const Eigen::Vector3d& x0, const Eigen::Vector3d& x1, const Eigen::Vector3d& x2,
                          const Eigen::Vector3d& x3) {
  return (x1 - x0).dot((x2 - x0).cross(x3 - x0));
}

}  // namespace tensormass::mesh
