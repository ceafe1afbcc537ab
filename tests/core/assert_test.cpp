#include "core/assert.h"

#include <gtest/gtest.h>

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

}  // namespace
}  // namespace tensormass
