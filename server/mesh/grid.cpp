#include "mesh/grid.h"

#include <algorithm>
#include <initializer_list>
#include <utility>

#include <fmt/format.h>

#include "core/limits.h"
#include "mesh/shapes.h"

namespace tensormass::mesh {
namespace {

/// Number of a cell's centre in the tables below. A cell's corner (x, y, z), each 0 or 1, has the number x + 2 y + 4 z.
constexpr std::uint8_t kCentre = 8;

using Cut = std::span<const std::uint8_t>;  // corners of a cell's elements, element by element

/// The six paths from corner 0 to corner 7 along one axis at a time (Kuhn). In the three odd permutations of the axes
/// the two middle corners are exchanged, so that every tetrahedron has positive volume.
constexpr std::uint8_t kTetrahedra[] = {
    0, 1, 3, 7,  // x y z
    0, 5, 1, 7,  // x z y
    0, 3, 2, 7,  // y x z
    0, 2, 6, 7,  // y z x
    0, 4, 5, 7,  // z x y
    0, 6, 4, 7,  // z y x
};
constexpr std::uint8_t kPyramids[] = {
    0, 1, 3, 2, kCentre,  // z = 0
    4, 6, 7, 5, kCentre,  // z = 1
    0, 4, 5, 1, kCentre,  // y = 0
    2, 3, 7, 6, kCentre,  // y = 1
    0, 2, 6, 4, kCentre,  // x = 0
    1, 5, 7, 3, kCentre,  // x = 1
};
constexpr std::uint8_t kWedges[] = {0, 1, 3, 4, 5, 7, 0, 3, 2, 4, 7, 6};
constexpr std::uint8_t kHexahedron[] = {0, 1, 3, 2, 4, 5, 7, 6};

/// How each shape cuts a cell, in the order of `Shape`.
constexpr Cut kCuts[] = {kTetrahedra, kPyramids, kWedges, kHexahedron, kTetrahedra, kHexahedron};
static_assert(std::size(kCuts) == kShapes.size());

/// Returns which points of the lattice with half the spacing are the middles of edges. A point's parity p has the bits
/// of its odd coordinates: x + 2 y + 4 z. Bit p of the result is set if points of that parity are.
std::uint32_t parities_of_middles(Cut cut, const Topology& shape) {
  std::uint32_t parities = 0;
  for (; shape.has_mid_edge_nodes() && !cut.empty(); cut = cut.subspan(shape.corner_count)) {
    for (const Edge& edge : shape.edges) parities |= 1u << (cut[edge.nodes[0]] ^ cut[edge.nodes[1]]);
  }
  return parities;
}

/// A lattice of counts[0] × counts[1] × counts[2] points, numbered with x fastest.
class Lattice {
 public:
  explicit Lattice(std::array<std::uint32_t, 3> counts) : counts_(counts) {}
  std::uint32_t index(std::uint32_t i, std::uint32_t j, std::uint32_t k) const {
    return i + counts_[0] * (j + counts_[1] * k);
  }
  std::size_t size() const { return std::size_t{counts_[0]} * counts_[1] * counts_[2]; }
  /// Visits every point in the order of its index.
  ///
  ///   visit(i, j, k)   is called with the point's coordinates in the lattice
  template <class Visitor>
  void for_each(Visitor&& visit) const {
    for (std::uint32_t k = 0; k < counts_[2]; ++k) {
      for (std::uint32_t j = 0; j < counts_[1]; ++j) {
        for (std::uint32_t i = 0; i < counts_[0]; ++i) visit(i, j, k);
      }
    }
  }

 private:
  std::array<std::uint32_t, 3> counts_;
};

}  // namespace

Result<Mesh> make_grid(const Eigen::Vector3d& origin_m, const Eigen::Vector3d& size_m, std::uint32_t cells_x,
                       std::uint32_t cells_y, std::uint32_t cells_z, Shape shape) {
  const Topology& cell_shape = topology(shape);
  const Cut cut = kCuts[static_cast<std::size_t>(shape)];
  const bool centres = std::find(cut.begin(), cut.end(), kCentre) != cut.end();
  const std::uint32_t middles = parities_of_middles(cut, cell_shape);
  const std::array<std::uint32_t, 3> cells{cells_x, cells_y, cells_z};
  // Counts are double, because a product of three 32-bit numbers overflows an integer.
  double cell_count = 1.0;
  for (std::size_t axis = 0; axis < 3; ++axis) {
    const char name = "xyz"[axis];
    if (cells[axis] == 0) return invalid(fmt::format("grid: cells_{} is 0; give at least 1", name));
    const auto i = static_cast<Eigen::Index>(axis);
    if (!(size_m[i] > 0.0 && size_m[i] <= limits::kMaxLength)) {
      return invalid(fmt::format("grid: size_m.{} is {}; give a length above 0 and up to {} m", name, size_m[i],
                                 limits::kMaxLength));
    }
    if (!(std::abs(origin_m[i]) <= limits::kMaxLength)) {
      return invalid(
          fmt::format("grid: origin_m.{} is {}; give one within ±{} m", name, origin_m[i], limits::kMaxLength));
    }
    cell_count *= cells[axis];
  }
  double node_count = centres ? cell_count : 0.0;
  for (std::uint32_t parity = 0; parity < 8; ++parity) {
    if (parity != 0 && (middles >> parity & 1) == 0) continue;
    double count = 1.0;  // points with these odd coordinates
    for (std::size_t axis = 0; axis < 3; ++axis) count *= cells[axis] + ((parity >> axis & 1) != 0 ? 0.0 : 1.0);
    node_count += count;
  }
  const double element_count = cell_count * static_cast<double>(cut.size() / cell_shape.corner_count);
  if (node_count > limits::kMaxNodes || element_count > limits::kMaxElements) {
    return fail(
        ErrorCode::kResourceExhausted,
        fmt::format("grid: {} × {} × {} cells are {:.0f} nodes and {:.0f} elements; limits::kMaxNodes is {} and "
                    "limits::kMaxElements {}; use fewer cells",
                    cells_x, cells_y, cells_z, node_count, element_count, limits::kMaxNodes, limits::kMaxElements));
  }

  // Positions are counted in half cells, so that corners, cell centres and edge middles all have integer positions.
  const Eigen::Array3d half_cells(2.0 * cells_x, 2.0 * cells_y, 2.0 * cells_z);
  Mesh mesh;
  mesh.nodes.reserve(static_cast<std::size_t>(node_count));
  const auto add = [&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
    mesh.nodes.push_back(origin_m + (size_m.array() * (Eigen::Array3d(i, j, k) / half_cells)).matrix());
  };
  const Lattice corners({cells_x + 1, cells_y + 1, cells_z + 1});
  const Lattice all_cells(cells);
  corners.for_each([&](std::uint32_t i, std::uint32_t j, std::uint32_t k) { add(2 * i, 2 * j, 2 * k); });
  if (centres) {
    all_cells.for_each(
        [&](std::uint32_t i, std::uint32_t j, std::uint32_t k) { add(2 * i + 1, 2 * j + 1, 2 * k + 1); });
  }
  // Each point of the lattice with half the spacing is a corner, the middle of exactly one edge, or no node.
  const Lattice halves({2 * cells_x + 1, 2 * cells_y + 1, 2 * cells_z + 1});
  std::vector<std::uint32_t> node_of_half;
  if (middles != 0) {
    node_of_half.reserve(halves.size());
    halves.for_each([&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
      const std::uint32_t parity = (i & 1) | (j & 1) << 1 | (k & 1) << 2;
      const bool middle = (middles >> parity & 1) != 0;
      const auto next = static_cast<std::uint32_t>(mesh.nodes.size());
      node_of_half.push_back(parity == 0 ? corners.index(i / 2, j / 2, k / 2) : middle ? next : kNone);
      if (middle) add(i, j, k);
    });
  }

  ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = shape;
  block.nodes.reserve(cell_shape.node_count * static_cast<std::size_t>(element_count));
  all_cells.for_each([&](std::uint32_t i, std::uint32_t j, std::uint32_t k) {
    const auto node = [&](std::uint8_t corner) {
      if (corner == kCentre) return static_cast<std::uint32_t>(corners.size()) + all_cells.index(i, j, k);
      return corners.index(i + (corner & 1), j + (corner >> 1 & 1), k + (corner >> 2));
    };
    for (Cut rest = cut; !rest.empty(); rest = rest.subspan(cell_shape.corner_count)) {
      for (const std::uint8_t corner : rest.first(cell_shape.corner_count)) block.nodes.push_back(node(corner));
      if (middles == 0) continue;
      for (const Edge& edge : cell_shape.edges) {
        const std::uint32_t a = rest[edge.nodes[0]], b = rest[edge.nodes[1]];
        block.nodes.push_back(node_of_half[halves.index(2 * i + (a & 1) + (b & 1), 2 * j + (a >> 1 & 1) + (b >> 1 & 1),
                                                        2 * k + (a >> 2) + (b >> 2))]);
      }
    }
  });
  return mesh;
}

}  // namespace tensormass::mesh
