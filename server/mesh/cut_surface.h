#pragma once

#include <cstdint>
#include <vector>

#include "mesh/cut.h"
#include "mesh/surface.h"

namespace tensormass::mesh {

/// The visible surface of a mesh that is being cut: the outer skin, kept to the edge of the cuts, and both faces of
/// each cut.
///
/// Each edge has exactly two triangles, which run along it in opposite directions, if that is so for the mesh's own
/// boundary. A vertex is a weighted sum of rows, at rest and deformed. Where a cut ends inside the material, its two
/// faces share their vertices.
struct CutSurface {
  /// Vertex v: rows[i] by weights[i], i from offsets[v] to offsets[v + 1]. Weights sum to 1.
  std::vector<std::uint32_t> offsets{0};
  std::vector<std::uint32_t> rows;
  std::vector<double> weights;

  std::vector<Triangle> triangles;               ///< indices of vertices, counter-clockwise seen from outside
  std::vector<std::uint32_t> triangle_elements;  ///< [triangle]
  std::vector<std::uint32_t> triangle_parts;     ///< [triangle] index into Cut::parts, kNone: the element is whole
  std::vector<std::uint8_t> triangle_is_cut;     ///< [triangle] 1: face of a cut, 0: outer skin
  /// Edges that had four triangles, because a cut is closed there on both sides. Each was given a vertex in its middle.
  std::uint32_t divided_edges = 0;

  std::uint32_t vertex_count() const { return static_cast<std::uint32_t>(offsets.size() - 1); }
  /// Returns the position of a vertex [m]. row_positions_m: [row]
  Eigen::Vector3d position(std::uint32_t vertex, std::span<const Eigen::Vector3d> row_positions_m) const;
};

/// Returns whether an edge of a face is cut.
bool has_cut_edge(const ElementCut& cut, const Face& face);

/// Returns the rest position of each row [m]: its node's.
std::vector<Eigen::Vector3d> row_positions(const Cut& cut);

/// Builds the whole visible surface: at load, for a snapshot, for tests. Allocates and takes O(mesh) time. An edit
/// between steps uses sheet_triangles and face_triangles of the changed elements instead.
CutSurface visible_surface(const Cut& cut);

}  // namespace tensormass::mesh
