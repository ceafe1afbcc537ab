#include "world/hand_phase.h"

#include <algorithm>
#include <random>
#include <vector>

#include <gtest/gtest.h>

#include "world/step_clock.h"

/// When a hand's pose starts a step, with invented times: no test waits.
namespace tensormass::world {
namespace {

using namespace std::chrono_literals;

const Clock::time_point kStart{1s};

struct Step {
  Clock::time_point scheduled, start, pose{};  ///< pose: arrival of the newest one at the start
  bool is_new = false;                         ///< no earlier step used that pose
  Clock::duration waited() const { return start - pose; }
};

struct Hand {
  double rate_hz = 1000;
  Clock::duration jitter{};  ///< each pose comes up to that much early or late
  Clock::duration offset{};
};

std::vector<Clock::time_point> arrivals(const Hand& hand, Clock::duration length) {
  std::mt19937 random(7);
  std::uniform_real_distribution<double> part(-1, 1);
  std::vector<Clock::time_point> out;
  for (int n = 0; out.empty() || out.back() < kStart + length; ++n) {
    const std::chrono::duration<double> at(n / hand.rate_hz);
    out.push_back(kStart + hand.offset + std::chrono::duration_cast<Clock::duration>(at) +
                  std::chrono::duration_cast<Clock::duration>(part(random) * hand.jitter));
  }
  std::sort(out.begin(), out.end());
  return out;
}

/// What a loop does that listens to a hand: the steps of a scene of `rate_hz` that each take `step_time`.
///
///   poses     arrivals, ascending; pose i has sequence i + 1
///   listens   false: steps start by their schedule only
std::vector<Step> run(double rate_hz, Clock::duration step_time, const std::vector<Clock::time_point>& poses,
                      Clock::duration length, bool listens = true) {
  StepClock clock(rate_hz);
  HandPhase hand(clock.period());
  clock.restart(kStart);
  std::vector<Step> steps;
  std::uint64_t used = 0;  // sequence of the newest pose that a step used
  for (Clock::time_point free = kStart; free < kStart + length;) {
    Step step{.scheduled = clock.begin(), .start = std::max(free, clock.begin())};
    if (listens) {
      const Clock::time_point from = std::max(free, hand.listen_from(clock.begin()));
      for (const Clock::time_point arrived : poses) {
        if (std::max(arrived, from) >= step.start) break;
        const auto newest = std::upper_bound(poses.begin(), poses.end(), std::max(arrived, from)) - 1;
        if (hand.starts(*newest, clock.begin())) step.start = std::max(arrived, from);
      }
    }
    const auto after = std::upper_bound(poses.begin(), poses.end(), step.start);
    if (after != poses.begin()) {
      const auto sequence = static_cast<std::uint64_t>(after - poses.begin());
      step.pose = *(after - 1);
      step.is_new = sequence > used;
      if (step.is_new) hand.take({.sequence = sequence, .client_id = 5, .arrived = step.pose});
      used = sequence;
    }
    free = step.start + step_time;
    clock.finish(free);
    steps.push_back(step);
  }
  return steps;
}

/// The part of the poses that were used which waited for less than `limit`; the first steps learn the hand's rhythm.
double part_below(const std::vector<Step>& steps, Clock::duration limit) {
  std::size_t all = 0, below = 0;
  for (std::size_t n = 50; n < steps.size(); ++n) {
    if (!steps[n].is_new) continue;
    ++all;
    if (steps[n].waited() < limit) ++below;
  }
  return static_cast<double>(below) / static_cast<double>(all);
}

/// None after its schedule but for a step before that was still at work, none more than a period and a quarter before.
void expect_keeps_schedule(const std::vector<Step>& steps, double rate_hz, Clock::duration step_time) {
  const auto period = StepClock(rate_hz).period();
  for (std::size_t n = 1; n < steps.size(); ++n) {
    EXPECT_LE(steps[n].start, std::max(steps[n].scheduled, steps[n - 1].start + step_time)) << n;
    EXPECT_GE(steps[n].start, steps[n].scheduled - period - period / 4) << n;
    EXPECT_EQ(steps[n].scheduled - steps[n - 1].scheduled, period) << n;
  }
}

TEST(HandPhase, PosesOfAFasterClockDoNotWait) {
  const auto poses = arrivals({}, 2s);
  const auto steps = run(960, 700us, poses, 2s);
  expect_keeps_schedule(steps, 960, 700us);
  EXPECT_GT(part_below(steps, 10us), 0.99);
  EXPECT_LT(part_below(run(960, 700us, poses, 2s, false), 500us), 0.55) << "by the schedule half of them wait longer";
}

TEST(HandPhase, JitterCostsLittle) {
  const auto poses = arrivals({.jitter = 100us}, 2s);
  const auto steps = run(960, 700us, poses, 2s);
  expect_keeps_schedule(steps, 960, 700us);
  EXPECT_GT(part_below(steps, 50us), 0.8);
}

/// Steps that had no new pose, because it came right after their start.
double part_without_pose(const std::vector<Step>& steps) {
  const auto without = std::count_if(steps.begin() + 50, steps.end(), [](const Step& s) { return !s.is_new; });
  return static_cast<double>(without) / static_cast<double>(steps.size() - 50);
}

/// A hand whose clock is nearly that of the scene stays near the same phase for seconds. Wherever that is, jitter must
/// not make poses come just after the step that they were for.
TEST(HandPhase, KeepsTheLockAtEqualRates) {
  for (const double drift_hz : {-0.05, 0.0, 0.05}) {
    for (const Clock::duration offset : {0us, 300us}) {
      SCOPED_TRACE(testing::Message() << drift_hz << " Hz, offset " << offset.count() << " ns");
      const auto poses = arrivals({.rate_hz = 960 + drift_hz, .jitter = 100us, .offset = offset}, 5s);
      const auto steps = run(960, 740us, poses, 5s);
      expect_keeps_schedule(steps, 960, 740us);
      EXPECT_GT(part_below(steps, 30us), 0.99);
      EXPECT_LT(part_without_pose(steps), 0.001);
    }
  }
}

TEST(HandPhase, KeepsTheLockWhereTheRatesDiffer) {
  const auto steps = run(960, 740us, arrivals({.jitter = 100us}, 5s), 5s);
  EXPECT_GT(part_below(steps, 30us), 0.99);
  EXPECT_EQ(part_without_pose(steps), 0);
}

/// A client may send what it likes: the schedule, and so rate and simulated time, stay as they are.
TEST(HandPhase, NoClientMovesTheSchedule) {
  std::mt19937_64 random(3);
  for (int client = 0; client < 50; ++client) {
    const auto period = std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1.0 / 960));
    StepClock clock(960);
    HandPhase hand(clock.period());
    clock.restart(kStart);
    Clock::time_point scheduled = kStart, newest = kStart;
    std::uint64_t sequence = 0;
    for (int n = 0; n < 2000; ++n) {
      ASSERT_EQ(clock.begin(), scheduled);
      ASSERT_LE(hand.listen_from(clock.begin()), clock.begin()) << "it must not wait for a pose";
      ASSERT_GE(hand.listen_from(clock.begin()), clock.begin() - period - period / 4);
      sequence = client % 2 == 0 ? random() : sequence + random() % 3;
      newest = std::max(newest, clock.begin() - Clock::duration(random() % 2'000'000));
      const bool early = hand.starts(newest, clock.begin());
      if (early || random() % 2 == 0) hand.take({.sequence = sequence, .client_id = random() % 2, .arrived = newest});
      const Clock::time_point start = early ? std::max(newest, hand.listen_from(clock.begin())) : clock.begin();
      hand.take_lead(clock.begin() - start);
      ASSERT_LE(hand.lead(), period + period / 4);
      scheduled += period;
      ASSERT_TRUE(clock.finish(start + 500us)) << "an early step misses no deadline";
    }
  }
}

TEST(HandPhase, TellsPeriodAndLead) {
  HandPhase hand(10ms);
  EXPECT_EQ(hand.pose_period(), 0ms);
  EXPECT_EQ(hand.lead(), 0ms);
  for (std::uint64_t n = 1; n < 200; ++n) {
    hand.take({.sequence = n, .client_id = 1, .arrived = kStart + n * 2ms});
    hand.take_lead(3ms);
  }
  EXPECT_EQ(hand.pose_period(), 2ms);
  EXPECT_NEAR(std::chrono::duration<double>(hand.lead()).count(), 3e-3, 1e-6);
}

TEST(HandPhase, AStepThatTakesNearlyAPeriodStillGains) {
  const auto poses = arrivals({.offset = 300us}, 2s);
  const auto steps = run(960, 1000us, poses, 2s);
  expect_keeps_schedule(steps, 960, 1000us);
  const auto mean = [](const std::vector<Step>& of) {
    Clock::duration sum{};
    for (std::size_t n = 50; n < of.size(); ++n) sum += of[n].waited();
    return sum / static_cast<Clock::rep>(of.size() - 50);
  };
  EXPECT_LT(20 * mean(steps), mean(run(960, 1000us, poses, 2s, false)));
}

TEST(HandPhase, ASlowSceneListensOnlyForTheLastPose) {
  const auto steps = run(60, 9ms, arrivals({.offset = 200us}, 4s), 4s);
  expect_keeps_schedule(steps, 60, 9ms);
  for (std::size_t n = 50; n < steps.size(); ++n) {
    EXPECT_GE(steps[n].start, steps[n].scheduled - 1250us) << "earlier, another pose was to come";
  }
  EXPECT_GT(part_below(steps, 10us), 0.99);
}

/// A mouse sends fewer poses than the scene makes steps. Those between two poses keep their time.
TEST(HandPhase, ASlowHandStartsTheStepsThatHaveItsPoses) {
  const auto steps = run(960, 300us, arrivals({.rate_hz = 125, .offset = 200us}, 4s), 4s);
  expect_keeps_schedule(steps, 960, 300us);
  EXPECT_EQ(part_below(steps, 301us), 1) << "a pose waits for the end of the step at work, and for nothing else";
  EXPECT_GT(part_below(steps, 10us), 0.65);
  const auto by_schedule =
      std::count_if(steps.begin(), steps.end(), [](const Step& s) { return s.start == s.scheduled; });
  EXPECT_GT(by_schedule, 4 * 800);
}

TEST(HandPhase, NothingChangesAfterTheHandHasStopped) {
  auto poses = arrivals({}, 2s);
  poses.resize(1000);
  const auto steps = run(960, 700us, poses, 2s);
  expect_keeps_schedule(steps, 960, 700us);
  for (std::size_t n = 970; n < steps.size(); ++n) EXPECT_EQ(steps[n].start, steps[n].scheduled) << n;
}

/// An eighth of the poses arrives, as on a network that loses messages.
TEST(HandPhase, PosesThatNobodySawCount) {
  HandPhase hand(10ms);
  for (std::uint64_t n = 1; n < 100; ++n) hand.take({.sequence = 8 * n, .client_id = 1, .arrived = kStart + n * 8ms});
  const Clock::time_point begin = kStart + 900ms;
  EXPECT_FALSE(hand.starts(begin - 1300us, begin)) << "another one comes 0.3 ms before";
  EXPECT_TRUE(hand.starts(begin - 1200us, begin)) << "another one comes within the margin";
  EXPECT_TRUE(hand.starts(begin - 1000us, begin));
}

TEST(HandPhase, AnotherClientHasAnotherRhythm) {
  HandPhase hand(10ms);
  for (std::uint64_t n = 1; n < 100; ++n) hand.take({.sequence = n, .client_id = 1, .arrived = kStart + n * 1ms});
  const Clock::time_point begin = kStart + 200ms;
  EXPECT_EQ(hand.listen_from(begin), begin - 1250us);
  hand.take({.sequence = 500, .client_id = 2, .arrived = kStart + 100ms});
  EXPECT_EQ(hand.listen_from(begin), begin - 10ms) << "not known: every pose may be the last";
  EXPECT_TRUE(hand.starts(begin - 9ms, begin));
}

/// Whatever numbers a client sends, no step starts later than its schedule.
TEST(HandPhase, NumbersThatJumpAreARhythmOfTheirOwn) {
  for (const std::uint64_t next : {std::uint64_t{0}, std::uint64_t{1}, ~std::uint64_t{0}, std::uint64_t{1} << 63}) {
    HandPhase hand(10ms);
    hand.take({.sequence = 1, .client_id = 1, .arrived = kStart});
    hand.take({.sequence = 2, .client_id = 1, .arrived = kStart + 1ms});
    hand.take({.sequence = next, .client_id = 1, .arrived = kStart + 2ms});
    EXPECT_EQ(hand.listen_from(kStart + 1s), kStart + 990ms) << next;
  }
}

TEST(HandPhase, APoseStartsOneStep) {
  HandPhase hand(1ms);
  const Clock::time_point arrived = kStart + 10ms;
  EXPECT_TRUE(hand.starts(arrived, kStart + 10500us));
  hand.take({.sequence = 1, .client_id = 1, .arrived = arrived});
  EXPECT_FALSE(hand.starts(arrived, kStart + 11ms));
}

}  // namespace
}  // namespace tensormass::world
