#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Largest distance of a point from the mesh, in longest edges of the nearest tetrahedron that elements are cut into. A
/// point farther away is refused: it would swing on a long lever instead of following the tissue.
inline constexpr double kMaxEmbeddingEdges = 2.0;

/// Points attached to a mesh: point p is at Σ_k weights[p][k] · x(nodes[p][k]). At rest this gives back the point's own
/// position.
struct Embedding {
  std::vector<std::array<std::uint32_t, 4>> nodes;  ///< [point_count, 4] mesh nodes
  std::vector<std::array<double, 4>> weights;       ///< [point_count, 4] sum 1; negative for a point outside
  std::vector<std::uint32_t> elements;  ///< [point_count] the element that contains the point, or else the nearest
  double max_distance_m = 0.0;          ///< largest distance of a point from the mesh [m]
};

/// Attaches each point to the tetrahedron that contains it, or else to the nearest one, whose weights then extrapolate.
/// Elements of other shapes are cut into tetrahedra (Topology::simplices).
///
/// Searches a bounding box tree. The mesh must be admitted. `what` names the points in errors, for example "the skin of
/// body 'liver'". Errors: a point farther away than kMaxEmbeddingEdges allows.
Result<Embedding> embed(const Mesh& mesh, std::span<const Eigen::Vector3d> points, std::string_view what);

}  // namespace tensormass::mesh
