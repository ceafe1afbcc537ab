#include "backend/cuda/rows_memory.h"

#include <algorithm>
#include <vector>

#include <gtest/gtest.h>

#include "backend/memory_map.h"

/// Shared memory of the assembly by rows, and the size of its launch.
namespace tensormass::backend::cuda {
namespace {

using tests::MemoryMap;

template <class Real>
struct alignas(16) Quad {
  Real x, y, z, w;
};

template <class Real>
class RowsMemory : public testing::Test {};
using Reals = testing::Types<float, double>;
TYPED_TEST_SUITE(RowsMemory, Reals);

TYPED_TEST(RowsMemory, HasAPlaceOfItsOwnForEachComponentOfEachBlock) {
  using Real = TypeParam;
  constexpr std::uint32_t kFirst = 7;  // column of the slice with which the turn begins
  for (const bool keeps_neighbours : {false, true}) {
    for (const std::uint32_t sums : {1u, 2u, kMaxPartsWithSums}) {
      for (const std::uint32_t capacity : {kLeastColumns, 15u}) {
        MemoryMap map(capacity * column_reals(keeps_neighbours, sums) * kSliceRows * sizeof(Real));
        auto* const quads = reinterpret_cast<Quad<Real>*>(map.begin());
        auto* const singles = reinterpret_cast<Real*>(quads + quad_place(sums, capacity, 0, 0));
        Real* const neighbours = singles + single_place(sums, capacity, 0, 0);
        for (std::uint32_t column = 0; column < capacity; ++column) {
          for (std::uint32_t sum = 0; sum < sums; ++sum) {
            map.take(quads + quad_place(sum, capacity, kFirst + column, kFirst), kSliceRows,
                     "the first four components");
            map.take(quads + quad_place(sum, capacity, kFirst + column, kFirst) + kSliceRows, kSliceRows,
                     "the next four");
            map.take(singles + single_place(sum, capacity, kFirst + column, kFirst), kSliceRows, "the ninth");
          }
          for (std::uint32_t c = 0; keeps_neighbours && c < 6; ++c) {
            EXPECT_EQ(neighbour_place(column, c), column * kNeighbourColumnReals + c * kSliceRows);
            map.take(neighbours + neighbour_place(column, c), kSliceRows, "a neighbour");
          }
        }
        EXPECT_TRUE(map.takes_all());
      }
    }
  }
}

/// A launch has whole warps, fits, and leaves room for the RowSums of its parts.
template <class Real>
void expect_fits(const RowsLaunch& launch, bool keeps_neighbours, bool one_sum, std::size_t bytes) {
  const std::uint32_t parts = launch.threads / kSliceRows;
  EXPECT_EQ(launch.threads % kSliceRows, 0u);
  EXPECT_GE(parts, 1u);
  EXPECT_LE(launch.shared_bytes, bytes);
  EXPECT_EQ(launch.shared_bytes,
            launch.capacity * column_reals(keeps_neighbours, one_sum ? 1 : parts) * kSliceRows * sizeof(Real));
  MemoryMap map(launch.shared_bytes);
  for (std::uint32_t part = 0; part < parts; ++part) {
    map.take(reinterpret_cast<Real*>(map.begin()) + row_sums_place(part), kSumsReals * kSliceRows, "RowSums");
  }
}

constexpr std::size_t kBytes = 113 * 1024;
constexpr std::uint32_t kProcessors = 132;

TYPED_TEST(RowsMemory, PartsWithASumEachFitTheDevice) {
  using Real = TypeParam;
  for (const bool keeps_neighbours : {false, true}) {
    for (const std::uint32_t widest : {1u, 14u, 40u, 5000u}) {
      for (const std::uint32_t slices : {0u, 1u, 600u, 100000u}) {
        const RowsLaunch launch = launch_with_sums<Real>(slices, widest, keeps_neighbours, kProcessors, kBytes);
        expect_fits<Real>(launch, keeps_neighbours, false, kBytes);
        if (widest != 14) continue;
        const std::uint32_t parts = launch.threads / kSliceRows;
        EXPECT_LE(parts, kMaxPartsWithSums);
        EXPECT_GE(launch.capacity, widest) << "the whole slice fits";
        const std::uint32_t wanted = slices == 100000 ? kUsualParts : slices == 600 ? 3 : kMaxPartsWithSums;
        EXPECT_LE(parts, wanted);
        const std::size_t more = column_reals(keeps_neighbours, parts + 1);
        EXPECT_TRUE(parts == wanted || launch.capacity * more * kSliceRows * sizeof(Real) > kBytes);
      }
    }
  }
}

/// Threads have all registers, so a multiprocessor runs eight warps at once; shared memory is 226 KiB.
std::uint32_t blocks_at_once(unsigned threads, std::size_t bytes) {
  return std::min(256 / threads, static_cast<unsigned>(226 * 1024 / (bytes + 1024)));
}

TYPED_TEST(RowsMemory, PartsWithOneSumFillAMultiprocessorWithWarps) {
  using Real = TypeParam;
  for (const std::uint32_t widest : {1u, 26u, 64u, 5000u}) {
    for (const std::uint32_t slices : {0u, 1u, 132u, 100000u}) {
      const RowsLaunch launch = launch_in_turns<Real>(slices, widest, kProcessors, kBytes, blocks_at_once);
      expect_fits<Real>(launch, false, true, kBytes);
      const std::uint32_t parts = launch.threads / kSliceRows,
                          blocks = blocks_at_once(launch.threads, launch.shared_bytes);
      EXPECT_EQ(slices < 2 * kProcessors ? parts : parts * blocks, 8u) << widest << " columns, " << slices << " slices";
    }
  }
}

TYPED_TEST(RowsMemory, ABlockWithoutRoomForMoreThreadsTakesThoseThatFit) {
  const auto two_warps = [](unsigned threads, std::size_t) { return threads <= 64 ? 1u : 0u; };
  EXPECT_EQ(launch_in_turns<TypeParam>(100, 20, kProcessors, kBytes, two_warps).threads, 64u);
}

TEST(WideSlices, AreKeptApartIfTheyAreFew) {
  struct Slice {
    std::uint32_t columns_begin, columns_end;
  };
  const auto count = [](const std::vector<std::uint32_t>& widths) {
    std::vector<Slice> slices;
    for (const std::uint32_t width : widths) slices.push_back({100, 100 + width});
    return wide_slices(slices);
  };
  EXPECT_EQ(count({}), 0u);
  EXPECT_EQ(count({26, 26, 18}), 3u) << "alike";
  EXPECT_EQ(count({64, 64, 26, 26, 18}), 2u);
  EXPECT_EQ(count({64, 26, 64, 26, 18, 18}), 3u) << "from the first to the last wide one";
  EXPECT_EQ(count({64, 64, 64, 26}), 4u) << "most are wide";
}

}  // namespace
}  // namespace tensormass::backend::cuda
