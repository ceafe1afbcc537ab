#include "backend/cuda/exchange_cells.h"

#include <algorithm>
#include <random>
#include <set>
#include <vector>

#include <gtest/gtest.h>

/// The places of the exchange's cells, and its protocol with patches that run at different speeds.
namespace tensormass::backend::cuda {
namespace {

struct TaggedCell {
  float x, y, z;
  std::uint32_t tag = 0;
};

TEST(ExchangeCells, HaveOnePlaceForEachRowAndParity) {
  constexpr std::uint32_t kRows = 96;
  std::vector<TaggedCell> cells(2 * kRows);  // as model::bind allocates `product`: [2, row_count, 4] reals
  std::set<TaggedCell*> places;
  for (std::uint32_t tag = 6; tag < 8; ++tag) {
    for (std::uint32_t row = 0; row < kRows; ++row) places.insert(row_cell(cells.data(), kRows, tag, row));
  }
  EXPECT_EQ(places.size(), 2 * kRows);
  EXPECT_EQ(*places.begin(), cells.data());
  EXPECT_EQ(*places.rbegin(), cells.data() + 2 * kRows - 1);
  EXPECT_EQ(row_cell(cells.data(), kRows, 6, 5), row_cell(cells.data(), kRows, 8, 5));
}

TEST(ExchangeCells, HaveOnePlaceForTheSumsOfEachPatchAndParity) {
  constexpr std::uint32_t kPatches = 7;
  // As model::bind allocates `reduction`: [2, patch_count, kPatchSums] reals.
  std::vector<TaggedCell> cells(2 * kPatches * view::kPatchSums / 4);
  std::set<TaggedCell*> places;
  for (std::uint32_t tag = 0; tag < 2; ++tag) {
    for (std::uint32_t patch = 0; patch < kPatches; ++patch) {
      TaggedCell* const place = sum_cell(cells.data(), kPatches, tag, patch);
      ASSERT_GE(place, cells.data());
      ASSERT_LT(place, cells.data() + cells.size());
      for (TaggedCell* const other : places) EXPECT_GE(std::abs(place - other), std::ptrdiff_t{view::kPatchSums / 4});
      places.insert(place);
    }
  }
  EXPECT_EQ(places.size(), 2 * kPatches);
}

TEST(ExchangeCells, AThreadWaitsForEachOfItsItemsAndForNoneBeyondTheEnd) {
  constexpr int kAtOnce = 4;
  const std::vector<TaggedCell> cells(64);
  for (const std::uint32_t threads : {1u, 5u, 32u}) {
    for (std::uint32_t count = 0; count <= 64; ++count) {
      std::vector<int> waits(count, 0);
      for (std::uint32_t thread = 0; thread < threads; ++thread) {
        for (std::uint32_t h = thread; h < count; h += kAtOnce * threads) {
          const TaggedCell* found[kAtOnce];
          cells_to_wait_for(
              h, threads, count,
              [&](int i) {
                EXPECT_LT(h + i * threads, count) << "reads an index beyond the end";
                return cells.data() + h + i * threads;
              },
              found);
          for (std::uint32_t i = 0; i < kAtOnce; ++i) {
            if (h + i * threads < count) {
              ASSERT_EQ(found[i], cells.data() + h + i * threads);
              ++waits[h + i * threads];
            } else {
              ASSERT_EQ(found[i], cells.data() + h);
            }
          }
        }
      }
      EXPECT_EQ(waits, std::vector<int>(count, 1)) << threads << " threads";
    }
  }
}

/// Patches that exchange as exchange.cuh says, each at its own speed. A patch publishes a row and its sums, then waits
/// for the rows and sums of all others. Its steps are as small as loads and stores of single cells.
class Patches {
 public:
  Patches(std::uint32_t count, std::uint32_t last_tag)
      : rows_(2 * count), sums_(2 * count * kSumCells), patches_(count), first_(last_tag) {
    for (Patch& patch : patches_) patch.tag = last_tag;
    for (TaggedCell& cell : rows_) cell.tag = last_tag;
    for (TaggedCell& cell : sums_) cell.tag = last_tag;
  }

  /// Runs the next step of a patch. Returns false if it must wait.
  bool advance(std::uint32_t index) {
    Patch& patch = patches_[index];
    const auto count = static_cast<std::uint32_t>(patches_.size());
    if (patch.step == 0) {
      ++patch.tag;
      *row_cell(rows_.data(), count, patch.tag, index) = {value_of(index, patch.tag), 0, 0, patch.tag};
    } else if (patch.step == 1) {
      *sum_cell(sums_.data(), count, patch.tag, index) = {value_of(index, patch.tag), 0, 0, patch.tag};
    } else {
      // First the sums and then the rows, because a patch reads rows of its halo last.
      const std::uint32_t other = (patch.step - 2) % count;
      const bool is_sum = patch.step - 2 < count;
      const TaggedCell& cell =
          is_sum ? *sum_cell(sums_.data(), count, patch.tag, other) : *row_cell(rows_.data(), count, patch.tag, other);
      if (cell.tag != patch.tag) return false;
      EXPECT_EQ(cell.x, value_of(other, patch.tag));
    }
    patch.step = (patch.step + 1) % (2 + 2 * count);
    return true;
  }
  /// Returns the number of exchanges of the slowest patch.
  std::uint32_t least_exchanges() const {
    std::uint32_t least = 0xFFFFFFFFu;
    for (const Patch& patch : patches_) least = std::min(least, patch.tag - first_);
    return least;
  }

 private:
  struct Patch {
    std::uint32_t tag = 0, step = 0;
  };
  static float value_of(std::uint32_t patch, std::uint32_t tag) {
    return static_cast<float>(100 * (tag % 1000) + patch);
  }

  std::vector<TaggedCell> rows_, sums_;
  std::vector<Patch> patches_;
  const std::uint32_t first_;
};

TEST(ExchangeCells, PatchesOfAnySpeedReadWhatWasPublishedInTheSameExchange) {
  constexpr std::uint32_t kPatches = 4, kExchanges = 50;
  // Tags wrap around: an exchange then still differs from the last one in parity.
  for (const std::uint32_t last_tag : {0u, 0xFFFFFFFFu - kExchanges / 2}) {
    for (unsigned seed = 0; seed < 20; ++seed) {
      std::mt19937 random(seed);
      Patches patches(kPatches, last_tag);
      while (patches.least_exchanges() < kExchanges) {
        // A patch runs as far as it can before the next one is chosen.
        std::vector<std::uint32_t> order{0, 1, 2, 3};
        std::shuffle(order.begin(), order.end(), random);
        bool moved = false;
        for (const std::uint32_t p : order) {
          for (std::uint32_t steps = random() % 30 + 1; steps > 0 && patches.advance(p); --steps) moved = true;
        }
        ASSERT_TRUE(moved) << "all patches wait for ever";
      }
    }
  }
}

}  // namespace
}  // namespace tensormass::backend::cuda
