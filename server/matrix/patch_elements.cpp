#include "matrix/patch_elements.h"

#include <numeric>

#include "core/assert.h"
#include "core/parallel.h"

namespace tensormass::matrix {

PatchElements order_by_patch(const Layout& layout, std::span<const std::uint32_t> rows, std::size_t node_count) {
  TM_ASSERT(node_count > 0, "elements have nodes");
  TM_ASSERT(rows.size() % node_count == 0, "every element lists all of its nodes");
  const std::size_t element_count = rows.size() / node_count;
  PatchElements out;
  std::vector<std::vector<std::uint32_t>> of_patch(layout.patch_count);
  const std::vector<std::uint32_t> patch_of_slice = layout.patch_of_slice();
  for (std::size_t e = 0; e < element_count; ++e) {
    const auto nodes = rows.subspan(e * node_count, node_count);
    for (std::size_t k = 0; k < node_count; ++k) {
      TM_ASSERT(nodes[k] < layout.row_count, "elements name rows of the layout");
      auto& list = of_patch[patch_of_slice[nodes[k] / kSliceRows]];
      if (list.empty() || list.back() != e) list.push_back(static_cast<std::uint32_t>(e));
    }
  }
  parallel_for(layout.patch_count, [&](std::size_t patch) {
    const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
    // A counting sort by the lowest row within the patch.
    std::vector<std::uint32_t>& list = of_patch[patch];
    std::vector<std::uint32_t> key(list.size()), next(end - begin + 1, 0), sorted(list.size());
    for (std::size_t i = 0; i < list.size(); ++i) {
      key[i] = end;
      for (const std::uint32_t row : rows.subspan(list[i] * node_count, node_count)) {
        if (row >= begin && row < key[i]) key[i] = row;
      }
      TM_ASSERT(key[i] < end, "an element is listed by the patches of its rows");
      ++next[key[i] - begin + 1];
    }
    std::partial_sum(next.begin(), next.end(), next.begin());
    for (std::size_t i = 0; i < list.size(); ++i) sorted[next[key[i] - begin]++] = list[i];
    list = std::move(sorted);
  });
  for (const std::vector<std::uint32_t>& list : of_patch) {
    out.ranges.push_back(static_cast<std::uint32_t>(out.order.size()));
    out.order.insert(out.order.end(), list.begin(), list.end());
    out.ranges.push_back(static_cast<std::uint32_t>(out.order.size()));
    out.order.resize((out.order.size() + kSliceRows - 1) / kSliceRows * kSliceRows, mesh::kNone);
  }
  return out;
}

std::vector<std::uint32_t> pair_places(const Layout& layout, const PatchElements& elements,
                                       std::span<const std::uint32_t> rows, std::size_t node_count) {
  const std::size_t stride = elements.order.size();
  TM_ASSERT(rows.size() == node_count * stride, "there is a row for each node of each place");
  TM_ASSERT(elements.ranges.size() == 2 * std::size_t{layout.patch_count}, "each patch has a range of places");
  TM_ASSERT(layout.slot_count() < kNoPlace / 2, "a place has a slot and a bit");
  std::vector<std::uint32_t> places(node_count * (node_count - 1) / 2 * stride, kNoPlace);
  const auto fill = [&](std::uint32_t patch, std::size_t first, std::size_t last) {
    const std::uint32_t begin = layout.patch_rows[patch], end = layout.patch_rows[patch + 1];
    const auto is_own = [&](std::uint32_t row) { return row >= begin && row < end; };
    for (std::size_t e = first; e < last; ++e) {
      std::size_t pair = 0;  // in the order of physics::pair_index
      for (std::size_t k = 0; k < node_count; ++k) {
        for (std::size_t l = k + 1; l < node_count; ++l, ++pair) {
          const std::uint32_t row_k = rows[k * stride + e], row_l = rows[l * stride + e];
          std::uint32_t& place = places[pair * stride + e];
          if (is_own(row_k)) {
            if (const std::uint32_t slot = layout.slot(row_k, row_l); slot != kNoPlace) place = 2 * slot;
          }
          if (place == kNoPlace && is_own(row_l)) {
            if (const std::uint32_t slot = layout.slot(row_l, row_k); slot != kNoPlace) place = 2 * slot + 1;
          }
          TM_ASSERT(place != kNoPlace || (!is_own(row_k) && !is_own(row_l)), "a patch stores the blocks of its rows");
        }
      }
    }
  };
  constexpr std::size_t kGrain = 4096;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::size_t begin = elements.ranges[2 * patch], end = elements.ranges[2 * patch + 1];
    parallel_ranges(end - begin, kGrain,
                    [&](std::size_t first, std::size_t last) { fill(patch, begin + first, begin + last); });
  }
  return places;
}

}  // namespace tensormass::matrix
