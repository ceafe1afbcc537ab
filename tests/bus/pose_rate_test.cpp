#include "bus/pose_rate.h"

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

using namespace std::chrono_literals;
using Verdict = PoseRate::Verdict;

constexpr PoseRate::Time kStart{1h};

constexpr std::size_t kBytes = 200;  // a usual pose has so many

int taken(PoseRate& rate, std::uint64_t client, PoseRate::Time at, int sent) {
  int count = 0;
  for (int i = 0; i < sent; ++i) count += rate.take(client, kBytes, at) == Verdict::kTaken;
  return count;
}

TEST(PoseRate, AFloodIsCutToTheRateAndToldOnceASecond) {
  PoseRate rate;
  EXPECT_EQ(taken(rate, 1, kStart, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond);
  EXPECT_EQ(rate.take(1, kBytes, kStart), Verdict::kDroppedAndTold);
  EXPECT_EQ(rate.take(1, kBytes, kStart), Verdict::kDropped);
  EXPECT_EQ(taken(rate, 1, kStart + 100ms, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond / 10);
  EXPECT_EQ(rate.take(1, kBytes, kStart + 100ms), Verdict::kDropped);
  EXPECT_EQ(rate.take(1, kBytes, kStart + 200ms), Verdict::kTaken);
  // All of what came back in 900 ms, and one more.
  EXPECT_EQ(taken(rate, 1, kStart + 1100ms, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond - 1);
  EXPECT_EQ(rate.take(1, kBytes, kStart + 1100ms), Verdict::kDropped) << "told when the one before was dropped";
}

TEST(PoseRate, LongMessagesCountByTheirBytes) {
  PoseRate rate;
  constexpr std::size_t kLong = limits::kMaxPoseBytesPerSecond / 8;
  for (int i = 0; i < 8; ++i) EXPECT_EQ(rate.take(1, kLong, kStart), Verdict::kTaken) << i;
  EXPECT_EQ(rate.take(1, kBytes, kStart), Verdict::kDroppedAndTold);
  EXPECT_EQ(rate.take(1, kLong, kStart + 125ms), Verdict::kTaken);
}

TEST(PoseRate, WhoGoesOnBeyondItFloods) {
  PoseRate rate;
  // Twice the rate is one second ahead after each second.
  int dropped = 0;
  PoseRate::Time now = kStart;
  Verdict last = Verdict::kTaken;
  for (; now < kStart + 20s; now += 25us) {
    last = rate.take(1, kBytes, now);
    if (last == Verdict::kFloodAndTold) break;
    dropped += last == Verdict::kDropped;
  }
  EXPECT_EQ(last, Verdict::kFloodAndTold);
  EXPECT_NEAR(std::chrono::duration<double>(now - kStart).count(), limits::kMaxPoseLeadS, 0.1);
  EXPECT_NEAR(dropped, (limits::kMaxPoseLeadS - 1) * limits::kMaxPosesPerSecond, 100);
  EXPECT_EQ(rate.take(1, kBytes, now), Verdict::kFlood);
  EXPECT_EQ(rate.take(2, kBytes, now), Verdict::kTaken) << "others are not concerned";
  // A key that connects again has its rate, and floods again as soon as it goes on.
  EXPECT_EQ(taken(rate, 1, now + 1s, limits::kMaxPosesPerSecond), limits::kMaxPosesPerSecond);
  EXPECT_EQ(rate.take(1, kBytes, now + 1s), Verdict::kFloodAndTold);
  // A number that another connection gets is another client's.
  rate.forget(1);
  EXPECT_EQ(rate.take(1, kBytes, now + 1s), Verdict::kTaken);
}

TEST(PoseRate, IsOfEachClient) {
  PoseRate rate;
  taken(rate, 1, kStart, limits::kMaxPosesPerSecond + 1);
  EXPECT_EQ(rate.take(2, kBytes, kStart), Verdict::kTaken);
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
    ASSERT_EQ(rate.take(client, kBytes, kStart + std::chrono::milliseconds(client)), Verdict::kTaken);
  }
  EXPECT_LT(rate.client_count(), 2000u);
}

}  // namespace
}  // namespace tensormass::bus
