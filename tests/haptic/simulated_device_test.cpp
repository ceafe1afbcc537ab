#include <gtest/gtest.h>

#include <cmath>

#include "fakes.h"
#include "haptic/simulated_device.h"

namespace tensormass::haptic {
namespace {

// Options of a hand that stays at the origin.
HandScript still_hand() {
  HandScriptOptions options;
  options.depth_m = 0.0;
  options.circle_radius_m = 0.0;
  return HandScript::create(options).value();
}

SimulatedDeviceOptions oscillator(double damping) {
  SimulatedDeviceOptions options;
  options.mass_kg = 0.2;
  options.damping_n_s_per_m = 0.5 * damping;
  options.hand_stiffness_n_per_m = 300.0;
  options.hand_damping_n_s_per_m = 0.5 * damping;
  return options;
}

// Returns x(t) of m x'' + c x' + k x = F from rest at 0: F/k (1 − e^{−ζωt} (cos ω_d t + ζω/ω_d sin ω_d t)) with
// ω = sqrt(k/m), ζ = c/(2 m ω), ω_d = ω sqrt(1 − ζ²), which is complex if overdamped.
double step_response(double m, double c, double k, double force, double t) {
  const double decay = c / (2.0 * m);
  const double square = k / m - decay * decay;
  const double w = std::sqrt(std::abs(square));
  const double even = square > 0.0 ? std::cos(w * t) : std::cosh(w * t);
  const double odd = square > 0.0 ? std::sin(w * t) / w : std::sinh(w * t) / w;
  return force / k * (1.0 - std::exp(-decay * t) * (even + decay * odd));
}

class StepResponse : public testing::TestWithParam<double> {};

TEST_P(StepResponse, MatchesTheClosedForm) {
  const double damping = GetParam();
  FakeClock clock;
  SimulatedDevice device(oscillator(damping), still_hand(), clock);
  ASSERT_TRUE(device.open());
  ASSERT_TRUE(device.write_force({0.0, 3.0, 0.0}));
  for (int i = 1; i <= 500; ++i) {
    clock.advance_s(1e-3);
    const Eigen::Vector3d x = device.read().value().position_m;
    ASSERT_NEAR(x.y(), step_response(0.2, damping, 300.0, 3.0, i * 1e-3), 1e-12) << "after " << i << " ms";
    ASSERT_EQ(x.x(), 0.0);
  }
}

// Undamped, underdamped, close to critical, overdamped.
INSTANTIATE_TEST_SUITE_P(Damping, StepResponse, testing::Values(0.0, 4.0, 2.0 * std::sqrt(300.0 * 0.2) * 0.999, 60.0));

TEST(SimulatedDevice, FollowsTheHand) {
  HandScriptOptions hand;
  hand.home_m = {0.0, 0.0, 0.1};
  const HandScript script = HandScript::create(hand).value();
  FakeClock clock;
  SimulatedDeviceOptions options;
  options.damping_n_s_per_m = 0.0;
  SimulatedDevice device(options, script, clock);
  ASSERT_TRUE(device.open());
  for (int i = 1; i <= 4000; ++i) {
    clock.advance_s(1e-3);
    const Eigen::Vector3d target = script.at(i * 1e-3).position_m;
    // Without a force the lag is m x''/k, which is below 1 mm on this path.
    ASSERT_LT((device.read().value().position_m - target).norm(), 1e-3) << "after " << i << " ms";
  }
}

// Covers the extremes of the program's options, and a stiff damper between them.
TEST(SimulatedDevice, IsStableForEveryHandThatItsOptionsAllow) {
  HandScriptOptions hand;
  hand.home_m = {0.0, 0.0, 0.1};
  const HandScript script = HandScript::create(hand).value();
  for (const double mass : {1e-6, 0.01, 1e6}) {
    for (const double stiffness : {1e-6, 300.0, 1e6}) {
      for (const double damping : {0.0, 8.0, 1e6}) {
        FakeClock clock;
        SimulatedDevice device(
            {.mass_kg = mass, .hand_stiffness_n_per_m = stiffness, .hand_damping_n_s_per_m = damping}, script, clock);
        ASSERT_TRUE(device.open());
        for (int i = 0; i < 100; ++i) {
          clock.advance_s(1e-2);
          const Eigen::Vector3d x = device.read().value().position_m;
          ASSERT_LT(x.norm(), 1.0) << mass << " kg, " << stiffness << " N/m, " << damping << " N s/m";
        }
      }
    }
  }
}

TEST(SimulatedDevice, AStiffDamperCarriesItAlong) {
  HandScriptOptions hand;
  hand.home_m = {0.0, 0.0, 0.1};
  const HandScript script = HandScript::create(hand).value();
  FakeClock clock;
  SimulatedDevice device({.mass_kg = 0.01, .hand_damping_n_s_per_m = 1e6}, script, clock);
  ASSERT_TRUE(device.open());
  for (int i = 1; i <= 4000; ++i) {
    clock.advance_s(1e-3);
    const Eigen::Vector3d target = script.at(i * 1e-3).position_m;
    ASSERT_LT((device.read().value().position_m - target).norm(), 1e-5) << "after " << i << " ms";
  }
}

TEST(SimulatedDevice, GainsNoEnergyOverTime) {
  FakeClock clock;
  SimulatedDevice device(oscillator(0.0), still_hand(), clock);
  ASSERT_TRUE(device.open());
  ASSERT_TRUE(device.write_force({1.0, 0.0, 0.0}));
  clock.advance_s(0.5);
  ASSERT_TRUE(device.write_force(Eigen::Vector3d::Zero()));
  const auto energy = [&] {
    const Eigen::Vector3d x = device.read().value().position_m;
    return 0.5 * 300.0 * x.squaredNorm() + 0.5 * 0.2 * device.velocity_m_per_s().squaredNorm();
  };
  const double before = energy();
  clock.advance_s(1.0);
  EXPECT_NEAR(energy(), before, 1e-9 * before);
}

TEST(SimulatedDevice, TorquesTurnTheGripAndTheJawsInClosedForm) {
  SimulatedDeviceOptions options;
  options.inertia_kg_m2 = 1e-3;
  options.hand_angular_stiffness_n_m_per_rad = 1.5;
  options.hand_angular_damping_n_m_s = 0.01;
  options.angular_damping_n_m_s = 0.005;
  options.jaw_angle_rad = 0.4;
  FakeClock clock;
  SimulatedDevice device(options, still_hand(), clock);
  ASSERT_TRUE(device.open());
  EXPECT_EQ(device.read()->orientation.coeffs(), Eigen::Quaterniond::Identity().coeffs());
  ASSERT_TRUE(device.write({Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.1, 0.0), -0.2}));
  for (int i = 1; i <= 200; ++i) {
    clock.advance_s(1e-3);
    const DevicePose pose = device.read().value();
    const Eigen::AngleAxisd turn(pose.orientation);
    ASSERT_NEAR(turn.angle() * turn.axis().y(), step_response(1e-3, 0.015, 1.5, 0.1, i * 1e-3), 1e-9);
    ASSERT_NEAR(*pose.jaw_angle_rad, 0.4 + step_response(1e-3, 0.015, 1.5, -0.2, i * 1e-3), 1e-9);
    ASSERT_EQ(pose.position_m, Eigen::Vector3d::Zero());
  }
}

TEST(SimulatedDevice, HasJawsOnlyIfItsFingersHoldThem) {
  FakeClock clock;
  SimulatedDevice without({}, still_hand(), clock);
  ASSERT_TRUE(without.open());
  EXPECT_FALSE(without.read()->jaw_angle_rad);
  EXPECT_EQ(without.info().max_jaw_torque_n_m, 0.0);
  SimulatedDeviceOptions closed;
  closed.jaw_angle_rad = 0.0;
  SimulatedDevice with(closed, still_hand(), clock);
  ASSERT_TRUE(with.open());
  EXPECT_GT(with.info().max_jaw_torque_n_m, 0.0);
  ASSERT_TRUE(with.write({Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), -0.3}));
  clock.advance_s(0.1);
  EXPECT_EQ(with.read()->jaw_angle_rad, 0.0) << "the stop";
}

TEST(SimulatedDevice, SkipsTheMotionOfALongStall) {
  FakeClock clock;
  SimulatedDevice device(oscillator(4.0), still_hand(), clock);
  ASSERT_TRUE(device.open());
  ASSERT_TRUE(device.write_force({1.0, 0.0, 0.0}));
  clock.advance_s(1e7);  // a replay would take 1e11 sub-steps
  EXPECT_NEAR(device.read().value().position_m.x(), 1.0 / 300.0, 1e-6);
}

TEST(SimulatedDevice, RefusesInvalidOptionsAndUseBeforeOpen) {
  FakeClock clock;
  SimulatedDevice closed(oscillator(0.0), still_hand(), clock);
  EXPECT_FALSE(closed.read());
  EXPECT_FALSE(closed.write_force(Eigen::Vector3d::Zero()));
  SimulatedDeviceOptions massless = oscillator(0.0);
  massless.mass_kg = 0.0;
  EXPECT_FALSE(SimulatedDevice(massless, still_hand(), clock).open());
  SimulatedDeviceOptions pushing = oscillator(-1.0);
  EXPECT_FALSE(SimulatedDevice(pushing, still_hand(), clock).open());
  SimulatedDeviceOptions weightless = oscillator(0.0);
  weightless.inertia_kg_m2 = 0.0;
  EXPECT_FALSE(SimulatedDevice(weightless, still_hand(), clock).open());
  SimulatedDeviceOptions wide = oscillator(0.0);
  wide.jaw_angle_rad = 3.0;
  EXPECT_FALSE(SimulatedDevice(wide, still_hand(), clock).open());
}

}  // namespace
}  // namespace tensormass::haptic
