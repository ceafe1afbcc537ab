#include <gtest/gtest.h>

#include <cmath>

#include "haptic/force_renderer.h"
#include "haptic/passivity_controller.h"

namespace tensormass::haptic {
namespace {

constexpr double kPeriodS = 1e-3;
constexpr PassivityOptions kOptions{.max_stored_energy_j = 0.1, .max_damping = 20.0};

// Simulates a mass on a spring that a server renders `delay` periods late, which generates energy. Returns the largest
// speed in the last fifth of two seconds, divided by the first speed.
double speed_growth(bool with_controller, int delay) {
  constexpr double kMassKg = 0.1;
  constexpr double kStiffness = 400.0;
  constexpr int kSteps = 2000;
  PassivityController controller(kOptions);
  std::vector<double> forces(static_cast<std::size_t>(delay), 0.0);
  double x = 0.0, last_x = 0.0, v = 0.05, held = 0.0, late_speed = 0.0;
  for (int i = 0; i < kSteps; ++i) {
    forces.push_back(-kStiffness * x);
    Eigen::Vector3d wanted(forces[static_cast<std::size_t>(i)], 0.0, 0.0);
    if (with_controller) wanted = controller.apply({x - last_x, 0.0, 0.0}, {held, 0.0, 0.0}, wanted, kPeriodS);
    last_x = x;
    held = wanted.x();
    // Exact while the force is constant.
    x += v * kPeriodS + 0.5 * held / kMassKg * kPeriodS * kPeriodS;
    v += held / kMassKg * kPeriodS;
    if (i > kSteps * 4 / 5) late_speed = std::max(late_speed, std::abs(v));
  }
  return late_speed / 0.05;
}

TEST(PassivityController, CountsTheEnergyThatTheHandGives) {
  PassivityController controller(kOptions);
  // 1 mm against 2 N gives 2 mJ. The way back returns them.
  controller.apply({0.0, 0.0, -0.001}, {0.0, 0.0, 2.0}, {0.0, 0.0, 2.0}, kPeriodS);
  EXPECT_NEAR(controller.energy_j(), 0.002, 1e-15);
  controller.apply({0.0, 0.0, 0.001}, {0.0, 0.0, 2.0}, {0.0, 0.0, 2.0}, kPeriodS);
  EXPECT_NEAR(controller.energy_j(), 0.0, 1e-15);
}

TEST(PassivityController, LeavesPassiveTissueAlone) {
  PassivityController controller(kOptions);
  double held = 0.0, last_x = 0.0;
  for (int i = 0; i < 1000; ++i) {
    const double x = -0.01 * std::sin(1e-3 * M_PI * i);  // press and lift
    // A spring with a little loss, like that of an implicit scheme.
    const double wanted = -200.0 * x + 1.0 * 0.01 * std::cos(1e-3 * M_PI * i);
    const Eigen::Vector3d force =
        controller.apply({0.0, 0.0, x - last_x}, {0.0, 0.0, held}, {0.0, 0.0, wanted}, kPeriodS);
    last_x = x;
    ASSERT_EQ(force.z(), wanted) << "in period " << i << " with " << controller.energy_j() << " J";
    held = wanted;
  }
}

TEST(PassivityController, DampingRemovesADeficitWithinThePeriod) {
  PassivityController controller(kOptions);
  // The tissue pushed the hand 0.1 mm with 0.01 N: a deficit of 1 µJ at 0.1 m/s asks for α = 1e-6 / (0.01 · 1e-3).
  const Eigen::Vector3d force = controller.apply({1e-4, 0.0, 0.0}, {0.01, 0.0, 0.0}, {0.01, 0.0, 0.0}, kPeriodS);
  EXPECT_NEAR(force.x(), 0.01 - 0.1 * 0.1, 1e-12);
}

TEST(PassivityController, BoundsItsDampingByTheDevice) {
  PassivityController controller(kOptions);
  const Eigen::Vector3d force = controller.apply({1e-4, 0.0, 0.0}, {5.0, 0.0, 0.0}, {5.0, 0.0, 0.0}, kPeriodS);
  EXPECT_NEAR(force.x(), 5.0 - 20.0 * 0.1, 1e-12);
}

TEST(PassivityController, BoundsTheCreditedEnergy) {
  PassivityController controller(kOptions);
  controller.apply({0.0, 0.0, -1.0}, {0.0, 0.0, 3.0}, {0.0, 0.0, 3.0}, kPeriodS);
  EXPECT_EQ(controller.energy_j(), 0.1);
}

TEST(PassivityController, StabilisesASpringThatAnswersLate) {
  EXPECT_GT(speed_growth(false, 16), 10.0) << "the case must be unstable without the controller to show anything";
  EXPECT_LT(speed_growth(true, 16), 1.5);
}

}  // namespace
}  // namespace tensormass::haptic
