#include "core/offsets.h"

#include <vector>

#include <gtest/gtest.h>

namespace tensormass {
namespace {

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
