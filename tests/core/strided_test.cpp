#include "core/strided.h"

#include <vector>

#include <gtest/gtest.h>

namespace tensormass {
namespace {

struct Strided : testing::TestWithParam<std::uint32_t> {};

TEST_P(Strided, UsesEachIndexOnceInOrderWithItsReadValue) {
  for (const std::uint32_t step : {1u, 3u}) {
    std::vector<std::uint32_t> expected, used;
    const std::uint32_t begin = 5, end = begin + GetParam();
    for (std::uint32_t i = begin; i < end; i += step) expected.push_back(i);
    for_each_strided<4>(
        begin, end, step, [](std::uint32_t i) { return 10 * i; },
        [&](std::uint32_t i, std::uint32_t read) {
          EXPECT_EQ(read, 10 * i);
          used.push_back(i);
        });
    EXPECT_EQ(used, expected);
  }
}

TEST_P(Strided, ReadsABatchBeforeTheFirstUseAndNothingBeyondTheEnd) {
  const std::uint32_t end = GetParam();
  std::uint32_t reads = 0, reads_before_use = 0;
  for_each_strided<4>(
      0, end, 1,
      [&](std::uint32_t i) {
        EXPECT_LT(i, end);
        ++reads;
        return i;
      },
      [&](std::uint32_t i, std::uint32_t) {
        if (i == 0) reads_before_use = reads;
      });
  EXPECT_EQ(reads_before_use, end > 0 ? 4 : 0);
}

INSTANTIATE_TEST_SUITE_P(Counts, Strided, testing::Values(0, 1, 3, 4, 5, 9));

}  // namespace
}  // namespace tensormass
