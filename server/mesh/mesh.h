#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "core/result.h"

/// Meshes as the host sees them, in double precision and in the caller's own node order.
namespace tensormass::mesh {

/// Element shapes. A shape's topology is one entry in `shapes.h`.
enum class Shape : std::uint8_t { kTetrahedron };

/// Elements of one shape.
struct ElementBlock {
  Shape shape = Shape::kTetrahedron;
  std::vector<std::uint32_t> nodes;  ///< [element_count, nodes of the shape], VTK node order
};

struct Mesh {
  std::vector<Eigen::Vector3d> nodes;  ///< [node_count] m, at rest
  std::vector<ElementBlock> blocks;
};

/// A triangulated surface. Indices are into `Mesh::nodes` for a boundary, into own vertices for a skin.
using Triangle = std::array<std::uint32_t, 3>;

}  // namespace tensormass::mesh
