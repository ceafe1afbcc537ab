#include "mesh/faces.h"

#include <algorithm>
#include <tuple>

namespace tensormass::mesh {
namespace {

/// Visits every face of every element.
///
///   visit(ElementFace)   is called in the order of elements, and of Topology::faces within an element
template <class Visitor>
void for_each_face(const Mesh& mesh, Visitor&& visit) {
  for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (std::uint32_t f = 0; f < shape.faces.size(); ++f) {
      const Face& local = shape.faces[f];
      ElementFace face{{}, element, f};
      face.corners.fill(kNone);
      for (std::uint32_t i = 0; i < local.corner_count(); ++i) face.corners[i] = nodes[local.nodes[i]];
      std::sort(face.corners.begin(), face.corners.end());
      visit(face);
    }
  });
}

}  // namespace

// Faces are bucketed by their lowest corner (a counting sort), then sorted within these short buckets.
void match_faces(const Mesh& mesh, const std::function<void(std::span<const ElementFace>)>& visit) {
  std::vector<std::uint32_t> offsets(mesh.nodes.size() + 1, 0);
  for_each_face(mesh, [&](const ElementFace& face) { ++offsets[face.corners[0] + 1]; });
  for (std::size_t node = 0; node < mesh.nodes.size(); ++node) offsets[node + 1] += offsets[node];
  std::vector<ElementFace> faces(offsets.back());
  std::vector<std::uint32_t> next(offsets.begin(), offsets.end() - 1);
  for_each_face(mesh, [&](const ElementFace& face) { faces[next[face.corners[0]]++] = face; });

  for (std::size_t node = 0; node < mesh.nodes.size(); ++node) {
    const auto last = faces.begin() + offsets[node + 1];
    auto face = faces.begin() + offsets[node];
    std::sort(face, last, [](const ElementFace& a, const ElementFace& b) {
      return std::tie(a.corners, a.element) < std::tie(b.corners, b.element);
    });
    while (face != last) {
      const auto end =
          std::find_if(face, last, [&](const ElementFace& other) { return other.corners != face->corners; });
      visit({face, end});
      face = end;
    }
  }
}

}  // namespace tensormass::mesh
