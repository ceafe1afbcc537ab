#include <gtest/gtest.h>

#include <atomic>
#include <cmath>
#include <limits>
#include <optional>
#include <utility>

#include "fakes.h"
#include "haptic/loop.h"
#include "haptic/simulated_device.h"

namespace tensormass::haptic {
namespace {

constexpr std::uint64_t kClientId = 42;

LoopOptions options(double duration_s) {
  LoopOptions o;
  o.duration_s = duration_s;
  o.drain_s = 0.1;
  o.client_id = kClientId;
  o.limits = {.max_force_n = 3.0, .max_slew_n_per_s = 1e5};
  return o;
}

struct Bench {
  FakeClock clock;
  FakeDevice device;
  FakeLink link;
  ForceGuard guard{device, clock, 0.05};
  std::atomic<bool> stop = false;
  std::uint64_t step = 0;

  Result<LoopReport> run(const LoopOptions& o) { return Loop(guard, link, clock, o).run(stop); }

  /// Answers every pose with a force, without delay.
  void answer_with(const Eigen::Vector3d& force_n) {
    link.answer = [this, force_n](const OutgoingPose& pose) {
      Feedback feedback = answer_to(pose, ++step);
      feedback.force_n = force_n;
      return std::optional(feedback);
    };
  }
};

TEST(Loop, SendsAPoseEachTickAndRendersTheAnswer) {
  Bench bench;
  bench.device.pose.position_m = {0.1, 0.2, 0.3};
  bench.answer_with({0.0, 0.0, 1.0});
  const LoopReport report = bench.run(options(0.1)).value();
  EXPECT_EQ(report.ticks, 100u);
  EXPECT_EQ(report.poses_sent, 100u);
  EXPECT_EQ(report.missed_ticks, 0u);
  ASSERT_EQ(bench.link.sent.size(), 100u);
  for (std::size_t i = 0; i < 100; ++i) {
    ASSERT_EQ(bench.link.sent[i].sequence, i + 1);
    ASSERT_EQ(bench.link.sent[i].client_id, kClientId);
    ASSERT_EQ(bench.link.sent[i].pose.position_m, bench.device.pose.position_m);
    ASSERT_EQ(bench.device.forces_n[i], Eigen::Vector3d(0.0, 0.0, 1.0));
  }
  EXPECT_EQ(report.feedback_received, 100u);
  EXPECT_EQ(report.last_sequence_echoed, 100u);
  EXPECT_EQ(report.round_trip.count(), 100u);
  EXPECT_EQ(report.stale_ticks, 0u);
  EXPECT_DOUBLE_EQ(report.max_force_n, 1.0);
}

/// Only the first answer to a pose says how long the pose waited; later ones wait for the next pose.
TEST(Loop, TellsWhereTheTimeOfAnAnswerWent) {
  constexpr std::int64_t kUs = 1000;
  Bench bench;
  bench.link.answer = [&](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++bench.step);
    if (bench.step % 2 == 0) feedback.pose_sequence = pose.sequence - 1;  // answered before
    feedback.arrival_ns = feedback.client_time_ns + 900 * kUs;
    feedback.waited_ns = 300 * kUs;
    feedback.step_ns = 200 * kUs;
    feedback.published_after_ns = 50 * kUs;
    return std::optional(feedback);
  };
  const LoopReport report = bench.run(options(0.1)).value();
  EXPECT_EQ(report.feedback_received, 100u);
  for (const auto& [histogram, us] : {std::pair{&report.pose_wait, 300}, std::pair{&report.step_time, 200},
                                      std::pair{&report.publication, 50}, std::pair{&report.transport, 350}}) {
    EXPECT_EQ(histogram->count(), 50u);
    EXPECT_NEAR(static_cast<double>(histogram->percentile_ns(0.5)), us * kUs, 0.04 * us * kUs) << "buckets of 3 %";
  }
}

TEST(Loop, BoundsItsOptionsByTheDevice) {
  for (const double asked : {1e3, std::numeric_limits<double>::infinity(), std::numeric_limits<double>::quiet_NaN()}) {
    Bench bench;
    bench.answer_with({0.0, 0.0, 50.0});
    LoopOptions o = options(0.1);
    o.limits.max_force_n = asked;
    EXPECT_DOUBLE_EQ(bench.run(o).value().max_force_n, bench.device.info().max_force_n);
  }
}

TEST(Loop, ChoosesItsOwnClientId) {
  Bench bench;
  LoopOptions o = options(0.01);
  o.client_id = 0;
  ASSERT_TRUE(bench.run(o));
  ASSERT_FALSE(bench.link.sent.empty());
  EXPECT_NE(bench.link.sent[0].client_id, 0u);
  EXPECT_NE(bench.link.sent[0].session, 0u);
  EXPECT_NE(bench.link.sent[0].session, bench.link.sent[0].client_id) << "everybody can read the id";
  EXPECT_EQ(bench.link.sent.back().session, bench.link.sent[0].session);
}

TEST(Loop, TellsWhoElseClaimsTheTool) {
  for (const bool claimed : {false, true}) {
    Bench bench;
    bench.link.answer = [claimed](const OutgoingPose& pose) {
      Feedback feedback = answer_to(pose, pose.sequence);
      feedback.client_id = 43;
      feedback.claimed = claimed;
      return std::optional(feedback);
    };
    std::atomic<std::uint64_t> claimed_by = 0;
    LoopOptions o = options(0.01);
    o.claimed_by = &claimed_by;
    const auto report = bench.run(o);
    ASSERT_TRUE(report);
    EXPECT_EQ(claimed_by, claimed ? 43u : 0u);
    EXPECT_EQ(report->feedback_claimed, claimed ? report->feedback_foreign : 0u);
    EXPECT_GT(report->feedback_foreign, 0u);
  }
}

/// A hand whose tool is removed feels nothing and waits; it feels the tool that comes in its place.
TEST(Loop, WaitsForAToolThatWasRemoved) {
  for (const bool comes_back : {false, true}) {
    Bench bench;
    std::atomic<bool> removed = false;
    int after = 0;
    bench.link.answer = [&, answers = 0](const OutgoingPose& pose) mutable {
      Feedback feedback = answer_to(pose, pose.sequence);
      ++answers;
      const bool gone = answers > 3 && (!comes_back || answers < 6);
      feedback.removed = gone;
      after = removed ? after + 1 : after;
      return gone && answers > 4 ? std::nullopt : std::optional(feedback);
    };
    LoopOptions o = options(0.01);
    o.removed = &removed;
    const auto report = bench.run(o);
    ASSERT_TRUE(report) << report.error().message;
    EXPECT_EQ(removed, !comes_back);
    EXPECT_GT(after, 0) << "the loop goes on";
  }
}

TEST(Loop, EndsWithoutForce) {
  Bench bench;
  bench.answer_with({0.0, 0.0, 1.0});
  ASSERT_TRUE(bench.run(options(0.01)));
  EXPECT_EQ(bench.device.forces_n.size(), 11u);
  EXPECT_EQ(bench.device.forces_n.back(), Eigen::Vector3d::Zero());
}

TEST(Loop, StopsAtOnceWhenAsked) {
  Bench bench;
  bench.answer_with({0.0, 0.0, 1.0});
  int wakes = 0;
  bench.clock.on_wake = [&](std::int64_t) { bench.stop = ++wakes == 5; };
  const LoopReport report = bench.run(options(100.0)).value();
  EXPECT_EQ(report.ticks, 4u);
  EXPECT_EQ(bench.device.forces_n.back(), Eigen::Vector3d::Zero());
}

TEST(Loop, FadesToZeroWhenFeedbackStops) {
  Bench bench;
  bench.link.answer = [&](const OutgoingPose& pose) -> std::optional<Feedback> {
    if (pose.sequence != 1) return std::nullopt;
    Feedback feedback = answer_to(pose, 1);
    feedback.force_n = {0.0, 0.0, 1.0};
    return feedback;
  };
  const LoopReport report = bench.run(options(0.2)).value();
  // The model is valid for 20 ms from the first tick, then fades for 50 ms.
  const auto at = [&](std::size_t tick) { return bench.device.forces_n[tick].z(); };
  EXPECT_DOUBLE_EQ(at(20), 1.0);
  EXPECT_NEAR(at(45), 0.5, 1e-9);
  EXPECT_EQ(at(70), 0.0);
  for (std::size_t i = 1; i < 200; ++i) ASSERT_LE(at(i), at(i - 1));
  EXPECT_EQ(report.stale_ticks, 200u - 21u);
  EXPECT_EQ(report.stale_episodes, 1u);
  EXPECT_EQ(report.last_sequence_sent, 200u);
  EXPECT_EQ(report.last_sequence_echoed, 1u) << "the loss must show";
}

TEST(Loop, RendersOnlyAnswersToItsOwnPoses) {
  Bench bench;
  const auto run_with = [&](auto change) {
    bench.link.answer = [change](const OutgoingPose& pose) {
      Feedback feedback = answer_to(pose, pose.sequence);
      feedback.force_n = {0.0, 0.0, 1.0};
      change(feedback);
      return std::optional(feedback);
    };
    FakeDevice device;
    ForceGuard guard(device, bench.clock, 0.05);
    const LoopReport report = Loop(guard, bench.link, bench.clock, options(0.02)).run(bench.stop).value();
    EXPECT_EQ(report.feedback_foreign, report.ticks);
    EXPECT_EQ(report.feedback_received, 0u);
    EXPECT_EQ(report.max_force_n, 0.0);
  };
  run_with([](Feedback& f) { f.client_id = 43; });
  run_with([](Feedback& f) { f.client_id = 0; });
  run_with([](Feedback& f) { f.pose_sequence += 1'000; });
  run_with([](Feedback& f) { f.client_time_ns = f.arrival_ns + 1; });
}

TEST(Loop, CountsStepsWhoseFeedbackWasReplaced) {
  Bench bench;
  bench.link.answer = [&](const OutgoingPose& pose) { return std::optional(answer_to(pose, 3 * pose.sequence)); };
  const LoopReport report = bench.run(options(0.1)).value();
  EXPECT_EQ(report.feedback_dropped, 2u * 99u);
}

TEST(Loop, CountsRecoveriesAndTellsThemWhileItRuns) {
  Bench bench;
  std::atomic<std::uint64_t> told = 0;
  bench.link.answer = [&](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++bench.step);
    feedback.recovering = bench.step == 20 || (bench.step > 50 && bench.step <= 60);
    if (bench.step == 55) {
      EXPECT_EQ(told, 2u);
    }
    return std::optional(feedback);
  };
  LoopOptions o = options(0.1);
  o.recoveries = &told;
  const LoopReport report = bench.run(o).value();
  EXPECT_EQ(report.recoveries, 2u);
  EXPECT_EQ(report.recovering_feedbacks, 11u);
  EXPECT_EQ(told, 2u);
}

TEST(Loop, ARecoveryDoesNotLetTheForceJump) {
  Bench bench;
  bench.link.answer = [&](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++bench.step);
    feedback.recovering = bench.step >= 50 && bench.step < 60;
    feedback.force_n.z() = bench.step < 50 ? 2.0 : 0.0;
    return std::optional(feedback);
  };
  ASSERT_TRUE(bench.run(options(0.12)));
  const auto& forces = bench.device.forces_n;
  for (std::size_t i = 1; i < 120; ++i) ASSERT_LE(std::abs(forces[i].z() - forces[i - 1].z()), 0.041) << "tick " << i;
  EXPECT_EQ(forces[119].z(), 0.0);
}

TEST(Loop, SkipsAndCountsMissedDeadlines) {
  Bench bench;
  bench.clock.lateness_ns = 2'500'000;  // every wake-up is two and a half periods late
  const LoopReport report = bench.run(options(0.301)).value();
  EXPECT_EQ(report.ticks, 100u);
  EXPECT_EQ(report.missed_ticks, 200u);
  EXPECT_EQ(report.wake_up_lateness.max_ns(), 2'500'000);
}

TEST(Loop, WaitsForTheEchoOfTheLastPoseWithoutForce) {
  Bench bench;
  std::optional<OutgoingPose> last;
  bench.link.answer = [&](const OutgoingPose& pose) -> std::optional<Feedback> {
    last = pose;
    return std::nullopt;
  };
  bench.clock.on_wake = [&](std::int64_t now_ns) {
    if (!last || last->sequence < 10 || now_ns < last->client_time_ns + 30'000'000) return;
    EXPECT_EQ(bench.device.forces_n.back(), Eigen::Vector3d::Zero());
    Feedback feedback = answer_to(*last, 1);
    feedback.arrival_ns = now_ns;
    bench.link.newest = feedback;
  };
  const LoopReport report = bench.run(options(0.01)).value();
  EXPECT_EQ(report.last_sequence_sent, 10u);
  EXPECT_EQ(report.last_sequence_echoed, 10u);
  EXPECT_NEAR(static_cast<double>(report.round_trip.max_ns()), 39e6, 2e6);
}

TEST(Loop, StopsWaitingForTheLastEchoAtTheDeadline) {
  Bench bench;
  const LoopReport report = bench.run(options(0.01)).value();
  EXPECT_EQ(report.last_sequence_echoed, 0u);
  EXPECT_LT(bench.clock.now_ns(), 1'000'000'000 + 10'000'000 + 100'000'000 + 5'000'000);
}

TEST(Loop, AfterTheWatchdogTheForceReturnsAtTheSlewLimit) {
  Bench bench;
  bench.answer_with({0.0, 0.0, 2.0});
  LoopOptions o = options(0.2);
  o.limits.max_slew_n_per_s = 100.0;
  int wakes = 0;
  bench.clock.on_wake = [&](std::int64_t) {
    if (++wakes != 100) return;
    bench.clock.advance_s(0.06);  // the loop stalls, and the watchdog checks
    bench.guard.check();
  };
  const LoopReport report = bench.run(o).value();
  EXPECT_EQ(report.watchdog_trips, 1u);
  const auto& forces = bench.device.forces_n;
  EXPECT_NEAR(forces[98].z(), 2.0, 1e-12);
  EXPECT_EQ(forces[99].z(), 0.0) << "the watchdog's";
  EXPECT_NEAR(forces[100].z(), 0.1, 1e-12) << "from zero, not from where it was";
}

TEST(Loop, ReturnsTheDevicesErrorWithoutForce) {
  Bench bench;
  bench.answer_with({0.0, 0.0, 1.0});
  int wakes = 0;
  bench.clock.on_wake = [&](std::int64_t) { bench.device.broken = ++wakes > 10; };
  const auto report = bench.run(options(1.0));
  ASSERT_FALSE(report);
  EXPECT_NE(report.error().message.find("unplugged"), std::string::npos);
  EXPECT_EQ(bench.device.forces_n.back(), Eigen::Vector3d::Zero());
}

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

TEST(Loop, AnInvalidPoseHasNoForceForItsTickOnly) {
  const DevicePose good{{0.1, 0.2, 0.3}, Eigen::Quaterniond::Identity()};
  const Eigen::Quaterniond upright = good.orientation;
  for (const DevicePose& invalid :
       {DevicePose{{0.1, kNan, 0.3}, upright}, DevicePose{{std::numeric_limits<double>::infinity(), 0.0, 0.0}, upright},
        DevicePose{{0.0, 0.0, -1.1e6}, upright}, DevicePose{good.position_m, Eigen::Quaterniond(1.01, 0.0, 0.0, 0.0)},
        DevicePose{good.position_m, Eigen::Quaterniond(0.0, 0.0, 0.0, 0.0)},
        DevicePose{good.position_m, Eigen::Quaterniond(1.0, kNan, 0.0, 0.0)},
        DevicePose{good.position_m, upright, kNan}, DevicePose{good.position_m, upright, 2.6},
        DevicePose{good.position_m, upright, -0.1}}) {
    Bench bench;
    bench.answer_with({0.0, 0.0, 1.0});
    int reads = 0;
    bench.device.on_read = [&] { bench.device.pose = ++reads == 50 ? invalid : good; };
    const LoopReport report = bench.run(options(0.1)).value();
    EXPECT_EQ(report.ticks, 100u);
    EXPECT_EQ(report.poses_invalid, 1u);
    EXPECT_EQ(report.poses_sent, 99u);
    EXPECT_EQ(report.last_sequence_sent, 99u) << "sequences count up without a gap";
    EXPECT_EQ(report.last_sequence_echoed, 99u);
    EXPECT_EQ(report.min_energy_j, 0.0);
    for (const OutgoingPose& pose : bench.link.sent) ASSERT_EQ(pose.pose.position_m, good.position_m);
    for (std::size_t i = 0; i < 100; ++i) ASSERT_EQ(bench.device.forces_n[i].z(), i == 49 ? 0.0 : 1.0) << "tick " << i;
  }
}

TEST(Loop, AcceptsAQuaternionThatIsAlmostNormalized) {
  Bench bench;
  bench.device.pose.orientation = Eigen::Quaterniond(0.0, 0.6 * 1.009, 0.0, 0.8 * 1.009);
  EXPECT_EQ(bench.run(options(0.01)).value().poses_invalid, 0u);
}

TEST(Loop, EndsAfterTooManyInvalidPosesInARow) {
  Bench bench;
  bench.answer_with({0.0, 0.0, 1.0});
  std::uint64_t reads = 0;
  // One below the limit, a valid pose, then invalid poses until the loop ends.
  bench.device.on_read = [&] { bench.device.pose.position_m.x() = ++reads == kMaxInvalidPosesInARow ? 0.1 : kNan; };
  const auto report = bench.run(options(1.0));
  ASSERT_FALSE(report);
  EXPECT_EQ(reads, 2 * kMaxInvalidPosesInARow);
  EXPECT_NE(report.error().message.find("device fake: 100 poses in a row"), std::string::npos)
      << report.error().message;
  EXPECT_NE(report.error().message.find("(nan, 0, 0) m"), std::string::npos) << report.error().message;
  EXPECT_EQ(bench.device.forces_n.back(), Eigen::Vector3d::Zero());
  EXPECT_EQ(bench.link.sent.size(), 1u);
}

// Runs the whole client against a soft wall. The wall steps at 60 Hz and answers one step late. The hand must press,
// feel the wall, come to rest against it and never shake.
TEST(Loop, PressesASoftWallWithoutShaking) {
  constexpr double kWall = 300.0;  // N/m, below z = 0
  constexpr std::int64_t kStepNs = 16'666'667;
  HandScriptOptions hand;
  hand.home_m = {0.0, 0.0, 0.02};
  hand.contact_m = {0.0, 0.0, 0.0};
  hand.depth_m = 0.01;
  hand.circle_radius_m = 0.0;
  FakeClock clock;
  SimulatedDevice device({}, HandScript::create(hand).value(), clock);
  ASSERT_TRUE(device.open());
  ForceGuard guard(device, clock, 0.05);

  FakeLink link;
  std::int64_t next_step_ns = clock.now_ns() + kStepNs;
  std::uint64_t step = 0;
  std::optional<OutgoingPose> picked_up;
  link.answer = [&](const OutgoingPose& pose) -> std::optional<Feedback> {
    if (pose.client_time_ns < next_step_ns) return std::nullopt;
    next_step_ns += kStepNs;
    const std::optional<OutgoingPose> answered = std::exchange(picked_up, pose);
    if (!answered) return std::nullopt;
    Feedback feedback = answer_to(*answered, ++step);
    feedback.arrival_ns = pose.client_time_ns;
    feedback.valid_for_s = 0.05;
    if (const double depth = -answered->pose.position_m.z(); depth > 0.0) {
      feedback.force_n = {0.0, 0.0, kWall * depth};
      feedback.stiffness_n_per_m(2, 2) = kWall;
      feedback.largest_stiffness_n_per_m = kWall;
    }
    return feedback;
  };
  // While the script holds still at full depth: circles of radius zero, two of the twelve seconds.
  double slowest_m_per_s = 0.0;
  double force_n = 0.0;
  const std::int64_t start_ns = clock.now_ns();
  clock.on_wake = [&](std::int64_t now_ns) {
    const double phase = std::fmod(static_cast<double>(now_ns - start_ns) / kNsPerS, 4.0) / 4.0;
    if (phase < 0.6 || phase > 0.8) return;
    slowest_m_per_s = std::max(slowest_m_per_s, device.velocity_m_per_s().norm());
    force_n = device.held_force_n().z();
  };
  LoopOptions o = options(12.0);
  o.limits.max_slew_n_per_s = 300.0;
  std::atomic<bool> stop = false;
  const LoopReport report = Loop(guard, link, clock, o).run(stop).value();
  EXPECT_LT(slowest_m_per_s, 1e-3);
  // The wall and the hand are springs of 300 N/m in series: they share 10 mm.
  EXPECT_NEAR(force_n, 1.5, 0.05);
  EXPECT_EQ(report.stale_ticks, 0u);
}

}  // namespace
}  // namespace tensormass::haptic
