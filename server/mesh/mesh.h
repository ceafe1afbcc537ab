#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Meshes on the host: double precision, the caller's node order.
///
/// `admit` (admission.h) checks a mesh from outside once. All other functions of this folder assume an admitted mesh.
namespace tensormass::mesh {

/// Element shapes, in the order in which physics/lists.h lists them. A shape's topology is one entry in shapes.h.
enum class Shape : std::uint8_t {
  kTetrahedron,
  kPyramid,
  kWedge,
  kHexahedron,
  kQuadraticTetrahedron,
  kQuadraticHexahedron
};

/// Elements of one shape.
struct ElementBlock {
  Shape shape = Shape::kTetrahedron;
  std::vector<std::uint32_t> nodes;  ///< [element_count, nodes of the shape], VTK node order
};

/// A volume mesh at rest. An element's index counts through the blocks in their order.
struct Mesh {
  std::vector<Eigen::Vector3d> nodes;  ///< [node_count] m, at rest
  std::vector<ElementBlock> blocks;
};

/// Three vertices, counter-clockwise seen from outside: indices into the vertices of the surface that holds the
/// triangle.
using Triangle = std::array<std::uint32_t, 3>;

/// An index that means "no such item".
inline constexpr std::uint32_t kNone = 0xFFFFFFFFu;

}  // namespace tensormass::mesh
