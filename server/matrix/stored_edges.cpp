#include "matrix/stored_edges.h"

#include <numeric>

#include "core/assert.h"
#include "core/offsets.h"

namespace tensormass::matrix {

StoredEdges share_edges(const mesh::Partition& partition, const mesh::Rows& neighbours) {
  const std::size_t node_count = partition.order.size();
  TM_ASSERT(neighbours.size() == node_count, "each node has a list of neighbours");
  TM_ASSERT(!partition.offsets.empty(), "the last patch has an end");
  assert_offsets(partition.offsets, partition.offsets.size() - 1, node_count);
  std::vector<std::uint32_t> place(node_count), patch(node_count);
  for (std::uint32_t p = 0; p + 1 < partition.offsets.size(); ++p) {
    for (std::uint32_t i = partition.offsets[p]; i < partition.offsets[p + 1]; ++i) {
      place[partition.order[i]] = i;
      patch[partition.order[i]] = p;
    }
  }
  StoredEdges stored{
      std::vector<std::uint32_t>(node_count, 0), {}, std::vector<std::uint32_t>(neighbours.items.size())};
  const auto store = [&](std::uint32_t node, std::uint32_t other) {
    TM_ASSERT(stored.inner[node] < neighbours[node].size(), "a node stores edges to its neighbours only");
    stored.items[neighbours.offsets[node] + stored.inner[node]++] = other;
  };
  std::vector<std::uint32_t> degree(node_count, 0);  // neighbours within the patch
  for (std::uint32_t node = 0; node < node_count; ++node) {
    for (const std::uint32_t other : neighbours[node]) degree[node] += patch[other] == patch[node] ? 1 : 0;
  }
  // Nodes decide in order about their edges to later nodes; edges to earlier nodes are decided already. A node takes an
  // edge if it cannot reach its half otherwise, or if it lacks edges and the other node has its half.
  std::vector<std::uint32_t> later;
  for (const std::uint32_t node : partition.order) {
    later.clear();
    for (const std::uint32_t other : neighbours[node]) {
      if (patch[other] == patch[node] && place[other] > place[node]) later.push_back(other);
    }
    const std::uint32_t goal = (degree[node] + 1) / 2;
    for (std::size_t i = 0; i < later.size(); ++i) {
      const std::uint32_t other = later[i];
      const bool wants = stored.inner[node] < goal, must = stored.inner[node] + (later.size() - i) <= goal;
      const bool other_is_full = stored.inner[other] >= (degree[other] + 1) / 2;
      if (must || (wants && other_is_full)) {
        store(node, other);
      } else {
        store(other, node);
      }
    }
  }
  TM_ASSERT(2 * std::accumulate(stored.inner.begin(), stored.inner.end(), std::size_t{0}) ==
                std::accumulate(degree.begin(), degree.end(), std::size_t{0}),
            "each edge within a patch is stored once");
  stored.all = stored.inner;
  for (std::uint32_t node = 0; node < node_count; ++node) {
    for (const std::uint32_t other : neighbours[node]) {
      if (patch[other] != patch[node]) stored.items[neighbours.offsets[node] + stored.all[node]++] = other;
    }
  }
  return stored;
}

StoredEdges whole_rows(const mesh::Rows& neighbours) {
  StoredEdges stored;
  stored.items = neighbours.items;
  for (std::uint32_t node = 0; node < neighbours.size(); ++node) {
    stored.all.push_back(static_cast<std::uint32_t>(neighbours[node].size()));
  }
  stored.inner = stored.all;
  return stored;
}

}  // namespace tensormass::matrix
