#include "world/step_clock.h"

#include <gtest/gtest.h>

/// Tests of the schedule with invented times: no test waits.
namespace tensormass::world {
namespace {

using namespace std::chrono_literals;

const Clock::time_point kStart{1s};

TEST(StepClock, KeepsTheRateIfStepsAreShorterThanThePeriod) {
  StepClock clock(100);
  clock.restart(kStart);
  for (int i = 0; i < 1000; ++i) {
    EXPECT_EQ(clock.begin(), kStart + i * 10ms);
    EXPECT_TRUE(clock.finish(clock.begin() + 9ms));
  }
}

TEST(StepClock, CatchesUpAfterALateStepAndCountsOnlyTheLateOnes) {
  StepClock clock(100);
  clock.restart(kStart);
  EXPECT_FALSE(clock.finish(kStart + 25ms)) << "due at 10 ms";
  EXPECT_EQ(clock.begin(), kStart + 10ms) << "the next is due already";
  EXPECT_FALSE(clock.finish(kStart + 27ms)) << "due at 20 ms";
  EXPECT_TRUE(clock.finish(kStart + 29ms)) << "caught up";
  EXPECT_EQ(clock.begin(), kStart + 30ms);
}

TEST(StepClock, AStepThatEndsExactlyAtItsDeadlineIsInTime) {
  StepClock clock(100);
  clock.restart(kStart);
  EXPECT_TRUE(clock.finish(kStart + 10ms)) << "the next step can start on time";
  EXPECT_FALSE(clock.finish(kStart + 20ms + 1ns));
}

TEST(StepClock, OwesNoMoreThanItsBacklog) {
  StepClock clock(100);
  clock.restart(kStart);
  clock.finish(kStart + 5s);
  EXPECT_EQ(clock.begin(), kStart + 5s - 20ms) << "simulated time slows instead of a burst of 500 steps";
}

TEST(StepStatistics, PercentilesCoverTheLast1024Steps) {
  StepStatistics statistics;
  EXPECT_EQ(statistics.percentiles().p50_s, 0);
  Clock::time_point end = kStart;
  const auto add = [&](int count, Clock::duration time) {
    for (int i = 0; i < count; ++i) statistics.add(time, end += 10ms, true);
  };
  add(100, 1ms);
  EXPECT_NEAR(statistics.percentiles().p50_s, 1e-3, 1e-9);
  add(3, 50ms);
  EXPECT_NEAR(statistics.percentiles().p50_s, 1e-3, 1e-9);
  EXPECT_NEAR(statistics.percentiles().p99_s, 50e-3, 1e-8);
  EXPECT_NEAR(statistics.percentiles().max_s, 50e-3, 1e-8);
  add(1024, 2ms);
  EXPECT_NEAR(statistics.percentiles().max_s, 2e-3, 1e-9) << "older steps are forgotten";
}

TEST(StepStatistics, CountsEveryStepSinceTheLoad) {
  StepStatistics statistics;
  const auto counted = [&](Clock::duration time) {
    return statistics.times().count(DurationBuckets::index_of(std::chrono::nanoseconds(time).count()));
  };
  for (int i = 0; i < 3000; ++i) statistics.add(i < 10 ? 50ms : 2ms, kStart + i * 10ms, true);
  EXPECT_EQ(counted(50ms), 10u) << "older than the window";
  EXPECT_EQ(counted(2ms), 2990u);
  EXPECT_EQ(statistics.times().max_ns(), std::chrono::nanoseconds(50ms).count());
  statistics.interrupt();
  EXPECT_EQ(counted(2ms), 2990u) << "a pause clears nothing";
}

TEST(StepStatistics, ReachedRateIsMeasuredOverASecondAndAnewAfterAnInterruption) {
  StepStatistics statistics;
  Clock::time_point end = kStart;
  for (int i = 0; i < 200; ++i) statistics.add(1ms, end += 10ms, true);
  EXPECT_NEAR(statistics.reached_rate_hz(), 100, 1e-6);
  statistics.interrupt();
  EXPECT_EQ(statistics.reached_rate_hz(), 0);
  end += 60s;  // paused
  for (int i = 0; i < 200; ++i) statistics.add(1ms, end += 20ms, true);
  EXPECT_NEAR(statistics.reached_rate_hz(), 50, 1e-6);
}

TEST(StepStatistics, CountsMissedDeadlines) {
  StepStatistics statistics;
  for (int i = 0; i < 5; ++i) statistics.add(1ms, kStart + i * 1ms, i % 2 == 0);
  EXPECT_EQ(statistics.missed_deadlines(), 2u);
}

}  // namespace
}  // namespace tensormass::world
