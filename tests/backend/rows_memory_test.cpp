#include "backend/cuda/rows_memory.h"

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
    for (const std::uint32_t sums : {1u, 2u, kMostParts}) {
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

TYPED_TEST(RowsMemory, LaunchFitsTheDeviceAndHasRoomForTheSumsOfItsParts) {
  using Real = TypeParam;
  constexpr std::size_t kBytes = 113 * 1024;
  constexpr std::uint32_t kProcessors = 132;
  for (const bool keeps_neighbours : {false, true}) {
    for (const bool adds_in_turns : {false, true}) {
      for (const std::uint32_t widest : {1u, 14u, 40u, 5000u}) {
        for (const std::uint32_t slices : {0u, 1u, 600u, 100000u}) {
          const RowsLaunch launch =
              rows_launch<Real>(slices, widest, keeps_neighbours, adds_in_turns, kProcessors, kBytes);
          const std::uint32_t parts = launch.threads / kSliceRows, sums = adds_in_turns ? 1 : parts;
          EXPECT_EQ(launch.threads % kSliceRows, 0u);
          EXPECT_GE(parts, 1u);
          EXPECT_LE(parts, kMostParts);
          EXPECT_LE(launch.shared_bytes, kBytes);
          EXPECT_EQ(launch.shared_bytes,
                    launch.capacity * column_reals(keeps_neighbours, sums) * kSliceRows * sizeof(Real));
          MemoryMap map(launch.shared_bytes);
          for (std::uint32_t part = 0; part < parts; ++part) {
            map.take(reinterpret_cast<Real*>(map.begin()) + row_sums_place(part), kSumsReals * kSliceRows, "RowSums");
          }
          if (widest == 14) {
            EXPECT_EQ(launch.capacity, widest) << "the whole slice fits";
            const std::uint32_t wanted = slices == 100000 ? kUsualParts : slices == 600 ? 3 : kMostParts;
            EXPECT_LE(parts, wanted);
            const std::uint32_t more = column_reals(keeps_neighbours, adds_in_turns ? 1 : parts + 1);
            EXPECT_TRUE(parts == wanted || launch.capacity * more * kSliceRows * sizeof(Real) > kBytes);
          }
        }
      }
    }
  }
}

}  // namespace
}  // namespace tensormass::backend::cuda
