#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>

#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// The mesh nodes of a face, in the order of Face::nodes.
struct FaceNodes {
  std::uint32_t count = 0;
  std::array<std::uint32_t, kMaxFaceNodes> nodes{};  ///< kNone beyond `count`

  std::size_t size() const { return count; }
  const std::uint32_t* begin() const { return nodes.data(); }
  const std::uint32_t* end() const { return nodes.data() + count; }
  std::uint32_t operator[](std::size_t i) const { return nodes[i]; }
};

/// Returns the mesh nodes of an element's local face.
inline FaceNodes face_nodes(const Face& face, std::span<const std::uint32_t> element_nodes) {
  FaceNodes result{face.node_count, {}};
  result.nodes.fill(kNone);
  for (std::uint32_t i = 0; i < face.node_count; ++i) result.nodes[i] = element_nodes[face.nodes[i]];
  return result;
}

/// A face together with one element that it belongs to.
struct ElementFace {
  std::array<std::uint32_t, kMaxFaceCorners> corners;  ///< mesh nodes, ascending, then kNone
  std::uint32_t element;
  std::uint32_t face;  ///< index into the shape's `Topology::faces`
};

/// Groups the faces of all elements by their corners. O(n).
///
///   visit(faces)   is called once for each set of corners, in the order of the lowest corner. `faces` are those with
///                  these corners, their elements ascending; valid during the call only.
///
/// In a conforming mesh a group has two faces inside the mesh and one on the boundary.
void match_faces(const Mesh& mesh, const std::function<void(std::span<const ElementFace>)>& visit);

}  // namespace tensormass::mesh
