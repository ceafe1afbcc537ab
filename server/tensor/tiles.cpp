#include "tensor/tiles.h"

#include <algorithm>
#include <cassert>
#include <numeric>

#include "physics/element/element.h"

namespace tensormass::tensor {

namespace {

/// The elements of a group at each row, ascending.
struct Incidence {
  std::vector<std::uint32_t> begin, element;
  std::span<const std::uint32_t> at(std::uint32_t row) const {
    return std::span(element).subspan(begin[row], begin[row + 1] - begin[row]);
  }
};

Incidence incidence_of(const ElementRows& group, std::uint32_t row_count) {
  Incidence out;
  out.begin.assign(row_count + std::size_t{1}, 0);
  const auto row = [&](std::uint32_t k, std::uint32_t e) { return group.rows[std::size_t{k} * group.stride + e]; };
  for (std::uint32_t k = 0; k < group.node_count; ++k) {
    for (std::uint32_t e = 0; e < group.element_count; ++e) ++out.begin[row(k, e) + 1];
  }
  std::partial_sum(out.begin.begin(), out.begin.end(), out.begin.begin());
  out.element.resize(out.begin.back());
  std::vector<std::uint32_t> next(out.begin.begin(), out.begin.end() - 1);
  for (std::uint32_t e = 0; e < group.element_count; ++e) {
    for (std::uint32_t k = 0; k < group.node_count; ++k) out.element[next[row(k, e)]++] = e;
  }
  return out;
}

std::size_t align(std::size_t count) { return (count + kTileAlignment - 1) / kTileAlignment * kTileAlignment; }

class Builder {
 public:
  Builder(const Layout& layout, std::span<const ElementRows> groups, std::uint32_t capacity_reals, bool finishes)
      : layout_(layout), groups_(groups), capacity_reals_(capacity_reals), finishes_(finishes) {
    out_.groups.resize(groups.size());
    for (const ElementRows& group : groups) {
      incidences_.push_back(incidence_of(group, layout.row_count));
      stamps_.emplace_back(group.element_count, 0);
      touching_.emplace_back();
    }
    for (GroupTiles& group : out_.groups) group.tile_parts.push_back(0);
  }

  Tiles build() {
    for (std::uint32_t patch = 0; patch < layout_.patch_count; ++patch) {
      const std::uint32_t end = layout_.patch_rows[patch + 1] / kSliceRows;
      for (std::uint32_t slice = layout_.patch_rows[patch] / kSliceRows; slice < end;) {
        const bool two = slice + 2 <= end && fits(slice, 2);
        if (!two) fits(slice, 1);
        add_tile(slice, two ? 2 : 1);
        slice += two ? 2 : 1;
      }
    }
    return std::move(out_);
  }

 private:
  /// Whether each group's elements at the slices fit into shared memory at once; they are in touching_ then.
  bool fits(std::uint32_t slice, std::uint32_t count) {
    ++stamp_;
    bool fit = true;
    for (std::size_t g = 0; g < groups_.size(); ++g) {
      touching_[g].clear();
      for (std::uint32_t row = slice * kSliceRows; row < (slice + count) * kSliceRows; ++row) {
        for (const std::uint32_t e : incidences_[g].at(row)) {
          if (stamps_[g][e] == stamp_) continue;
          stamps_[g][e] = stamp_;
          touching_[g].push_back(e);
        }
      }
      fit = fit && touching_[g].size() * tile_record_reals(groups_[g].node_count) <= capacity_reals_;
    }
    return fit;
  }

  void add_tile(std::uint32_t slice, std::uint32_t count) {
    bool adds = false;
    TilePart* last = nullptr;
    for (std::size_t g = 0; g < groups_.size(); ++g) {
      std::vector<std::uint32_t>& elements = touching_[g];
      if (elements.empty()) continue;
      std::sort(elements.begin(), elements.end());
      const std::size_t most = capacity_reals_ / tile_record_reals(groups_[g].node_count);
      assert(most > 0);
      for (std::size_t first = 0; first < elements.size(); first += most) {
        last = &add_part(g, slice, count, std::span(elements).subspan(first, std::min(most, elements.size() - first)));
        last->adds = adds ? 1 : 0;
        adds = true;
      }
      out_.groups[g].tile_parts.push_back(static_cast<std::uint32_t>(out_.groups[g].parts.size()));
    }
    if (finishes_ && last != nullptr) {
      last->finishes = 1;
      return;
    }
    if (finishes_) return;  // rows that nothing refers to
    for (std::uint32_t i = 0; i < count; ++i) out_.open_slices.push_back(2 * (slice + i) + (adds ? 1 : 0));
  }

  TilePart& add_part(std::size_t g, std::uint32_t slice, std::uint32_t count, std::span<const std::uint32_t> elements) {
    const ElementRows& group = groups_[g];
    GroupTiles& out = out_.groups[g];
    const std::uint32_t row_begin = slice * kSliceRows, row_end = (slice + count) * kSliceRows;
    const std::uint32_t slot_begin = layout_.slice_begin[slice] * kSliceRows;
    const std::uint32_t slots = layout_.slice_begin[slice + count] * kSliceRows - slot_begin;
    TilePart part{};
    part.slice_begin = slice;
    part.slice_count = count;
    part.element_begin = static_cast<std::uint32_t>(out.elements.size());
    part.element_count = static_cast<std::uint32_t>(elements.size());
    part.list_begin = static_cast<std::uint32_t>(out.lists.size());
    part.entry_begin = static_cast<std::uint32_t>(out.entries.size());
    out.elements.insert(out.elements.end(), elements.begin(), elements.end());

    const auto each_entry = [&](const auto& add) {
      const std::uint32_t record = tile_record_reals(group.node_count);
      for (std::uint32_t i = 0; i < elements.size(); ++i) {
        const auto row = [&](std::uint32_t k) { return group.rows[std::size_t{k} * group.stride + elements[i]]; };
        for (std::uint32_t k = 0; k < group.node_count; ++k) {
          const std::uint32_t own = row(k);
          if (own < row_begin || own >= row_end) continue;
          add(slots + own - row_begin, i * record + force_offset(k));
          for (std::uint32_t l = 0; l < group.node_count; ++l) {
            if (l == k) continue;
            const auto pair = static_cast<std::uint32_t>(physics::pair_index(static_cast<int>(group.node_count),
                                                                             static_cast<int>(std::min(k, l)),
                                                                             static_cast<int>(std::max(k, l))));
            add(layout_.slot(own, row(l)) - slot_begin,
                (i * record + edge_offset(group.node_count, pair)) * 2 + (l < k ? 1 : 0));
          }
        }
      }
    };
    counts_.assign(slots + (row_end - row_begin) + std::size_t{1}, 0);
    each_entry([&](std::uint32_t list, std::uint32_t) { ++counts_[list + 1]; });
    std::partial_sum(counts_.begin(), counts_.end(), counts_.begin());
    assert(counts_.back() <= 0xFFFF);
    part.list_count = static_cast<std::uint32_t>(counts_.size());
    part.entry_count = counts_.back();
    out.lists.insert(out.lists.end(), counts_.begin(), counts_.end());
    out.lists.resize(align(out.lists.size()));
    out.entries.resize(align(out.entries.size() + part.entry_count));
    std::uint16_t* entries = out.entries.data() + part.entry_begin;
    each_entry(
        [&](std::uint32_t list, std::uint32_t entry) { entries[counts_[list]++] = static_cast<std::uint16_t>(entry); });
    out.parts.push_back(part);
    return out.parts.back();
  }

  const Layout& layout_;
  const std::span<const ElementRows> groups_;
  const std::uint32_t capacity_reals_;
  const bool finishes_;
  Tiles out_;
  std::vector<Incidence> incidences_;
  std::vector<std::vector<std::uint32_t>> stamps_;    // [group][element] the last stamp that touched it
  std::vector<std::vector<std::uint32_t>> touching_;  // [group] elements of the tile at hand
  std::vector<std::uint32_t> counts_;
  std::uint32_t stamp_ = 0;
};

}  // namespace

Tiles make_tiles(const Layout& layout, std::span<const ElementRows> groups, std::uint32_t capacity_reals,
                 bool finishes) {
  assert(capacity_reals <= kMaxTileReals);
  return Builder(layout, groups, capacity_reals, finishes).build();
}

}  // namespace tensormass::tensor
