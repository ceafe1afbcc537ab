#include "haptic/point_contact.h"

#include <gtest/gtest.h>

#include <limits>

namespace tensormass::haptic {
namespace {

constexpr double kStiff = 1e6;
const Eigen::Quaterniond kUpright = Eigen::Quaterniond::Identity();

Eigen::Quaterniond turned_by(const Eigen::Vector3d& vector_rad) {
  return Eigen::Quaterniond(Eigen::AngleAxisd(vector_rad.norm(), vector_rad.stableNormalized()));
}

/// A tool of 0.1 m along x whose tip is pushed up by 2 N, in tissue of 300 N/m.
Feedback pressed_at_the_tip() {
  Feedback model;
  model.force_n = {0.0, 0.0, 2.0};
  model.torque_n_m = Eigen::Vector3d(0.1, 0.0, 0.0).cross(model.force_n);
  model.stiffness_n_per_m(2, 2) = 300.0;
  return model;
}

void expect_near(const Eigen::Vector3d& actual, const Eigen::Vector3d& expected) {
  EXPECT_LT((actual - expected).norm(), 1e-9) << actual.transpose() << " is not " << expected.transpose();
}

TEST(PointContact, GivesTheServersTorqueAtTheServersPose) {
  Feedback model = pressed_at_the_tip();
  model.orientation = turned_by({0.3, -0.4, 0.5});
  model.torque_n_m += Eigen::Vector3d(0.0, 0.0, 0.05);  // friction turns the tip about the force
  const PointContact contact(model, kStiff);
  expect_near(contact.torque_n_m(model.force_n, model.orientation), model.torque_n_m);
}

TEST(PointContact, FollowsTheForceAndTheRotationBetweenAnswers) {
  const PointContact contact(pressed_at_the_tip(), kStiff);
  // The hand has sunk in by 1 mm: 0.3 N more at the tip.
  expect_near(contact.torque_n_m({0.0, 0.0, 2.3}, kUpright), {0.0, -0.23, 0.0});
  // A turn about −y lifts the tip. By 0.01 rad it moves 1 mm, which takes 0.3 N off: 3 N m/rad.
  expect_near(contact.torque_n_m({0.0, 0.0, 2.0}, turned_by({0.0, -0.01, 0.0})), {0.0, -0.17, 0.0});
  // A turn about the tool's own axis does not move the tip.
  expect_near(contact.torque_n_m({0.0, 0.0, 2.0}, turned_by({0.5, 0.0, 0.0})), {0.0, -0.2, 0.0});
}

TEST(PointContact, TissueDoesNotPullATipThatLeavesIt) {
  const PointContact contact(pressed_at_the_tip(), kStiff);
  expect_near(contact.torque_n_m({0.0, 0.0, 2.0}, turned_by({0.0, -0.2, 0.0})), Eigen::Vector3d::Zero());
  expect_near(contact.torque_n_m(Eigen::Vector3d::Zero(), kUpright), Eigen::Vector3d::Zero());
}

TEST(PointContact, StiffContactFeelsLikeTheDevicesLimit) {
  const PointContact contact(pressed_at_the_tip(), 1.5);  // half of 3 N m/rad
  expect_near(contact.torque_n_m({0.0, 0.0, 2.0}, kUpright), {0.0, -0.1, 0.0});
  expect_near(contact.torque_n_m({0.0, 0.0, 2.0}, turned_by({0.0, -0.01, 0.0})), {0.0, -0.085, 0.0});
  expect_near(PointContact(pressed_at_the_tip(), 0.0).torque_n_m({0.0, 0.0, 2.0}, kUpright), Eigen::Vector3d::Zero());
}

TEST(PointContact, ACoupleWithoutForceIsHeld) {
  Feedback model;
  model.torque_n_m = {0.0, 0.0, 0.1};
  model.stiffness_n_per_m.setIdentity();
  const PointContact contact(model, kStiff);
  expect_near(contact.torque_n_m(Eigen::Vector3d::Zero(), turned_by({0.1, 0.2, 0.3})), {0.0, 0.0, 0.1});
}

// Forces of two jaws cancel up to rounding, and their torque remains. A lever of kilometres would follow.
TEST(PointContact, ForcesThatCancelDoNotMakeAnEndlessLever) {
  for (const double force_n : {1e-3, 1e-12, 1e-160, std::numeric_limits<double>::denorm_min()}) {
    Feedback model = pressed_at_the_tip();
    model.force_n = {0.0, 0.0, force_n};
    const PointContact contact(model, kStiff);
    const Eigen::Vector3d at_rest = contact.torque_n_m(model.force_n, kUpright);
    EXPECT_TRUE(at_rest.isApprox(model.torque_n_m, 1e-9)) << force_n << ": " << at_rest.transpose();
    // At most 300 N/m over the longest lever, 0.2 m: 12 N m/rad.
    const Eigen::Vector3d turned = contact.torque_n_m(model.force_n, turned_by({0.0, 0.01, 0.0}));
    EXPECT_LT((turned - at_rest).norm(), 0.121) << force_n;
  }
}

TEST(PointContact, WithoutContactThereIsNoTorque) {
  expect_near(PointContact().torque_n_m({1.0, 2.0, 3.0}, turned_by({0.1, 0.2, 0.3})), Eigen::Vector3d::Zero());
}

// Between two answers the torque is that of a spring: a closed way takes no energy from it.
TEST(PointContact, IsPassiveOverAClosedTurn) {
  const PointContact contact(pressed_at_the_tip(), kStiff);
  constexpr int kSteps = 10'000;
  double work_j = 0.0;
  for (int i = 0; i < kSteps; ++i) {
    const auto angle = [](int n) { return 0.02 * std::sin(2.0 * EIGEN_PI * n / kSteps); };
    const Eigen::Vector3d middle(0.0, 0.5 * (angle(i) + angle(i + 1)), 0.0);
    work_j += contact.torque_n_m({0.0, 0.0, 2.0}, turned_by(middle)).y() * (angle(i + 1) - angle(i));
  }
  EXPECT_NEAR(work_j, 0.0, 1e-12);
}

}  // namespace
}  // namespace tensormass::haptic
