#include "matrix/patch_tetrahedra.h"

#include <algorithm>
#include <array>
#include <limits>
#include <numeric>

#include "core/assert.h"

namespace tensormass::matrix {

namespace {

using Local = std::array<std::uint16_t, 4>;

/// The permutations of four nodes that keep the sign of the volume.
constexpr std::array<std::array<std::uint8_t, 4>, 12> kEvenPermutations{{{0, 1, 2, 3},
                                                                         {0, 2, 3, 1},
                                                                         {0, 3, 1, 2},
                                                                         {1, 0, 3, 2},
                                                                         {1, 2, 0, 3},
                                                                         {1, 3, 2, 0},
                                                                         {2, 0, 1, 3},
                                                                         {2, 1, 3, 0},
                                                                         {2, 3, 0, 1},
                                                                         {3, 0, 2, 1},
                                                                         {3, 1, 0, 2},
                                                                         {3, 2, 1, 0}}};

constexpr std::size_t kBanks = 8;

/// The rows that threads read together, by bank (matrix/banks.h).
class Reads {
 public:
  /// Returns how many other rows of its bank a row would wait for; 0 if it is read already.
  unsigned meetings(std::uint16_t row) const {
    const Bank& bank = banks_[row % kBanks];
    for (unsigned i = 0; i < bank.count; ++i) {
      if (bank.rows[i] == row) return 0;
    }
    return bank.count;
  }
  void add(std::uint16_t row) {
    Bank& bank = banks_[row % kBanks];
    if (bank.count > 0 && meetings(row) == 0) return;  // it is read already
    TM_ASSERT(bank.count < kBanks, "no more threads read together than there are banks");
    bank.rows[bank.count++] = row;
  }

 private:
  struct Bank {
    unsigned count = 0;
    std::array<std::uint16_t, kBanks> rows;
  };
  std::array<Bank, kBanks> banks_;
};

/// Orders tetrahedra and the nodes of each, so that eight threads that read together have few bank conflicts.
///
/// Greedy: tries the next kCandidates tetrahedra in all even permutations, and takes the one with the fewest conflicts.
void spread_over_banks(std::span<Local> tetrahedra) {
  constexpr std::size_t kCandidates = 2;
  for (std::size_t first = 0; first < tetrahedra.size(); first += kBanks) {
    std::array<Reads, 4> reads;  // [k] what eight threads read as their k-th node
    const std::size_t last = std::min(first + kBanks, tetrahedra.size());
    for (std::size_t place = first; place < last; ++place) {
      unsigned fewest = std::numeric_limits<unsigned>::max();
      std::size_t chosen = place;
      const std::array<std::uint8_t, 4>* best = nullptr;
      for (std::size_t t = place; t < std::min(place + kCandidates, tetrahedra.size()) && fewest > 0; ++t) {
        unsigned meetings[4][4];  // [node][k] if it came k-th
        for (std::size_t node = 0; node < 4; ++node) {
          for (std::size_t k = 0; k < 4; ++k) meetings[node][k] = reads[k].meetings(tetrahedra[t][node]);
        }
        for (const auto& permutation : kEvenPermutations) {
          unsigned all = 0;
          for (std::size_t k = 0; k < 4; ++k) all += meetings[permutation[k]][k];
          if (all >= fewest) continue;
          fewest = all;
          chosen = t;
          best = &permutation;
        }
      }
      std::swap(tetrahedra[chosen], tetrahedra[place]);
      const Local nodes = tetrahedra[place];
      for (std::size_t k = 0; k < 4; ++k) {
        tetrahedra[place][k] = nodes[(*best)[k]];
        reads[k].add(tetrahedra[place][k]);
      }
    }
  }
}

}  // namespace

PatchTetrahedra share_out_tetrahedra(const Layout& layout, std::span<const ElementRows> groups) {
  TM_ASSERT(layout.largest_patch() <= 1u << 16, "local numbers of a patch fit into 16 bits");
  const std::vector<std::uint32_t> patch_of_slice = layout.patch_of_slice();
  std::vector<std::array<std::uint32_t, 4>> tetrahedra;
  std::vector<std::uint32_t> part_of;  // [tetrahedron] 2 · patch, + 1 if it has rows of the halo
  std::vector<std::uint32_t> of_patch(layout.patch_count, 0), of_part(2 * layout.patch_count, 0);
  for (const ElementRows& group : groups) {
    TM_ASSERT(group.node_count == 4, "the elements are linear tetrahedra");
    TM_ASSERT(group.element_count <= group.stride && group.rows.size() == 4 * std::size_t{group.stride},
              "rows: [node][stride], padding follows the elements");
    for (std::uint32_t e = 0; e < group.element_count; ++e) {
      auto& rows = tetrahedra.emplace_back();
      std::uint32_t fewest = patch_of_slice[group.rows[e] / kSliceRows];
      bool has_halo = false;
      for (std::uint32_t k = 0; k < 4; ++k) {
        rows[k] = group.rows[std::size_t{k} * group.stride + e];
        TM_ASSERT(rows[k] < layout.row_count, "elements name rows of the layout");
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
  std::vector<Local> locals;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    const std::uint32_t first = layout.patch_rows[patch], own = layout.patch_rows[patch + 1] - first;
    for (std::uint32_t i = 0; i < own; ++i) local[first + i] = i;
    const std::uint32_t halo = layout.patch_halo[patch], halo_end = layout.patch_halo[patch + 1];
    for (std::uint32_t h = halo; h < halo_end; ++h) local[layout.halo[h]] = own + h - halo;
    for (std::uint32_t part = 2 * patch; part < 2 * patch + 2; ++part) {
      locals.clear();
      for (std::uint32_t i = out.begin[part]; i < out.begin[part + 1]; ++i) {
        Local& nodes = locals.emplace_back();
        std::transform(tetrahedra[order[i]].begin(), tetrahedra[order[i]].end(), nodes.begin(), [&](std::uint32_t row) {
          const std::uint32_t at = local[row];
          TM_ASSERT(at < own ? first + at == row : halo + at - own < halo_end && layout.halo[halo + at - own] == row,
                    "a patch has all nodes of its tetrahedra among its rows and its halo");
          return static_cast<std::uint16_t>(at);
        });
      }
      spread_over_banks(locals);
      for (const Local& nodes : locals) out.rows.insert(out.rows.end(), nodes.begin(), nodes.end());
    }
  }
  return out;
}

}  // namespace tensormass::matrix
