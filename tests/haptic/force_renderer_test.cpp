#include <gtest/gtest.h>

#include <limits>

#include "haptic/clock.h"
#include "haptic/force_renderer.h"

namespace tensormass::haptic {
namespace {

constexpr std::int64_t kArrivalNs = 5'000'000'000;
constexpr ForceRendererOptions kOptions{
    .fade_s = 0.05, .max_pose_age_s = 0.5, .max_valid_for_s = 0.5, .max_stiffness_n_per_m = 1000.0};

std::int64_t after(double seconds) { return kArrivalNs + static_cast<std::int64_t>(seconds * kNsPerS); }

Feedback pressed() {
  Feedback feedback;
  feedback.client_time_ns = kArrivalNs;
  feedback.arrival_ns = kArrivalNs;
  feedback.position_m = {0.1, 0.2, 0.3};
  feedback.force_n = {0.0, 0.0, 2.0};
  feedback.stiffness_n_per_m = Eigen::Vector3d(50.0, 60.0, 200.0).asDiagonal();
  feedback.largest_stiffness_n_per_m = 200.0;
  feedback.valid_for_s = 0.02;
  return feedback;
}

void expect_near(const Eigen::Vector3d& actual, const Eigen::Vector3d& expected, double tolerance = 1e-12) {
  EXPECT_LT((actual - expected).norm(), tolerance) << actual.transpose() << " is not " << expected.transpose();
}

TEST(ForceRenderer, RendersNothingBeforeTheFirstFeedback) {
  const ForceRenderer::Output output = ForceRenderer(kOptions).render({1.0, 2.0, 3.0}, kArrivalNs);
  expect_near(output.force_n, Eigen::Vector3d::Zero());
  EXPECT_EQ(output.weight, 0.0);
}

TEST(ForceRenderer, FollowsTheLocalModelBetweenSteps) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  expect_near(renderer.render({0.1, 0.2, 0.3}, after(0.0)).force_n, {0.0, 0.0, 2.0});
  // force_n − stiffness (p − position): 1 mm deeper along −z adds 0.2 N, 1 mm along x pulls back 0.05 N.
  const ForceRenderer::Output moved = renderer.render({0.101, 0.2, 0.299}, after(0.019));
  expect_near(moved.force_n, {-0.05, 0.0, 2.2});
  EXPECT_EQ(moved.weight, 1.0);
}

TEST(ForceRenderer, FadesLinearlyToZeroAfterTheModelExpired) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  const Eigen::Vector3d anchor(0.1, 0.2, 0.3);
  expect_near(renderer.render(anchor, after(0.02)).force_n, {0.0, 0.0, 2.0});
  const ForceRenderer::Output half = renderer.render(anchor, after(0.02 + 0.025));
  expect_near(half.force_n, {0.0, 0.0, 1.0}, 1e-6);
  EXPECT_NEAR(half.weight, 0.5, 1e-6);
  expect_near(renderer.render(anchor, after(0.02 + 0.05)).force_n, Eigen::Vector3d::Zero());
  expect_near(renderer.render(anchor, after(100.0)).force_n, Eigen::Vector3d::Zero());
}

TEST(ForceRenderer, AFeedbackThatAnswersAnOldPoseIsStaleOnArrival) {
  Feedback late = pressed();
  late.client_time_ns = after(-0.525);  // 25 ms beyond max_pose_age_s
  ForceRenderer renderer(kOptions);
  renderer.update(late);
  EXPECT_NEAR(renderer.render(late.position_m, after(0.0)).weight, 0.5, 1e-6);
}

TEST(ForceRenderer, BoundsTheModelsValidityByItsOwnLimit) {
  Feedback boastful = pressed();
  boastful.valid_for_s = 1e12;
  ForceRendererOptions options = kOptions;
  options.max_pose_age_s = 10.0;
  ForceRenderer renderer(options);
  renderer.update(boastful);
  EXPECT_EQ(renderer.render(boastful.position_m, after(0.5)).weight, 1.0);
  EXPECT_EQ(renderer.render(boastful.position_m, after(0.5 + 0.05)).weight, 0.0);
}

TEST(ForceRenderer, ScalesDownAModelThatIsStifferThanTheDeviceRenders) {
  Feedback stiff = pressed();
  stiff.stiffness_n_per_m = Eigen::Vector3d(500.0, 0.0, 4000.0).asDiagonal();
  stiff.largest_stiffness_n_per_m = 4000.0;
  ForceRenderer renderer(kOptions);
  renderer.update(stiff);
  expect_near(renderer.render({0.101, 0.2, 0.299}, after(0.0)).force_n, {-0.125, 0.0, 3.0});
}

TEST(ForceRenderer, TissueDoesNotPullAToolThatLeavesIt) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  // 20 mm outside the tissue the linear model would pull with 2 N. Sideways components remain.
  expect_near(renderer.render({0.102, 0.2, 0.32}, after(0.0)).force_n, {-0.1, 0.0, 0.0});
}

TEST(LimitForce, ClampsTheMagnitudeAndKeepsTheDirection) {
  const ForceLimits limits{.max_force_n = 5.0, .max_slew_n_per_s = 1e6};
  expect_near(limit_force({30.0, 40.0, 0.0}, Eigen::Vector3d::Zero(), 1e-3, limits), {3.0, 4.0, 0.0});
  expect_near(limit_force({1.0, 2.0, 3.0}, Eigen::Vector3d::Zero(), 1e-3, limits), {1.0, 2.0, 3.0});
}

TEST(LimitForce, LimitsTheSlewInBothDirections) {
  const ForceLimits limits{.max_force_n = 5.0, .max_slew_n_per_s = 100.0};
  expect_near(limit_force({0.0, 0.0, 2.0}, Eigen::Vector3d::Zero(), 1e-3, limits), {0.0, 0.0, 0.1});
  expect_near(limit_force(Eigen::Vector3d::Zero(), {0.0, 0.0, 2.0}, 1e-3, limits), {0.0, 0.0, 1.9});
  expect_near(limit_force({0.0, 0.0, 2.05}, {0.0, 0.0, 2.0}, 1e-3, limits), {0.0, 0.0, 2.05});
}

TEST(LimitForce, ANonFiniteForceBecomesZeroAtOnce) {
  const ForceLimits limits{.max_force_n = 5.0, .max_slew_n_per_s = 100.0};
  for (const double bad : {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    expect_near(limit_force({bad, 0.0, 1.0}, {0.0, 0.0, 2.0}, 1e-3, limits), Eigen::Vector3d::Zero());
  }
}

TEST(LimitForce, ALimitOfNanGivesZeroForce) {
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  for (const ForceLimits& limits : {ForceLimits{kNan, 100.0}, ForceLimits{5.0, kNan}}) {
    expect_near(limit_force({0.0, 0.0, 1.0}, {0.0, 0.0, 2.0}, 1e-3, limits), Eigen::Vector3d::Zero());
  }
}

}  // namespace
}  // namespace tensormass::haptic
