#include "mesh/grid.h"

#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "core/limits.h"

namespace tensormass::mesh {
namespace {

/// The paths from corner 0 to corner 7 of a cell along one axis at a time (corner = x + 2 y + 4 z). The three odd
/// permutations of the axes have two middle corners exchanged, so that every tetrahedron is positively wound.
constexpr std::uint32_t kKuhn[6][4] = {
    {0, 1, 3, 7},  // x y z
    {0, 5, 1, 7},  // x z y
    {0, 3, 2, 7},  // y x z
    {0, 2, 6, 7},  // y z x
    {0, 4, 5, 7},  // z x y
    {0, 6, 4, 7},  // z y x
};

}  // namespace

Result<Mesh> make_grid(const Eigen::Vector3d& origin_m, const Eigen::Vector3d& size_m, std::uint32_t cells_x,
                       std::uint32_t cells_y, std::uint32_t cells_z) {
  const std::uint64_t cells[3] = {cells_x, cells_y, cells_z};
  double node_count = 1.0;  // as double: no product of three 32-bit numbers overflows it
  double element_count = std::size(kKuhn);
  for (int axis = 0; axis < 3; ++axis) {
    const char name = "xyz"[axis];
    if (cells[axis] == 0) return invalid(fmt::format("grid: cells_{} is 0; give at least 1", name));
    if (!(size_m[axis] > 0.0 && size_m[axis] <= limits::kMaxLength)) {
      return invalid(fmt::format("grid: size_m.{} is {}; give a length above 0 and up to {} m", name, size_m[axis],
                                 limits::kMaxLength));
    }
    if (!(std::abs(origin_m[axis]) <= limits::kMaxLength)) {
      return invalid(
          fmt::format("grid: origin_m.{} is {}; give one within ±{} m", name, origin_m[axis], limits::kMaxLength));
    }
    node_count *= static_cast<double>(cells[axis]) + 1.0;
    element_count *= static_cast<double>(cells[axis]);
  }
  if (node_count > limits::kMaxNodes || element_count > limits::kMaxElements) {
    return fail(
        ErrorCode::kResourceExhausted,
        fmt::format("grid: {} × {} × {} cells are {:.0f} nodes and {:.0f} elements; limits::kMaxNodes is {} and "
                    "limits::kMaxElements {}; use fewer cells",
                    cells_x, cells_y, cells_z, node_count, element_count, limits::kMaxNodes, limits::kMaxElements));
  }

  Mesh mesh;
  mesh.nodes.reserve(static_cast<std::size_t>(node_count));
  for (std::uint32_t k = 0; k <= cells_z; ++k) {
    for (std::uint32_t j = 0; j <= cells_y; ++j) {
      for (std::uint32_t i = 0; i <= cells_x; ++i) {
        const Eigen::Vector3d fraction(static_cast<double>(i) / cells_x, static_cast<double>(j) / cells_y,
                                       static_cast<double>(k) / cells_z);
        mesh.nodes.push_back(origin_m + size_m.cwiseProduct(fraction));
      }
    }
  }

  ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = Shape::kTetrahedron;
  block.nodes.reserve(4 * static_cast<std::size_t>(element_count));
  const std::uint32_t stride_y = cells_x + 1;
  const std::uint32_t stride_z = stride_y * (cells_y + 1);
  for (std::uint32_t k = 0; k < cells_z; ++k) {
    for (std::uint32_t j = 0; j < cells_y; ++j) {
      for (std::uint32_t i = 0; i < cells_x; ++i) {
        const std::uint32_t first = i + stride_y * j + stride_z * k;
        for (const auto& path : kKuhn) {
          for (const std::uint32_t corner : path) {
            block.nodes.push_back(first + (corner & 1) + stride_y * (corner >> 1 & 1) + stride_z * (corner >> 2));
          }
        }
      }
    }
  }
  return mesh;
}

}  // namespace tensormass::mesh
