#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Nodes divided into compact patches of equal size, in an order that keeps neighbours close in memory.
///
/// Why: threads and GPU blocks each take a patch, so compact patches share few nodes; within a patch neighbours lie in
/// nearby cache lines.
///
///   order:     |          patch 0          |          patch 1          |     offsets = {0, 8, 16}, leaf_size 4
///              | leaf, leaf                | leaf, leaf                |     each leaf: ascending mesh nodes
struct Partition {
  std::vector<std::uint32_t> order;    ///< [node_count] the mesh node at each place
  std::vector<std::uint32_t> offsets;  ///< [patch_count + 1] patch p holds places [offsets[p], offsets[p + 1])
};

/// Divides nodes by recursive coordinate bisection: each cut is across the longest side of the bounding box. Needs
/// patch_count ≥ 1 and leaf_size ≥ 1. O(n log n).
///
/// Patch sizes differ by one node at most; a patch is empty only if there are more patches than nodes. Each patch is
/// bisected further down to leaves of `leaf_size` nodes, ascending within a leaf. Ties are broken by index, so the same
/// nodes give the same partition on every machine.
Partition partition(std::span<const Eigen::Vector3d> nodes, std::uint32_t patch_count, std::uint32_t leaf_size);

/// Orders any points by bisection without patches. Returns [point_count] the point at each place. Needs leaf_size ≥ 1.
std::vector<std::uint32_t> bisection_order(std::span<const Eigen::Vector3d> points, std::uint32_t leaf_size);

/// Returns how many of `count` points go to the first part of a cut; `count` itself if they form one leaf. The first
/// part is a multiple of `leaf_size`, so all leaves are full except the last.
constexpr std::uint32_t bisection_cut(std::uint32_t count, std::uint32_t leaf_size) {
  const std::uint32_t leaves = count / leaf_size + (count % leaf_size != 0 ? 1 : 0);
  return leaves <= 1 ? count : leaf_size * (leaves / 2 + leaves % 2);
}

}  // namespace tensormass::mesh
