#include "core/assert.h"

#include <vector>

#include <gtest/gtest.h>

#include "core/offsets.h"

namespace tensormass {
namespace {

TEST(AssertDeathTest, AbortsAndPrintsPlaceConditionAndWords) {
  const int rows = 33;
  EXPECT_DEATH(TM_ASSERT(rows % 32 == 0, "patches end at slices"),
               "assert_test\\.cpp:[0-9]+: assertion failed: rows % 32 == 0 \\(patches end at slices\\)");
}

TEST(Assert, EvaluatesItsConditionOnceAndGoesOnWhenItHolds) {
  int evaluations = 0;
  TM_ASSERT(++evaluations == 1, "evaluated once");
  EXPECT_EQ(evaluations, 1);
}

TEST(Assert, IsAnExpression) {
  const auto checked = [](int value) { return TM_ASSERT(value > 0, "positive"), value; };
  EXPECT_EQ(checked(3), 3);
}

TEST(AssertOffsetsDeathTest, RefusesGapsAndDescents) {
  using Offsets = std::vector<std::uint32_t>;
  assert_offsets(Offsets{0, 3, 3, 7}, 3, 7);
  assert_offsets(Offsets{0}, 0, 0);
  EXPECT_DEATH(assert_offsets(Offsets{}, 0, 0), "each range has an offset");
  EXPECT_DEATH(assert_offsets(Offsets{0, 3, 7}, 3, 7), "each range has an offset");
  EXPECT_DEATH(assert_offsets(Offsets{1, 3, 3, 7}, 3, 7), "cover all items");
  EXPECT_DEATH(assert_offsets(Offsets{0, 3, 3, 6}, 3, 7), "cover all items");
  EXPECT_DEATH(assert_offsets(Offsets{0, 4, 3, 7}, 3, 7), "do not descend");
}

}  // namespace
}  // namespace tensormass
