#include "backend/cuda/checked_tetrahedra.h"

#include <algorithm>
#include <cstring>
#include <vector>

#include <gtest/gtest.h>

#include "backend/memory_map.h"

/// Which tetrahedra the threads of a patch check, and how they find the nodes of one.
namespace tensormass::backend::cuda {
namespace {

TEST(CheckedTetrahedra, HaveFourNodesInTwoWords) {
  const std::uint16_t rows[4] = {1, 0xFFFF, 0, 0x8002};
  tests::Words words;
  static_assert(sizeof(words) == sizeof(rows));
  std::memcpy(&words, rows, sizeof(rows));
  for (std::uint32_t k = 0; k < 4; ++k) EXPECT_EQ(local_of_node(words.x, words.y, k), rows[k]);
  EXPECT_EQ(kTetrahedraInLine * sizeof(rows), 128u);
}

TEST(CheckedTetrahedra, AreAllReadAndNoneBeyondTheEnd) {
  constexpr std::uint32_t kThreads = 8, kAtOnce = 3;
  for (std::uint32_t begin : {0u, 5u}) {
    for (std::uint32_t count = 0; count <= 60; ++count) {
      const std::uint32_t end = begin + count;
      std::vector<int> reads(end, 0);
      for (std::uint32_t thread = 0; thread < kThreads; ++thread) {
        for (std::uint32_t t = begin + thread; t < end; t += kAtOnce * kThreads) {  // as PatchVolume::finds does
          for (std::uint32_t i = 0; i < kAtOnce; ++i) ++reads.at(tetrahedron_ahead(t, i, kThreads, end));
        }
      }
      if (count == 0) continue;
      EXPECT_GE(reads.back(), 1);
      reads.back() = 1;  // only the last one is read again
      std::vector<int> expected(end, 1);
      std::fill(expected.begin(), expected.begin() + begin, 0);
      EXPECT_EQ(reads, expected) << begin << " to " << end;
    }
  }
}

}  // namespace
}  // namespace tensormass::backend::cuda
