#include <gtest/gtest.h>

#include <limits>

#include "haptic/clock.h"
#include "haptic/secant_stiffness.h"

namespace tensormass::haptic {
namespace {

constexpr double kMinMoveM = 2e-4;
constexpr double kStiffness = 600.0;

// Returns the feedback of a spring of kStiffness along −z at a depth. Negative depths are outside.
Feedback at(double depth_m, double time_s) {
  Feedback feedback;
  feedback.client_time_ns = static_cast<std::int64_t>((10.0 + time_s) * kNsPerS);
  feedback.position_m = {0.01, 0.02, -depth_m};
  feedback.force_n.z() = kStiffness * std::max(depth_m, 0.0);
  return feedback;
}

// Presses and lifts between 2 and 3 mm at 60 Hz, and returns the estimate.
double press(SecantStiffness& secant, double start_s = 0.0) {
  double estimate = 0.0;
  for (int i = 0; i < 20; ++i) estimate = secant.update(at(0.002 + 0.001 * (i % 2), start_s + i / 60.0));
  return estimate;
}

TEST(SecantStiffness, FindsTheStiffnessOfASpring) {
  SecantStiffness secant(kMinMoveM);
  EXPECT_EQ(secant.update(at(0.002, 0.0)), 0.0) << "one feedback tells nothing";
  EXPECT_NEAR(secant.update(at(0.0021, 0.01)), 0.0, 1e-9) << "too short a way";
  EXPECT_GT(secant.update(at(0.003, 0.02)), 0.4 * kStiffness);
  EXPECT_NEAR(press(secant, 0.03), kStiffness, 1e-2);
}

TEST(SecantStiffness, IgnoresMotionAcrossTheForce) {
  SecantStiffness secant(kMinMoveM);
  secant.update(at(0.002, 0.0));
  Feedback beside = at(0.002, 0.01);
  beside.position_m.x() += 0.01;
  beside.force_n.z() *= 2.0;
  EXPECT_EQ(secant.update(beside), 0.0);
}

TEST(SecantStiffness, DoesNotCompareFeedbacksThatAreFarApart) {
  SecantStiffness secant(kMinMoveM);
  secant.update(at(0.002, 0.0));
  EXPECT_EQ(secant.update(at(0.003, 0.3)), 0.0);
}

TEST(SecantStiffness, DoesNotCompareFeedbacksOfARecovery) {
  SecantStiffness secant(kMinMoveM);
  const double before = press(secant);
  Feedback jumped = at(0.001, 0.35);
  jumped.force_n.z() *= 20.0;
  jumped.recovering = true;
  EXPECT_EQ(secant.update(jumped), before);
  EXPECT_EQ(secant.update(at(0.003, 0.36)), before) << "nor with the first one after it";
  EXPECT_NEAR(secant.update(at(0.002, 0.37)), kStiffness, 1e-2);
}

TEST(SecantStiffness, IsNeverNegative) {
  SecantStiffness secant(kMinMoveM);
  for (int i = 0; i < 10; ++i) {
    Feedback pulling = at(0.002 + 0.001 * (i % 2), i / 60.0);
    pulling.force_n.z() = 3.0 - pulling.force_n.z();
    ASSERT_EQ(secant.update(pulling), 0.0);
  }
}

TEST(SecantStiffness, KeepsTheEstimateForASecondWithoutContact) {
  SecantStiffness secant(kMinMoveM);
  press(secant);
  EXPECT_EQ(secant.update(at(-0.001, 0.9)), 0.0) << "no force, no stiffness";
  EXPECT_NEAR(secant.update(at(0.002, 1.2)), kStiffness, 1e-2);
  EXPECT_EQ(secant.update(at(-0.001, 1.5)), 0.0);
  EXPECT_EQ(secant.update(at(0.002, 2.5)), 0.0);
}

TEST(SecantStiffness, AnInfiniteWaySwitchesItOff) {
  SecantStiffness secant(std::numeric_limits<double>::infinity());
  EXPECT_EQ(press(secant), 0.0);
}

}  // namespace
}  // namespace tensormass::haptic
