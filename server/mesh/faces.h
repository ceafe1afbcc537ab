#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>

#include "mesh/mesh.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {

/// The mesh nodes of a face, in the order of `Face`.
struct FaceNodes {
  std::uint32_t count = 0;
  std::array<std::uint32_t, kMaxFaceNodes> nodes{};  ///< kNone beyond `count`

  std::size_t size() const { return count; }
  const std::uint32_t* begin() const { return nodes.data(); }
  const std::uint32_t* end() const { return nodes.data() + count; }
  std::uint32_t operator[](std::size_t i) const { return nodes[i]; }
};

inline FaceNodes face_nodes(const Face& face, std::span<const std::uint32_t> element_nodes) {
  FaceNodes result{face.node_count, {}};
  result.nodes.fill(kNone);
  for (std::uint32_t i = 0; i < face.node_count; ++i) result.nodes[i] = element_nodes[face.nodes[i]];
  return result;
}

/// A face as one of its elements sees it.
struct ElementFace {
  std::array<std::uint32_t, kMaxFaceCorners> corners;  ///< mesh nodes, ascending, then kNone
  std::uint32_t element;
  std::uint32_t face;  ///< index into the shape's `Topology::faces`
};

/// Calls visit(faces with the same corners, their elements ascending) for every set of corners, in the order of the
/// lowest one. In a conforming mesh there are two of an inner face and one of a face on the boundary. O(n).
void match_faces(const Mesh& mesh, const std::function<void(std::span<const ElementFace>)>& visit);

}  // namespace tensormass::mesh
