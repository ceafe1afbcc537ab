#include "bus/pose_rate.h"

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using namespace std::chrono_literals;
using Verdict = PoseRate::Verdict;

constexpr PoseRate::Time kStart{1h};

int taken(PoseRate& rate, std::uint64_t client, PoseRate::Time at, int sent) {
  int count = 0;
  for (int i = 0; i < sent; ++i) count += rate.take(client, at) == Verdict::kTaken;
  return count;
}

TEST(PoseRate, AFloodIsCutToTheRateAndToldOnceASecond) {
  PoseRate rate;
  EXPECT_EQ(taken(rate, 1, kStart, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond);
  EXPECT_EQ(rate.take(1, kStart), Verdict::kDroppedAndTold);
  EXPECT_EQ(rate.take(1, kStart), Verdict::kDropped);
  EXPECT_EQ(taken(rate, 1, kStart + 100ms, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond / 10);
  EXPECT_EQ(rate.take(1, kStart + 100ms), Verdict::kDropped);
  EXPECT_EQ(rate.take(1, kStart + 200ms), Verdict::kTaken);
  // All of what came back in 900 ms, and one more.
  EXPECT_EQ(taken(rate, 1, kStart + 1100ms, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond - 1);
  EXPECT_EQ(rate.take(1, kStart + 1100ms), Verdict::kDropped) << "told when the one before was dropped";
}

TEST(PoseRate, IsOfEachClient) {
  PoseRate rate;
  taken(rate, 1, kStart, limits::kMaxPosesPerSecond + 1);
  EXPECT_EQ(rate.take(2, kStart), Verdict::kTaken);
}

TEST(PoseRate, HonestHandsLoseNothing) {
  PoseRate rate;
  // Every tool of a scene at 1 kHz, and all of a second at once after a pause of the network.
  for (int ms = 0; ms < 5000; ++ms) ASSERT_EQ(taken(rate, 1, kStart + ms * 1ms, 16), 16) << ms;
  EXPECT_EQ(taken(rate, 1, kStart + 6000ms, 16'000), 16'000);
}

TEST(PoseRate, ForgetsClientsThatSendNoMore) {
  PoseRate rate;
  for (std::uint64_t client = 0; client < 10'000; ++client) {
    ASSERT_EQ(rate.take(client, kStart + std::chrono::milliseconds(client)), Verdict::kTaken);
  }
  EXPECT_LT(rate.client_count(), 2000u);
}

}  // namespace
}  // namespace tensormass::bus
