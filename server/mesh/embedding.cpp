#include "mesh/embedding.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>

#include "mesh/admission.h"
#include "mesh/box_tree.h"
#include "mesh/shapes.h"

/// Point location for embedding.
///
/// A skin may have as many vertices as the mesh has nodes, so testing every element for each vertex is too slow. The
/// mesh is cut into tetrahedra ("cells"), because a point's barycentric weights in a cell are linear and need no
/// iteration. A tree of boxes over the cells then answers each query in about log n steps:
///
///   elements ──cut──► cells ──bisection order──► tree ──nearest(point)──► cell, weights, distance
///
/// A point outside the mesh takes the nearest cell and extrapolates.
namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

/// A tetrahedron with what its barycentric coordinates need. For k > 0, weight_k = gradient_k · (x − x_0); weight_0 is
/// 1 minus the others.
struct Cell {
  std::array<std::uint32_t, 4> nodes;
  std::uint32_t element;
  std::array<Vector3d, 4> corners;
  std::array<Vector3d, 4> gradients;  // [1/m] of the weights

  std::array<double, 4> weights(const Vector3d& point) const {
    const Vector3d r = point - corners[0];
    std::array<double, 4> w{0.0, gradients[1].dot(r), gradients[2].dot(r), gradients[3].dot(r)};
    w[0] = 1.0 - w[1] - w[2] - w[3];
    return w;
  }

  double longest_edge_m() const {
    double squared = 0.0;
    for (int i = 1; i < 4; ++i) {
      for (int j = 0; j < i; ++j) squared = std::max(squared, (corners[i] - corners[j]).squaredNorm());
    }
    return std::sqrt(squared);
  }
};

/// Cuts each element into its shape's tetrahedra and drops the degenerate ones.
std::vector<Cell> cells_of(const Mesh& mesh) {
  std::vector<Cell> cells;
  for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Simplex& simplex : shape.simplices) {
      Cell cell;
      cell.element = element;
      for (int i = 0; i < 4; ++i) {
        cell.nodes[i] = nodes[simplex[i]];
        cell.corners[i] = mesh.nodes[cell.nodes[i]];
      }
      const Vector3d a = cell.corners[1] - cell.corners[0];
      const Vector3d b = cell.corners[2] - cell.corners[0];
      const Vector3d c = cell.corners[3] - cell.corners[0];
      const double six_volume = a.dot(b.cross(c));
      // The decomposition of a distorted element may hold a flat or inverted tetrahedron. It can be dropped: the
      // element's other tetrahedra cover the same space.
      if (six_volume < kMinRelativeVolume * std::pow(cell.longest_edge_m(), 3)) continue;
      cell.gradients[1] = b.cross(c) / six_volume;
      cell.gradients[2] = c.cross(a) / six_volume;
      cell.gradients[3] = a.cross(b) / six_volume;
      cell.gradients[0] = -(cell.gradients[1] + cell.gradients[2] + cell.gradients[3]);
      cells.push_back(cell);
    }
  });
  return cells;
}

/// The nearest cell found so far.
///
/// A point outside the mesh is often equally near to several cells that touch. Among those the cell with the greatest
/// smallest weight wins, because it extrapolates least.
struct Nearest {
  double squared_distance = std::numeric_limits<double>::infinity();
  double least_weight = -std::numeric_limits<double>::infinity();
  const Cell* cell = nullptr;
  std::array<double, 4> weights{};

  /// Replaces the best cell if the candidate is nearer, or equally near and extrapolates less.
  void offer(const Cell& candidate, const Vector3d& point) {
    const std::array<double, 4> w = candidate.weights(point);
    const double least = *std::min_element(w.begin(), w.end());
    double squared = 0.0;
    if (least < 0.0) {
      squared = std::numeric_limits<double>::infinity();
      for (int i = 0; i < 4; ++i) {
        if (w[i] >= 0.0) continue;  // only a face that the point is in front of can be nearest
        const Vector3d near = nearest_on_triangle(point, candidate.corners[(i + 1) % 4], candidate.corners[(i + 2) % 4],
                                                  candidate.corners[(i + 3) % 4]);
        squared = std::min(squared, (point - near).squaredNorm());
      }
    }
    const double slack = 1e-12 * squared;  // distances within rounding count as equal
    if (squared > squared_distance + slack) return;
    if (squared >= squared_distance - slack && least <= least_weight) return;
    squared_distance = squared;
    least_weight = least;
    cell = &candidate;
    weights = w;
  }
};

}  // namespace

Result<Embedding> embed(const Mesh& mesh, std::span<const Vector3d> points, std::string_view what) {
  const BoxTree<Cell> tree(cells_of(mesh));
  Embedding embedding;
  embedding.nodes.reserve(points.size());
  embedding.weights.reserve(points.size());
  embedding.elements.reserve(points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const auto nearest = tree.nearest<Nearest>(points[i]);
    const double distance_m = std::sqrt(nearest.squared_distance);
    const double limit_m = kMaxEmbeddingEdges * nearest.cell->longest_edge_m();
    if (!(distance_m <= limit_m)) {
      return invalid(fmt::format(
          "point {} of {} at ({}, {}, {}) is {:.3g} m outside of the mesh, nearest to element {}; the limit "
          "there is {:.3g} m ({} of its longest edges); align the two or remesh",
          i, what, points[i].x(), points[i].y(), points[i].z(), distance_m, nearest.cell->element, limit_m,
          kMaxEmbeddingEdges));
    }
    embedding.nodes.push_back(nearest.cell->nodes);
    embedding.weights.push_back(nearest.weights);
    embedding.elements.push_back(nearest.cell->element);
    embedding.max_distance_m = std::max(embedding.max_distance_m, distance_m);
  }
  return embedding;
}

}  // namespace tensormass::mesh
