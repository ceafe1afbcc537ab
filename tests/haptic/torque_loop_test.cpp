// The torque and the jaws' load on their whole way through the loop.

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "fakes.h"
#include "haptic/loop.h"
#include "haptic/run_device.h"
#include "haptic/simulated_device.h"

namespace tensormass::haptic {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
const Eigen::Vector3d kTorque(0.0, 0.06, -0.03);

LoopOptions options(double duration_s) {
  LoopOptions o;
  o.duration_s = duration_s;
  o.drain_s = 0.1;
  o.client_id = 42;
  o.limits.max_slew_n_per_s = 1e5;
  o.torque.max_slew_n_m_per_s = o.jaws.max_slew_n_m_per_s = 1e5;
  return o;
}

struct Bench {
  FakeClock clock;
  FakeWrist device;
  FakeLink link;
  ForceGuard guard{device, clock, 0.05};
  std::atomic<bool> stop = false;

  Bench() {
    link.answer = [](const OutgoingPose& pose) { return std::optional(pressed(pose)); };
  }
  static Feedback pressed(const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, pose.sequence);
    feedback.torque_n_m = kTorque;
    feedback.jaw_torque_n_m = 0.05;
    return feedback;
  }
  Result<LoopReport> run(const LoopOptions& o) { return Loop(guard, link, clock, o).run(stop); }
};

TEST(TorqueLoop, RendersTheAnswerAndEndsWithoutTorque) {
  Bench bench;
  const LoopReport report = bench.run(options(0.05)).value();
  ASSERT_EQ(bench.device.wrenches.size(), 51u);
  for (std::size_t i = 0; i < 50; ++i) {
    ASSERT_TRUE(bench.device.wrenches[i].torque_n_m.isApprox(kTorque, 1e-12));
    ASSERT_DOUBLE_EQ(bench.device.wrenches[i].jaw_torque_n_m, 0.05);
  }
  EXPECT_TRUE(bench.device.wrenches.back().is_zero());
  EXPECT_NEAR(report.max_torque_n_m.value(), kTorque.norm(), 1e-12);
  EXPECT_DOUBLE_EQ(report.max_jaw_torque_n_m.value(), 0.05);
}

TEST(TorqueLoop, BoundsItsOptionsByTheDevice) {
  for (const double asked : {1e3, std::numeric_limits<double>::infinity(), kNan}) {
    Bench bench;
    bench.link.answer = [](const OutgoingPose& pose) {
      Feedback feedback = Bench::pressed(pose);
      feedback.torque_n_m *= 100.0;
      feedback.jaw_torque_n_m = -50.0;
      return std::optional(feedback);
    };
    LoopOptions o = options(0.02);
    o.torque.max_torque_n_m = o.jaws.max_torque_n_m = asked;
    const LoopReport report = bench.run(o).value();
    EXPECT_NEAR(report.max_torque_n_m.value(), bench.device.info().max_torque_n_m, 1e-12);
    EXPECT_DOUBLE_EQ(report.max_jaw_torque_n_m.value(), bench.device.info().max_jaw_torque_n_m);
  }
}

TEST(TorqueLoop, FadesWithTheForceWhenFeedbackStops) {
  Bench bench;
  bench.link.answer = [](const OutgoingPose& pose) -> std::optional<Feedback> {
    if (pose.sequence != 1) return std::nullopt;
    return Bench::pressed(pose);
  };
  ASSERT_TRUE(bench.run(options(0.2)));
  // Valid for 20 ms from the first tick, then faded for 50 ms.
  const auto& wrenches = bench.device.wrenches;
  EXPECT_TRUE(wrenches[20].torque_n_m.isApprox(kTorque, 1e-12));
  EXPECT_TRUE(wrenches[45].torque_n_m.isApprox(0.5 * kTorque, 1e-6));
  EXPECT_NEAR(wrenches[45].jaw_torque_n_m, 0.025, 1e-9);
  for (std::size_t i = 70; i < 200; ++i) ASSERT_TRUE(wrenches[i].is_zero());
}

TEST(TorqueLoop, AValueThatIsNotFiniteBecomesZero) {
  Bench bench;
  bench.link.answer = [](const OutgoingPose& pose) {
    Feedback feedback = Bench::pressed(pose);
    feedback.force_n.z() = 1.0;
    feedback.torque_n_m.x() = feedback.jaw_torque_n_m = pose.sequence > 10 ? kNan : 0.0;
    return std::optional(feedback);
  };
  ASSERT_TRUE(bench.run(options(0.02)));
  for (std::size_t i = 0; i < 20; ++i) {
    const Wrench& wrench = bench.device.wrenches[i];
    ASSERT_TRUE(wrench.is_finite());
    ASSERT_EQ(wrench.torque_n_m.isZero(0.0), i >= 10) << i;
    ASSERT_EQ(wrench.force_n.z(), 1.0) << "the force goes on";
  }
}

TEST(TorqueLoop, AnInvalidPoseHasNoTorqueForItsTickOnly) {
  Bench bench;
  int reads = 0;
  bench.device.on_read = [&] { bench.device.pose.position_m.x() = ++reads == 10 ? kNan : 0.0; };
  ASSERT_TRUE(bench.run(options(0.02)));
  for (std::size_t i = 0; i < 20; ++i) ASSERT_EQ(bench.device.wrenches[i].is_zero(), i == 9) << i;
}

TEST(TorqueLoop, JawsWithoutAnAngleGetNoLoad) {
  Bench bench;
  bench.device.pose.jaw_angle_rad.reset();
  EXPECT_EQ(bench.run(options(0.02))->max_jaw_torque_n_m, 0.0);
}

TEST(TorqueLoop, ADeviceWithoutATorqueGetsTheSameForcesAsBefore) {
  Bench bench;
  bench.link.answer = [](const OutgoingPose& pose) {
    Feedback feedback = Bench::pressed(pose);
    feedback.force_n = {0.0, 0.0, 1.0};
    return std::optional(feedback);
  };
  FakeDevice device;  // fails if it gets a torque
  ForceGuard guard(device, bench.clock, 0.05);
  LoopReport report = Loop(guard, bench.link, bench.clock, options(0.02)).run(bench.stop).value();
  ASSERT_EQ(device.forces_n.size(), 21u);
  for (std::size_t i = 0; i < 20; ++i) ASSERT_EQ(device.forces_n[i], Eigen::Vector3d(0.0, 0.0, 1.0));
  EXPECT_EQ(device.forces_n.back(), Eigen::Vector3d::Zero());
  EXPECT_FALSE(report.max_torque_n_m);
  EXPECT_FALSE(report.max_jaw_torque_n_m);
}

/// Tissue under the tip of a tool along x, `late_s` away. The hand turns the tip into it.
class LateTissue final : public Link {
 public:
  static constexpr double kLeverM = 0.1, kStiffness = 500.0;  // 5 N m/rad

  LateTissue(double step_s, double late_s, bool sends_stiffness)
      : step_ns_(static_cast<std::int64_t>(step_s * kNsPerS)),
        late_ns_(static_cast<std::int64_t>(late_s * kNsPerS)),
        sends_stiffness_(sends_stiffness) {}

  bool send(const OutgoingPose& pose) override {
    if (pose.client_time_ns >= next_ns_) {
      next_ns_ = pose.client_time_ns + step_ns_;
      answers_.push_back(answer(pose));
    }
    now_ns_ = pose.client_time_ns;
    return true;
  }
  std::optional<Feedback> receive() override {
    if (answers_.empty() || answers_.front().arrival_ns > now_ns_) return std::nullopt;
    Feedback feedback = answers_.front();
    answers_.erase(answers_.begin());
    return feedback;
  }
  std::uint64_t malformed() const override { return 0; }

 private:
  Feedback answer(const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, ++step_);
    feedback.arrival_ns = pose.client_time_ns + late_ns_;
    feedback.valid_for_s = 0.2;
    const Eigen::Vector3d tip = pose.pose.orientation * (kLeverM * Eigen::Vector3d::UnitX());
    const double depth_m = kRestM - pose.pose.position_m.z() - tip.z();
    if (depth_m <= 0.0) return feedback;
    feedback.force_n.z() = kStiffness * depth_m;
    feedback.torque_n_m = tip.cross(feedback.force_n);
    if (sends_stiffness_) feedback.stiffness_n_per_m(2, 2) = feedback.largest_stiffness_n_per_m = kStiffness;
    return feedback;
  }

  static constexpr double kRestM = 0.001;  // the tip is pressed at first
  const std::int64_t step_ns_, late_ns_;
  const bool sends_stiffness_;
  std::int64_t next_ns_ = 0, now_ns_ = 0;
  std::uint64_t step_ = 0;
  std::vector<Feedback> answers_;
};

struct Turning {
  double last_speed_rad_per_s = 0.0;
  double max_torque_n_m = 0.0;
};

/// Runs 4 s with a hand that holds its place, and returns the largest angular speed of the last one.
Turning turn(double step_s, double late_s, bool sends_stiffness, double max_damping_n_m_s) {
  SimulatedDeviceOptions hand;
  hand.mass_kg = 10.0;  // keeps its place, so that only the rotation can shake
  hand.hand_stiffness_n_per_m = 1e5;
  hand.hand_damping_n_s_per_m = 1e3;
  hand.hand_angular_stiffness_n_m_per_rad = 0.3;
  hand.hand_angular_damping_n_m_s = 1e-3;
  HandScriptOptions still;
  still.depth_m = still.circle_radius_m = 0.0;
  FakeClock clock;
  SimulatedDevice device(hand, HandScript::create(still).value(), clock);
  EXPECT_TRUE(device.open());
  ForceGuard guard(device, clock, 0.05);
  LateTissue tissue(step_s, late_s, sends_stiffness);
  Turning turning;
  const std::int64_t start_ns = clock.now_ns();
  clock.on_wake = [&](std::int64_t now_ns) {
    if (now_ns - start_ns < 3 * static_cast<std::int64_t>(kNsPerS)) return;
    turning.last_speed_rad_per_s = std::max(turning.last_speed_rad_per_s, device.angular_velocity_rad_per_s().norm());
  };
  LoopOptions o;
  o.duration_s = 4.0;
  o.torque.max_damping_n_m_s = max_damping_n_m_s;
  const std::atomic<bool> stop = false;
  turning.max_torque_n_m = Loop(guard, tissue, clock, o).run(stop)->max_torque_n_m.value();
  return turning;
}

// 5 N m/rad at 60 Hz and up to 50 ms late.
TEST(TorqueLoop, AWristThatPressesLateTissueComesToRest) {
  for (const double late_s : {0.0, 0.005, 0.016, 0.033, 0.05}) {
    const Turning turning = turn(1.0 / 60.0, late_s, true, 1.0);
    EXPECT_LT(turning.last_speed_rad_per_s, 1e-2) << late_s;
    EXPECT_GT(turning.max_torque_n_m, 0.005) << "pressed";
  }
}

TEST(TorqueLoop, TheSameTissueShakesAWristWithoutModelAndController) {
  EXPECT_GT(turn(1.0 / 60.0, 0.016, false, 0.0).last_speed_rad_per_s, 1.0);
}

}  // namespace
}  // namespace tensormass::haptic
