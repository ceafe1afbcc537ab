#include "haptic/torque_channel.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace tensormass::haptic {
namespace {

constexpr double kPeriodS = 1e-3;
constexpr TorqueOptions kFast{
    .max_torque_n_m = 0.2, .max_slew_n_m_per_s = 1e6, .max_stored_energy_j = 0.01, .max_damping_n_m_s = 0.05};
const Eigen::Vector3d kZero = Eigen::Vector3d::Zero();

TEST(TorqueChannel, LimitsSlewThenMagnitudeAndKeepsTheDirection) {
  TorqueChannel fast(kFast);
  EXPECT_TRUE(fast.apply(kZero, kZero, {0.3, 0.4, 0.0}, kPeriodS).isApprox(Eigen::Vector3d(0.12, 0.16, 0.0), 1e-12));
  TorqueOptions slow = kFast;
  slow.max_slew_n_m_per_s = 5.0;
  EXPECT_TRUE(
      TorqueChannel(slow).apply(kZero, kZero, {0.1, 0.0, 0.0}, kPeriodS).isApprox(Eigen::Vector3d(0.005, 0, 0)));
  EXPECT_NEAR(TorqueChannel(slow).apply(0.0, 0.1, -0.1, kPeriodS), 0.095, 1e-12);
}

TEST(TorqueChannel, ATorqueThatIsNotFiniteBecomesZeroAtOnce) {
  for (const double bad : {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    EXPECT_EQ(TorqueChannel(kFast).apply(kZero, {0.0, 0.1, 0.0}, {bad, 0.1, 0.0}, kPeriodS), kZero);
    EXPECT_EQ(TorqueChannel(kFast).apply(0.0, 0.1, bad, kPeriodS), 0.0);
  }
}

TEST(TorqueChannel, WithoutALimitThereIsNoTorque) {
  for (const double none : {0.0, -1.0, std::numeric_limits<double>::quiet_NaN()}) {
    TorqueOptions options = kFast;
    options.max_torque_n_m = none;
    EXPECT_EQ(TorqueChannel(options).apply(kZero, {0.1, 0.0, 0.0}, {0.1, 0.0, 0.0}, kPeriodS), kZero);
  }
}

// Returns the largest speed in the last fifth of two seconds over the first speed: an inertia on a torsional spring
// that a server renders `delay` periods late.
double speed_growth(double max_damping_n_m_s, int delay) {
  constexpr double kInertiaKgM2 = 5e-4, kStiffness = 0.8, kFirstSpeed = 0.2;
  constexpr int kSteps = 2000;
  TorqueOptions options;
  options.max_damping_n_m_s = max_damping_n_m_s;
  TorqueChannel channel(options);
  std::vector<double> torques(static_cast<std::size_t>(delay), 0.0);
  double angle = 0.0, last_angle = 0.0, speed = kFirstSpeed, held = 0.0, late_speed = 0.0;
  for (int i = 0; i < kSteps; ++i) {
    torques.push_back(-kStiffness * angle);
    held = channel.apply(angle - last_angle, held, torques[static_cast<std::size_t>(i)], kPeriodS);
    last_angle = angle;
    // Exact while the torque is constant.
    angle += speed * kPeriodS + 0.5 * held / kInertiaKgM2 * kPeriodS * kPeriodS;
    speed += held / kInertiaKgM2 * kPeriodS;
    if (i > kSteps * 4 / 5) late_speed = std::max(late_speed, std::abs(speed));
  }
  return late_speed / kFirstSpeed;
}

TEST(TorqueChannel, StabilisesATorsionalSpringThatAnswersLate) {
  EXPECT_GT(speed_growth(0.0, 33), 10.0) << "the case must be unstable without the controller to show anything";
  EXPECT_LT(speed_growth(0.05, 33), 1.5);
}

}  // namespace
}  // namespace tensormass::haptic
