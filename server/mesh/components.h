#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <numeric>
#include <vector>

namespace tensormass::mesh {

/// Connected components of a mesh: union-find over nodes with path halving. The root of a component is its lowest node.
class Components {
 public:
  explicit Components(std::size_t node_count) : parent_(node_count) { std::iota(parent_.begin(), parent_.end(), 0u); }
  void join(std::uint32_t a, std::uint32_t b) {
    a = root(a);
    b = root(b);
    if (a != b) parent_[std::max(a, b)] = std::min(a, b);
  }
  bool is_root(std::uint32_t node) const { return parent_[node] == node; }
  std::uint32_t root(std::uint32_t node) {
    while (parent_[node] != node) node = parent_[node] = parent_[parent_[node]];
    return node;
  }

 private:
  std::vector<std::uint32_t> parent_;
};

}  // namespace tensormass::mesh
