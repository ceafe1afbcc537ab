#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/partition.h"

/// Which of two neighbouring nodes stores the block that couples them.
namespace tensormass::matrix {

/// The neighbours with which each node stores its edges: first those of its own patch ("inner"), then the others.
struct StoredEdges {
  std::vector<std::uint32_t> inner, all;  ///< [node] how many: of its own patch, and in total
  std::vector<std::uint32_t> items;       ///< the neighbours; those of a node start at mesh::Rows::offsets[node]

  std::span<const std::uint32_t> of(const mesh::Rows& neighbours, std::uint32_t node) const {
    return {items.data() + neighbours.offsets[node], all[node]};
  }
};

/// Storage::kEdges: gives each edge within a patch to one of its nodes, so that each node stores half of its edges, or
/// nearly so. Rows of a patch are then about equally long, which keeps slices free of padding. An edge between patches
/// is stored by both nodes.
StoredEdges share_edges(const mesh::Partition& partition, const mesh::Rows& neighbours);

/// Storage::kRows, kTiles: each node stores all of its edges, and counts all of them as inner.
StoredEdges whole_rows(const mesh::Rows& neighbours);

}  // namespace tensormass::matrix
