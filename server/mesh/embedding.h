#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// A point farther outside than this many times the longest edge of the nearest element is refused: it would swing on
/// a long lever instead of following the tissue.
inline constexpr double kMaxEmbeddingEdges = 2.0;

/// Points carried along by a mesh: point p is at Σ_k weights[p][k] · x(nodes[p][k]), in rest exactly where it was
/// given.
struct Embedding {
  std::vector<std::array<std::uint32_t, 4>> nodes;  ///< [point_count, 4] mesh nodes
  std::vector<std::array<double, 4>> weights;       ///< [point_count, 4] sum 1; negative for a point outside
  std::vector<std::uint32_t> elements;              ///< [point_count] containing, else nearest element
  double max_distance_m = 0.0;                      ///< of a point from the mesh
};

/// Finds the containing or else nearest tetrahedron (of an element's decomposition) of every point, by a tree of boxes.
/// Outside, the weights extrapolate. `what` names the points in errors, as "the skin of body 'liver'".
/// Errors: a point farther than kMaxEmbeddingEdges.
Result<Embedding> embed(const Mesh& mesh, std::span<const Eigen::Vector3d> points, std::string_view what);

}  // namespace tensormass::mesh
