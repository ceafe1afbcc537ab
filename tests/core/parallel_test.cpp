#include "core/parallel.h"

#include <atomic>
#include <vector>

#include <gtest/gtest.h>

namespace tensormass {
namespace {

struct Parallel : testing::TestWithParam<std::size_t> {};

TEST_P(Parallel, CallsTheBodyOnceForEachIndex) {
  std::vector<std::atomic<int>> calls(GetParam());
  parallel_for(calls.size(), [&](std::size_t i) { ++calls.at(i); });
  for (const std::atomic<int>& count : calls) EXPECT_EQ(count, 1);
}

TEST_P(Parallel, RangesCoverEachIndexOnceAndOnlyTheLastIsShorter) {
  for (const std::size_t grain : {std::size_t{1}, std::size_t{4}, std::size_t{1000}}) {
    std::vector<std::atomic<int>> calls(GetParam());
    std::atomic<int> shorter{0};
    parallel_ranges(calls.size(), grain, [&](std::size_t begin, std::size_t end) {
      EXPECT_EQ(begin % grain, 0u);
      EXPECT_LT(begin, end);
      EXPECT_LE(end - begin, grain);
      if (end - begin < grain) ++shorter;
      for (std::size_t i = begin; i < end; ++i) ++calls.at(i);
    });
    for (const std::atomic<int>& count : calls) EXPECT_EQ(count, 1);
    EXPECT_EQ(shorter, calls.size() % grain == 0 ? 0 : 1);
  }
}

TEST_P(Parallel, PassesOnWhatACallThrows) {
  if (GetParam() == 0) GTEST_SKIP() << "no call";
  std::atomic<std::size_t> calls{0};
  EXPECT_THROW(parallel_for(GetParam(),
                            [&](std::size_t i) {
                              ++calls;
                              if (i == GetParam() / 2) throw std::bad_alloc();
                            }),
               std::bad_alloc);
  EXPECT_GE(calls, 1u);
  EXPECT_LE(calls, GetParam());
}

INSTANTIATE_TEST_SUITE_P(Counts, Parallel, testing::Values(0, 1, 3, 4, 5, 257));

}  // namespace
}  // namespace tensormass
