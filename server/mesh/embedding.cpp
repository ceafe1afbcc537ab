#include "mesh/embedding.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include <fmt/format.h>
#include <Eigen/Geometry>

#include "mesh/admission.h"
#include "mesh/partition.h"
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

/// Returns the point of triangle abc nearest to p. It tells by the signs of six products to which vertex, edge or
/// interior region p projects (Ericson, Real-Time Collision Detection, 5.1.5).
Vector3d nearest_on_triangle(const Vector3d& p, const Vector3d& a, const Vector3d& b, const Vector3d& c) {
  const Vector3d ab = b - a, ac = c - a, ap = p - a;
  const double d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0.0 && d2 <= 0.0) return a;
  const Vector3d bp = p - b;
  const double d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0.0 && d4 <= d3) return b;
  const double vc = d1 * d4 - d3 * d2;
  if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) return a + d1 / (d1 - d3) * ab;
  const Vector3d cp = p - c;
  const double d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0.0 && d5 <= d6) return c;
  const double vb = d5 * d2 - d1 * d6;
  if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) return a + d2 / (d2 - d6) * ac;
  const double va = d3 * d6 - d5 * d4;
  if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0) return b + (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b);
  return a + (vb * ab + vc * ac) / (va + vb + vc);
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

/// A bounding box tree over cells, for nearest-cell queries.
///
/// Cells are sorted in bisection order (partition.h), and each box is cut where bisection_cut cut the order. A box
/// therefore covers a contiguous range of cells, and boxes are stored in depth-first order:
///
///   parts_:  [ root | left subtree ... | right subtree ... ]
///                     ^ root + 1         ^ root.right
class Tree {
 public:
  explicit Tree(std::vector<Cell> cells) {
    std::vector<Vector3d> centers(cells.size());
    std::transform(cells.begin(), cells.end(), centers.begin(), [](const Cell& cell) -> Vector3d {
      return 0.25 * (cell.corners[0] + cell.corners[1] + cell.corners[2] + cell.corners[3]);
    });
    cells_.reserve(cells.size());
    for (const std::uint32_t i : bisection_order(centers, kLeafSize)) cells_.push_back(cells[i]);
    build(0, static_cast<std::uint32_t>(cells_.size()));
  }

  /// Returns the cell that contains the point, or else the nearest.
  Nearest nearest(const Vector3d& point) const {
    Nearest best;
    visit(0, point, best);
    return best;
  }

 private:
  static constexpr std::uint32_t kLeafSize = 4;

  struct Part {
    Eigen::AlignedBox3d box;
    std::uint32_t first = 0;
    std::uint32_t count = 0;  // number of cells in a leaf; 0 for an inner box
    std::uint32_t right = 0;  // index of the right child; the left child follows its parent
  };

  /// Appends the box over cells [first, first + count) and those below it; returns its index.
  std::uint32_t build(std::uint32_t first, std::uint32_t count) {
    const auto index = static_cast<std::uint32_t>(parts_.size());
    parts_.emplace_back();
    const std::uint32_t cut = bisection_cut(count, kLeafSize);
    if (cut == count) {
      Part& leaf = parts_[index];
      leaf.first = first;
      leaf.count = count;
      for (std::uint32_t i = first; i < first + count; ++i) {
        for (const Vector3d& corner : cells_[i].corners) leaf.box.extend(corner);
      }
      return index;
    }
    const std::uint32_t left = build(first, cut);
    const std::uint32_t right = build(first + cut, count - cut);
    parts_[index].right = right;
    parts_[index].box = parts_[left].box.merged(parts_[right].box);
    return index;
  }

  /// Offers all cells below a box that could be better than `best`; visits the nearer child first.
  void visit(std::uint32_t index, const Vector3d& point, Nearest& best) const {
    const Part& part = parts_[index];
    if (part.count > 0) {
      for (std::uint32_t i = part.first; i < part.first + part.count; ++i) best.offer(cells_[i], point);
      return;
    }
    std::uint32_t near = index + 1, far = part.right;
    double near_distance = parts_[near].box.squaredExteriorDistance(point);
    double far_distance = parts_[far].box.squaredExteriorDistance(point);
    if (far_distance < near_distance) {
      std::swap(near, far);
      std::swap(near_distance, far_distance);
    }
    if (worth(near_distance, best)) visit(near, point, best);
    if (worth(far_distance, best)) visit(far, point, best);
  }

  /// Returns whether a box at this distance may hold a better cell. Once a cell contains the point, no other is better.
  /// The slack of 1e-12 is that of Nearest::offer.
  static bool worth(double squared_distance, const Nearest& best) {
    return best.squared_distance > 0.0 && squared_distance <= best.squared_distance * (1.0 + 1e-12);
  }

  std::vector<Cell> cells_;
  std::vector<Part> parts_;
};

}  // namespace

Result<Embedding> embed(const Mesh& mesh, std::span<const Vector3d> points, std::string_view what) {
  const Tree tree(cells_of(mesh));
  Embedding embedding;
  embedding.nodes.reserve(points.size());
  embedding.weights.reserve(points.size());
  embedding.elements.reserve(points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Nearest nearest = tree.nearest(points[i]);
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
