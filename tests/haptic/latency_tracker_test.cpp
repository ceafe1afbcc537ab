#include <gtest/gtest.h>

#include "haptic/latency_tracker.h"

namespace tensormass::haptic {
namespace {

TEST(LatencyTracker, APoseIsAnsweredByItsOwnEchoOrANewerOne) {
  LatencyTracker tracker;
  tracker.sent(1, 100);
  tracker.sent(2, 110);
  tracker.sent(3, 120);
  ASSERT_TRUE(tracker.echoed(2, 150));
  // 50 ns for the first pose, which the echo of the second answers, and 40 ns for the second.
  EXPECT_EQ(tracker.round_trip().count(), 2u);
  EXPECT_EQ(tracker.round_trip().buckets()[50], 1u);
  EXPECT_EQ(tracker.round_trip().buckets()[40], 1u);
  EXPECT_EQ(tracker.last_echoed(), 2u);
  ASSERT_TRUE(tracker.echoed(2, 170));
  EXPECT_EQ(tracker.round_trip().count(), 2u) << "only the first answer counts";
  ASSERT_TRUE(tracker.echoed(3, 180));
  EXPECT_EQ(tracker.round_trip().buckets()[60], 1u);
}

TEST(LatencyTracker, RefusesEchoesOfPosesThatWereNeverSent) {
  LatencyTracker tracker;
  EXPECT_FALSE(tracker.echoed(0, 10));
  EXPECT_FALSE(tracker.echoed(1, 10));
  tracker.sent(1, 10);
  EXPECT_FALSE(tracker.echoed(2, 20));
  EXPECT_EQ(tracker.round_trip().count(), 0u);
  EXPECT_EQ(tracker.last_echoed(), 0u);
}

TEST(LatencyTracker, CountsThePosesWhoseTimeWasOverwritten) {
  LatencyTracker tracker;
  constexpr std::uint64_t kSent = 20'000;
  for (std::uint64_t s = 1; s <= kSent; ++s) tracker.sent(s, static_cast<std::int64_t>(s));
  ASSERT_TRUE(tracker.echoed(kSent, static_cast<std::int64_t>(kSent)));
  EXPECT_EQ(tracker.forgotten(), kSent - 16'384);
  EXPECT_EQ(tracker.round_trip().count(), 16'384u);
  EXPECT_EQ(tracker.round_trip().max_ns(), 16'383);
}

TEST(LatencyTracker, AnOldEchoAfterALongSilenceCountsThemToo) {
  LatencyTracker tracker;
  for (std::uint64_t s = 1; s <= 20'000; ++s) tracker.sent(s, static_cast<std::int64_t>(s));
  ASSERT_TRUE(tracker.echoed(1'000, 20'000));
  EXPECT_EQ(tracker.forgotten(), 1'000u);
  EXPECT_EQ(tracker.round_trip().count(), 0u);
}

}  // namespace
}  // namespace tensormass::haptic
