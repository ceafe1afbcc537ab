#include "matrix/row_lists.h"

#include <algorithm>
#include <numeric>

#include "core/assert.h"
#include "core/parallel.h"
#include "matrix/row_elements.h"

namespace tensormass::matrix {

namespace {

/// The elements of a group at each row, ascending, each with the index of its node that the row is.
struct Incidence {
  struct Item {
    std::uint32_t element, node;
  };
  std::vector<std::uint32_t> begin;
  std::vector<Item> items;
  std::span<const Item> at(std::uint32_t row) const {
    return std::span(items).subspan(begin[row], begin[row + 1] - begin[row]);
  }
};

Incidence incidence_of(const ElementRows& group, std::uint32_t row_count) {
  Incidence out;
  out.begin.assign(row_count + std::size_t{1}, 0);
  const auto row = [&](std::uint32_t k, std::uint32_t e) { return group.rows[std::size_t{k} * group.stride + e]; };
  for (std::uint32_t k = 0; k < group.node_count; ++k) {
    for (std::uint32_t e = 0; e < group.element_count; ++e) {
      TM_ASSERT(row(k, e) < row_count, "elements name rows of the layout");
      ++out.begin[row(k, e) + 1];
    }
  }
  std::partial_sum(out.begin.begin(), out.begin.end(), out.begin.begin());
  out.items.resize(out.begin.back());
  std::vector<std::uint32_t> next(out.begin.begin(), out.begin.end() - 1);
  for (std::uint32_t e = 0; e < group.element_count; ++e) {
    for (std::uint32_t k = 0; k < group.node_count; ++k) out.items[next[row(k, e)]++] = {e, k};
  }
  return out;
}

/// Returns the length of the longest list of a slice.
std::uint32_t length_of(const Incidence& incidence, std::uint32_t slice) {
  std::uint32_t longest = 0;
  for (std::uint32_t row = slice * kSliceRows; row < (slice + 1) * kSliceRows; ++row) {
    longest = std::max(longest, incidence.begin[row + 1] - incidence.begin[row]);
  }
  return longest;
}

/// Writes the lists of a slice. Its list columns start at `column`.
void fill_slice(const Layout& layout, const ElementRows& group, const Incidence& incidence, std::uint32_t slice,
                std::uint32_t column, RowLists& out) {
  const std::uint32_t words = place_words(group.node_count, out.place_bits), in_word = 32 / out.place_bits;
  const std::uint32_t first = layout.slice_begin[slice];
  for (std::uint32_t lane = 0; lane < kSliceRows; ++lane) {
    const std::uint32_t own = slice * kSliceRows + lane;
    std::size_t at = column;
    for (const auto& [element, own_node] : incidence.at(own)) {
      out.listed[at * kSliceRows + lane] = element;
      for (std::uint32_t l = 0; l < group.node_count; ++l) {
        std::uint32_t place = own_place(out.place_bits);
        if (l != own_node) {
          place = layout.slot(own, group.rows[std::size_t{l} * group.stride + element]) / kSliceRows - first;
        }
        out.places[(at * words + l / in_word) * kSliceRows + lane] |= place << (out.place_bits * (l % in_word));
      }
      ++at;
    }
  }
}

}  // namespace

GroupRowLists make_row_lists(const Layout& layout, std::span<const ElementRows> groups, bool finishes) {
  TM_ASSERT(layout.storage != Storage::kEdges, "rows store all of their blocks");
  const std::uint32_t slice_count = layout.row_count / kSliceRows;
  TM_ASSERT(slice_count < 1u << 30, "ListedSlice has two bits beside the slice");
  constexpr std::uint32_t kNone = 0xFFFFFFFFu;
  GroupRowLists out;
  std::vector<std::uint32_t> last_group(slice_count, kNone);
  std::vector<Incidence> incidences;
  TM_ASSERT(layout.widest_slice() < own_place(16), "16 bits tell all columns of a slice from the row itself");
  for (std::uint32_t g = 0; g < groups.size(); ++g) {
    TM_ASSERT(groups[g].element_count <= groups[g].stride, "padding follows the elements");
    TM_ASSERT(groups[g].rows.size() == std::size_t{groups[g].node_count} * groups[g].stride, "rows: [node][stride]");
    incidences.push_back(incidence_of(groups[g], layout.row_count));
    for (std::uint32_t slice = 0; slice < slice_count; ++slice) {
      if (length_of(incidences[g], slice) > 0) last_group[slice] = g;
    }
  }
  std::vector<std::uint8_t> begun(slice_count, 0);
  const std::vector<std::uint32_t> patch_of_slice = layout.patch_of_slice();
  for (std::uint32_t g = 0; g < groups.size(); ++g) {
    RowLists& lists = out.groups.emplace_back();
    lists.place_bits = layout.widest_slice() < own_place(8) ? 8 : 16;
    std::vector<std::pair<std::uint32_t, std::uint32_t>> by_length;  // length, slice
    for (std::uint32_t slice = 0; slice < slice_count; ++slice) {
      if (const std::uint32_t length = length_of(incidences[g], slice)) by_length.emplace_back(length, slice);
    }
    std::stable_sort(by_length.begin(), by_length.end(),
                     [](const auto& a, const auto& b) { return a.first > b.first; });
    std::uint32_t columns = 0;
    for (const auto& [length, slice] : by_length) {
      const std::uint32_t patch = patch_of_slice[slice];
      lists.slices.push_back(
          {4 * slice + begun[slice] + (finishes && last_group[slice] == g ? 2 : 0), layout.slice_begin[slice],
           layout.slice_begin[slice + 1], columns, columns + length,
           PatchColumns{layout.patch_rows[patch], layout.patch_rows[patch + 1], layout.patch_halo[patch]}});
      columns += length;
      begun[slice] = 1;
    }
    lists.listed.assign(std::size_t{columns} * kSliceRows, kNoPlace);
    lists.places.assign(std::size_t{columns} * place_words(groups[g].node_count, lists.place_bits) * kSliceRows, 0);
    constexpr std::size_t kGrain = 64;
    parallel_ranges(lists.slices.size(), kGrain, [&](std::size_t begin, std::size_t end) {
      for (std::size_t i = begin; i < end; ++i) {
        fill_slice(layout, groups[g], incidences[g], lists.slices[i].slice(), lists.slices[i].list_begin, lists);
      }
    });
  }
  if (!finishes) out.begun_slices = std::move(begun);
  return out;
}

}  // namespace tensormass::matrix
