#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <span>
#include <utility>
#include <vector>

#include "mesh/cut_surface.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// How the visible surface of a mesh changes while it is cut: triangles die, vertices and triangles are appended, and
/// nothing is ever numbered anew. Vertices and triangles are those of `boundary`, then appended ones.
class CutChanges {
 public:
  /// A vertex: a weighted sum of rows, at rest and deformed. Equal ones are one vertex.
  using Vertex = std::vector<std::pair<std::uint32_t, double>>;  // row, weight; rows ascend

  /// surface: `boundary` of the mesh as loaded
  explicit CutChanges(const Surface& surface);

  /// Takes the surface after a cut. O(surface).
  void take(const CutSurface& surface);

  const std::vector<std::uint32_t>& dead_triangles() const { return dead_; }  ///< ascending
  const std::vector<Vertex>& appended_vertices() const { return vertices_; }
  const std::vector<Triangle>& appended_triangles() const { return triangles_; }
  /// [appended triangle] 1: face of a cut, 0: outer surface
  const std::vector<std::uint8_t>& appended_is_cut() const { return is_cut_; }

 private:
  using Key = std::array<std::uint32_t, 4>;  // vertices, the lowest first; then is_cut
  static Key key_of(const Triangle& triangle, bool is_cut);
  std::uint32_t number_of(Vertex vertex);

  std::uint32_t loaded_vertices_ = 0, loaded_triangles_ = 0;
  std::map<std::uint32_t, std::uint32_t> vertex_of_node_;
  std::map<Vertex, std::uint32_t> numbers_;
  std::map<Key, std::uint32_t> alive_;  // triangle
  std::vector<std::uint32_t> dead_;
  std::vector<Vertex> vertices_;
  std::vector<Triangle> triangles_;
  std::vector<std::uint8_t> is_cut_;
};

}  // namespace tensormass::mesh
