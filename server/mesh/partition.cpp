#include "mesh/partition.h"

#include <algorithm>
#include <numeric>

#include <Eigen/Geometry>

#include "core/assert.h"

/// Recursive coordinate bisection in two stages.
///
/// Cuts between patches come first, at the places that `offsets` prescribes, so that patches have equal sizes. Cuts
/// within a patch go on down to leaves, at multiples of the leaf size.
///
///   order_patches:  [ p0 p1 | p2 p3 ]  →  [ p0 | p1 ] [ p2 | p3 ]  →  order_leaves for each patch
///
/// A cut (`split`) selects the lowest items along the longest side and does not sort, which keeps the whole at O(n log
/// n).
namespace tensormass::mesh {
namespace {

/// A point and its index together, so that the selection in `split` reads memory in order.
struct Item {
  Eigen::Vector3d position;
  std::uint32_t index;
};

std::vector<Item> items_of(std::span<const Eigen::Vector3d> points) {
  std::vector<Item> items(points.size());
  for (std::uint32_t i = 0; i < points.size(); ++i) items[i] = {points[i], i};
  return items;
}

std::vector<std::uint32_t> indices_of(const std::vector<Item>& items) {
  std::vector<std::uint32_t> indices(items.size());
  std::transform(items.begin(), items.end(), indices.begin(), [](const Item& item) { return item.index; });
  return indices;
}

/// Reorders items so that the `cut` lowest along the bounding box's longest side come first. Equal coordinates are
/// ordered by index.
void split(std::span<Item> items, std::uint32_t cut) {
  Eigen::AlignedBox3d box;
  for (const Item& item : items) box.extend(item.position);
  Eigen::Index axis = 0;
  box.sizes().maxCoeff(&axis);
  std::nth_element(items.begin(), items.begin() + cut, items.end(), [axis](const Item& a, const Item& b) {
    return a.position[axis] != b.position[axis] ? a.position[axis] < b.position[axis] : a.index < b.index;
  });
}

/// Bisects items down to leaves, and sorts each leaf by index.
void order_leaves(std::span<Item> items, std::uint32_t leaf_size) {
  const auto count = static_cast<std::uint32_t>(items.size());
  const std::uint32_t cut = bisection_cut(count, leaf_size);
  if (cut == count) {
    std::sort(items.begin(), items.end(), [](const Item& a, const Item& b) { return a.index < b.index; });
    return;
  }
  split(items, cut);
  order_leaves(items.first(cut), leaf_size);
  order_leaves(items.subspan(cut), leaf_size);
}

/// Bisects items into the patches between `offsets`, half of the patches to either side; then bisects each patch down
/// to leaves.
void order_patches(std::span<Item> items, std::span<const std::uint32_t> offsets, std::uint32_t leaf_size) {
  const std::size_t patch_count = offsets.size() - 1;
  if (patch_count == 1) return order_leaves(items, leaf_size);
  const std::size_t middle = patch_count / 2;
  const std::uint32_t cut = offsets[middle] - offsets.front();
  if (cut > 0 && cut < items.size()) split(items, cut);
  order_patches(items.first(cut), offsets.first(middle + 1), leaf_size);
  order_patches(items.subspan(cut), offsets.subspan(middle), leaf_size);
}

}  // namespace

Partition partition(std::span<const Eigen::Vector3d> nodes, std::uint32_t patch_count, std::uint32_t leaf_size) {
  TM_ASSERT(patch_count >= 1 && leaf_size >= 1, "a partition has patches, and leaves have nodes");
  std::vector<Item> items = items_of(nodes);
  Partition result;
  result.offsets.resize(patch_count + std::size_t{1});
  for (std::uint64_t patch = 0; patch <= patch_count; ++patch) {
    result.offsets[patch] = static_cast<std::uint32_t>(patch * items.size() / patch_count);
  }
  order_patches(items, result.offsets, leaf_size);
  result.order = indices_of(items);
  return result;
}

std::vector<std::uint32_t> bisection_order(std::span<const Eigen::Vector3d> points, std::uint32_t leaf_size) {
  TM_ASSERT(leaf_size >= 1, "leaves have points");
  std::vector<Item> items = items_of(points);
  order_leaves(items, leaf_size);
  return indices_of(items);
}

}  // namespace tensormass::mesh
