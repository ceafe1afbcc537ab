#include "haptic/slipping_spring.h"

#include <algorithm>
#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "haptic/clock.h"

/// The spring of a blade: it yields at its limit, and what has slipped stays slipped.
namespace tensormass::haptic {
namespace {

constexpr double kStiffness = 500.0, kLimitN = 0.2, kMaxStiffness = 2000.0;
constexpr std::int64_t kTickNs = 1'000'000;
const Eigen::Vector3d kDirection = Eigen::Vector3d(1.0, 2.0, -2.0) / 3.0;
const Eigen::Vector3d kAside(2.0, -1.0, 0.0);

/// A feedback whose spring has this force at the origin.
Feedback cutting(double force_n, std::int64_t client_time_ns = 0) {
  Feedback feedback;
  feedback.client_time_ns = client_time_ns;
  feedback.force_n = -force_n * kDirection;
  feedback.yielding = {kDirection, kStiffness, kLimitN};
  return feedback;
}

/// The force that holds the blade back at a way along the direction.
double force_at(SlippingSpring& spring, const Feedback& feedback, double way_m, std::int64_t now_ns) {
  const Eigen::Vector3d force_n = feedback.force_n + spring.change_n(way_m * kDirection + 0.1 * kAside, now_ns);
  EXPECT_LT(force_n.cross(kDirection).norm(), 1e-12) << "it acts along its direction only";
  return -force_n.dot(kDirection);
}

TEST(SlippingSpring, DoesNothingWithoutALimit) {
  SlippingSpring spring;
  EXPECT_EQ(spring.change_n({1.0, 2.0, 3.0}, 0), Eigen::Vector3d(0.0, 0.0, 0.0));
  Feedback feedback;
  feedback.force_n = {1.0, 0.0, 0.0};
  spring.update(feedback, kMaxStiffness);
  EXPECT_EQ(spring.change_n({1.0, 2.0, 3.0}, 0), Eigen::Vector3d(0.0, 0.0, 0.0));
}

TEST(SlippingSpring, YieldsAtItsLimitAndGivesNothingBack) {
  SlippingSpring spring;
  const Feedback feedback = cutting(0.05);
  spring.update(feedback, kMaxStiffness);
  EXPECT_NEAR(force_at(spring, feedback, 0.0, 0), 0.05, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 1e-4, 1), 0.1, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 1e-3, 2), kLimitN, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 5e-3, 3), kLimitN, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 4.9e-3, 4), kLimitN - 0.05, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 4e-3, 5), 0.0, 1e-12) << "it never pulls the blade in";
  EXPECT_NEAR(force_at(spring, feedback, 4.9e-3, 6), kLimitN - 0.05, 1e-12) << "not before it is back";
}

TEST(SlippingSpring, GoesOnFromAFeedbackThatAnswersAPastPose) {
  SlippingSpring spring;
  Feedback feedback = cutting(kLimitN);
  spring.update(feedback, kMaxStiffness);
  // 50 ticks forwards by 0.1 mm each, 0.2 mm back, then a feedback that answers the pose of tick 20, at 2 mm.
  for (int tick = 0; tick <= 50; ++tick)
    EXPECT_NEAR(force_at(spring, feedback, 1e-4 * tick, tick * kTickNs), 0.2, 1e-9);
  EXPECT_NEAR(force_at(spring, feedback, 4.8e-3, 51 * kTickNs), 0.1, 1e-9);
  Feedback late = cutting(kLimitN, 20 * kTickNs);
  late.position_m = 2e-3 * kDirection;
  spring.update(late, kMaxStiffness);
  EXPECT_NEAR(force_at(spring, late, 4.8e-3, 52 * kTickNs), 0.1, 1e-9) << "it has slipped to 4.6 mm";
  EXPECT_NEAR(force_at(spring, late, 5.1e-3, 53 * kTickNs), kLimitN, 1e-9);
}

TEST(SlippingSpring, IsNoStifferThanTheDeviceAllows) {
  SlippingSpring spring;
  const Feedback feedback = cutting(0.0);
  spring.update(feedback, 100.0);
  EXPECT_NEAR(force_at(spring, feedback, 1e-3, 0), 0.1, 1e-12);
  EXPECT_NEAR(force_at(spring, feedback, 1e-2, 1), kLimitN, 1e-12);
}

/// Work that the hand gets over any closed way, beyond what is stored: none.
TEST(SlippingSpring, GivesNoEnergy) {
  std::mt19937 random(5);
  std::normal_distribution<double> step_m(0.0, 3e-4);
  double all_j = 0.0;
  for (int run = 0; run < 20; ++run) {
    SlippingSpring spring;
    const Feedback feedback = cutting(0.0);
    spring.update(feedback, kMaxStiffness);
    double way_m = 0.0, before_n = force_at(spring, feedback, 0.0, 0), given_j = 0.0, largest_j = 0.0;
    for (int tick = 1; tick < 5000; ++tick) {
      const double move_m = step_m(random);
      const int parts = 20;  // the force between two ticks
      for (int part = 0; part < parts; ++part) {
        way_m += move_m / parts;
        const double now_n = force_at(spring, feedback, way_m, tick);
        given_j -= move_m / parts * (before_n + now_n) / 2;
        before_n = now_n;
      }
      largest_j = std::max(largest_j, given_j);
    }
    EXPECT_LT(largest_j, 1e-6 * kLimitN);
    all_j += given_j;
  }
  EXPECT_LT(all_j, -1e-3) << "it takes energy";
}

}  // namespace
}  // namespace tensormass::haptic
