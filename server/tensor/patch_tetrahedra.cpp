#include "tensor/patch_tetrahedra.h"

#include <array>
#include <numeric>

namespace tensormass::tensor {

PatchTetrahedra share_out_tetrahedra(const Layout& layout, std::span<const ElementRows> groups) {
  const std::vector<std::uint32_t> patch_of_slice = layout.patch_of_slice();
  std::vector<std::array<std::uint32_t, 4>> tetrahedra;
  std::vector<std::uint32_t> part_of;  // [tetrahedron] 2 patch + 1 if it has rows of the halo
  std::vector<std::uint32_t> of_patch(layout.patch_count, 0), of_part(2 * layout.patch_count, 0);
  for (const ElementRows& group : groups) {
    for (std::uint32_t e = 0; e < group.element_count; ++e) {
      auto& rows = tetrahedra.emplace_back();
      std::uint32_t fewest = patch_of_slice[group.rows[e] / kSliceRows];
      bool has_halo = false;
      for (std::uint32_t k = 0; k < 4; ++k) {
        rows[k] = group.rows[std::size_t{k} * group.stride + e];
        const std::uint32_t patch = patch_of_slice[rows[k] / kSliceRows];
        has_halo = has_halo || patch != fewest;
        if (of_patch[patch] < of_patch[fewest]) fewest = patch;
      }
      ++of_patch[fewest];
      part_of.push_back(2 * fewest + (has_halo ? 1 : 0));
      ++of_part[part_of.back()];
    }
  }
  PatchTetrahedra out;
  out.begin.assign(of_part.size() + 1, 0);
  std::partial_sum(of_part.begin(), of_part.end(), out.begin.begin() + 1);
  std::vector<std::uint32_t> next(out.begin.begin(), out.begin.end() - 1), order(tetrahedra.size());
  for (std::uint32_t t = 0; t < tetrahedra.size(); ++t) order[next[part_of[t]]++] = t;
  out.rows.reserve(4 * order.size());
  std::vector<std::uint32_t> local(layout.row_count);
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t first = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - first;
    for (std::uint32_t i = 0; i < own; ++i) local[first + i] = i;
    const std::uint32_t halo = layout.patch_halo[patch], halo_end = layout.patch_halo[patch + 1];
    for (std::uint32_t h = halo; h < halo_end; ++h) local[layout.halo[h]] = own + h - halo;
    for (std::uint32_t i = out.begin[2 * patch]; i < out.begin[2 * patch + 2]; ++i) {
      for (const std::uint32_t row : tetrahedra[order[i]]) out.rows.push_back(static_cast<std::uint16_t>(local[row]));
    }
  }
  return out;
}

}  // namespace tensormass::tensor
