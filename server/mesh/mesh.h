#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include <Eigen/Core>
#include <Eigen/Geometry>

/// Meshes as the host sees them, in double precision and in the caller's own node order.
///
/// A mesh from outside goes through `admit` (admission.h) once; every other function of this folder takes an admitted
/// mesh and asserts no more than that.
namespace tensormass::mesh {

/// Element shapes, in the order in which physics/lists.h lists them. A shape's topology is one entry in shapes.h.
enum class Shape : std::uint8_t { kTetrahedron, kPyramid, kWedge, kHexahedron, kQuadraticTetrahedron };

/// Elements of one shape.
struct ElementBlock {
  Shape shape = Shape::kTetrahedron;
  std::vector<std::uint32_t> nodes;  ///< [element_count, nodes of the shape], VTK node order
};

struct Mesh {
  std::vector<Eigen::Vector3d> nodes;  ///< [node_count] m, at rest
  std::vector<ElementBlock> blocks;
};

/// Three vertices, counter-clockwise seen from outside. Indices are into the vertices of the surface that holds it.
using Triangle = std::array<std::uint32_t, 3>;

/// "None" where an index is expected.
inline constexpr std::uint32_t kNone = 0xFFFFFFFFu;

}  // namespace tensormass::mesh
