#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Nodes cut into compact patches of equal size, and put in an order that keeps neighbours close in memory.
struct Partition {
  std::vector<std::uint32_t> order;    ///< [node_count] the mesh node in each place
  std::vector<std::uint32_t> offsets;  ///< [patch_count + 1] patch p holds the places [offsets[p], offsets[p + 1])
};

/// Recursive coordinate bisection across the longest side of the bounding box. The sizes of any two patches differ by
/// one node at most; a patch is empty only if there are more patches than nodes. Within a patch the bisection goes on
/// down to leaves of `leaf_size` nodes, in ascending order inside a leaf. Ties are broken by index: the same nodes give
/// the same partition on every machine. O(n log n). Takes patch_count and leaf_size of at least 1.
Partition partition(const Mesh& mesh, std::uint32_t patch_count, std::uint32_t leaf_size);

/// The order alone, of any points: [point_count] the point in each place.
std::vector<std::uint32_t> bisection_order(std::span<const Eigen::Vector3d> points, std::uint32_t leaf_size);

/// Where the bisection cuts `count` points in two; `count` itself if they are a leaf. The first part is a multiple of
/// `leaf_size`, so that every leaf of a patch but the last is full.
constexpr std::uint32_t bisection_cut(std::uint32_t count, std::uint32_t leaf_size) {
  const std::uint32_t leaves = count / leaf_size + (count % leaf_size != 0 ? 1 : 0);
  return leaves <= 1 ? count : leaf_size * (leaves / 2 + leaves % 2);
}

}  // namespace tensormass::mesh
