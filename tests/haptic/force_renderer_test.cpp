#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "haptic/clock.h"
#include "haptic/force_renderer.h"

namespace tensormass::haptic {
namespace {

constexpr std::int64_t kArrivalNs = 5'000'000'000;
constexpr ForceRendererOptions kOptions{
    .fade_s = 0.05, .max_pose_age_s = 0.5, .max_valid_for_s = 0.5, .max_stiffness_n_per_m = 1000.0};

const Eigen::Quaterniond kUpright = Eigen::Quaterniond::Identity();

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
  const ForceRenderer::Output output = ForceRenderer(kOptions).render({1.0, 2.0, 3.0}, kUpright, kArrivalNs);
  expect_near(output.force_n, Eigen::Vector3d::Zero());
  EXPECT_EQ(output.weight, 0.0);
}

TEST(ForceRenderer, FollowsTheLocalModelBetweenSteps) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  expect_near(renderer.render({0.1, 0.2, 0.3}, kUpright, after(0.0)).force_n, {0.0, 0.0, 2.0});
  // force_n − stiffness (p − position): 1 mm deeper along −z adds 0.2 N, 1 mm along x pulls back 0.05 N.
  const ForceRenderer::Output moved = renderer.render({0.101, 0.2, 0.299}, kUpright, after(0.019));
  expect_near(moved.force_n, {-0.05, 0.0, 2.2});
  EXPECT_EQ(moved.weight, 1.0);
}

TEST(ForceRenderer, LetsTheSpringOfABladeSlip) {
  Feedback cutting = pressed();
  cutting.stiffness_n_per_m.setZero();
  cutting.largest_stiffness_n_per_m = 0.0;
  cutting.yielding = {-Eigen::Vector3d::UnitZ(), 1e5, 2.5};  // stiffer than the device
  ForceRenderer renderer(kOptions);
  renderer.update(cutting);
  expect_near(renderer.render({0.1, 0.2, 0.3}, kUpright, after(0.0)).force_n, {0.0, 0.0, 2.0});
  expect_near(renderer.render({0.1, 0.2, 0.2998}, kUpright, after(0.001)).force_n, {0.0, 0.0, 2.2});
  expect_near(renderer.render({0.1, 0.2, 0.29}, kUpright, after(0.002)).force_n, {0.0, 0.0, 2.5});
  expect_near(renderer.render({0.1, 0.2, 0.291}, kUpright, after(0.003)).force_n, {0.0, 0.0, 1.5});
  expect_near(renderer.render({0.1, 0.2, 0.295}, kUpright, after(0.004)).force_n, Eigen::Vector3d::Zero());
}

TEST(ForceRenderer, FadesLinearlyToZeroAfterTheModelExpired) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  const Eigen::Vector3d anchor(0.1, 0.2, 0.3);
  expect_near(renderer.render(anchor, kUpright, after(0.02)).force_n, {0.0, 0.0, 2.0});
  const ForceRenderer::Output half = renderer.render(anchor, kUpright, after(0.02 + 0.025));
  expect_near(half.force_n, {0.0, 0.0, 1.0}, 1e-6);
  EXPECT_NEAR(half.weight, 0.5, 1e-6);
  expect_near(renderer.render(anchor, kUpright, after(0.02 + 0.05)).force_n, Eigen::Vector3d::Zero());
  expect_near(renderer.render(anchor, kUpright, after(100.0)).force_n, Eigen::Vector3d::Zero());
}

TEST(ForceRenderer, AFeedbackThatAnswersAnOldPoseIsStaleOnArrival) {
  Feedback late = pressed();
  late.client_time_ns = after(-0.525);  // 25 ms beyond max_pose_age_s
  ForceRenderer renderer(kOptions);
  renderer.update(late);
  EXPECT_NEAR(renderer.render(late.position_m, kUpright, after(0.0)).weight, 0.5, 1e-6);
}

TEST(ForceRenderer, BoundsTheModelsValidityByItsOwnLimit) {
  Feedback boastful = pressed();
  boastful.valid_for_s = 1e12;
  ForceRendererOptions options = kOptions;
  options.max_pose_age_s = 10.0;
  ForceRenderer renderer(options);
  renderer.update(boastful);
  EXPECT_EQ(renderer.render(boastful.position_m, kUpright, after(0.5)).weight, 1.0);
  EXPECT_EQ(renderer.render(boastful.position_m, kUpright, after(0.5 + 0.05)).weight, 0.0);
}

TEST(ForceRenderer, AReturningForceFadesIn) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  // The model expires after 20 ms, and its successor comes 25 ms later, when half of the force is left.
  Feedback next = pressed();
  next.arrival_ns = next.client_time_ns = after(0.045);
  renderer.update(next);
  EXPECT_NEAR(renderer.render(next.position_m, kUpright, after(0.045)).weight, 0.5, 1e-6);
  const ForceRenderer::Output rising = renderer.render(next.position_m, kUpright, after(0.055));
  EXPECT_NEAR(rising.weight, 0.7, 1e-6);
  EXPECT_FALSE(rising.stale) << "the model is valid";
  next.arrival_ns = next.client_time_ns = after(0.06);
  renderer.update(next);
  EXPECT_NEAR(renderer.render(next.position_m, kUpright, after(0.06)).weight, 0.8, 1e-6)
      << "a renewal must not start over";
  EXPECT_EQ(renderer.render(next.position_m, kUpright, after(0.075)).weight, 1.0);
}

const Eigen::Vector3d kAnchor(0.1, 0.2, 0.3);

// Returns a press of `force_n` along z, whose answer arrives `seconds` after the first one.
Feedback pressed_by(double force_n, double seconds, bool recovering) {
  Feedback feedback = pressed();
  feedback.arrival_ns = feedback.client_time_ns = after(seconds);
  feedback.force_n.z() = force_n;
  feedback.recovering = recovering;
  return feedback;
}

TEST(ForceRenderer, FadesToAForceThatJumpsInARecovery) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  expect_near(renderer.render(kAnchor, kUpright, after(0.009)).force_n, {0.0, 0.0, 2.0});
  renderer.update(pressed_by(0.5, 0.01, true));
  expect_near(renderer.render(kAnchor, kUpright, after(0.01)).force_n, {0.0, 0.0, 2.0});
  expect_near(renderer.render(kAnchor, kUpright, after(0.02)).force_n, {0.0, 0.0, 0.8 * 2.0 + 0.2 * 0.5}, 1e-6);
  // 1 mm deeper: the new model's 0.2 N more count as far as the fade has come.
  const Eigen::Vector3d deeper = kAnchor - Eigen::Vector3d(0.0, 0.0, 0.001);
  expect_near(renderer.render(deeper, kUpright, after(0.03)).force_n, {0.0, 0.0, 0.6 * 2.0 + 0.4 * 0.7}, 1e-6);
}

TEST(ForceRenderer, TheFirstForceAfterARecoveryFadesInAndLaterOnesStepAsUsual) {
  ForceRendererOptions options = kOptions;
  options.max_valid_for_s = 1.0;
  const auto lasting = [](Feedback feedback) {
    feedback.valid_for_s = 1.0;
    return feedback;
  };
  ForceRenderer renderer(options);
  renderer.update(lasting(pressed_by(0.0, 0.0, true)));
  expect_near(renderer.render(kAnchor, kUpright, after(0.0)).force_n, Eigen::Vector3d::Zero());
  renderer.update(lasting(pressed_by(2.0, 0.01, false)));
  expect_near(renderer.render(kAnchor, kUpright, after(0.01)).force_n, Eigen::Vector3d::Zero());
  expect_near(renderer.render(kAnchor, kUpright, after(0.035)).force_n, {0.0, 0.0, 1.0}, 1e-6);
  // A usual model in the fade replaces its end, and does not start it again.
  renderer.update(lasting(pressed_by(1.0, 0.035, false)));
  expect_near(renderer.render(kAnchor, kUpright, after(0.035)).force_n, {0.0, 0.0, 0.5}, 1e-6);
  expect_near(renderer.render(kAnchor, kUpright, after(0.061)).force_n, {0.0, 0.0, 1.0}, 1e-6);
  renderer.update(lasting(pressed_by(3.0, 0.07, false)));
  expect_near(renderer.render(kAnchor, kUpright, after(0.07)).force_n, {0.0, 0.0, 3.0});
}

TEST(ForceRenderer, EachStepOfARecoveryFadesFromWhatIsFelt) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  double felt_n = renderer.render(kAnchor, kUpright, after(0.0)).force_n.z();
  // Force comes and goes with every step, 10 ms apart.
  for (int step = 1; step <= 20; ++step) {
    renderer.update(pressed_by(step % 2 == 0 ? 2.0 : 0.0, 0.01 * step, true));
    for (int tick = 0; tick < 10; ++tick) {
      const double now_n = renderer.render(kAnchor, kUpright, after(0.01 * step + 0.001 * tick)).force_n.z();
      ASSERT_LE(std::abs(now_n - felt_n), 2.0 / 50.0 + 1e-9) << "of 2 N, a fiftieth in each millisecond";
      felt_n = now_n;
    }
  }
}

TEST(ForceRenderer, TorqueAndJawsFadeWithTheForce) {
  Feedback before = pressed();
  before.torque_n_m = {0.02, 0.0, 0.0};
  before.jaw_torque_n_m = 0.04;
  ForceRenderer renderer(kOptions);
  renderer.update(before);
  const ForceRenderer::Output felt = renderer.render(kAnchor, kUpright, after(0.0));
  ASSERT_GT(felt.torque_n_m.norm(), 0.01);
  renderer.update(pressed_by(0.0, 0.01, true));
  const ForceRenderer::Output half = renderer.render(kAnchor, kUpright, after(0.035));
  expect_near(half.torque_n_m, 0.5 * felt.torque_n_m, 1e-6);
  EXPECT_NEAR(half.jaw_torque_n_m, 0.02, 1e-6);
}

TEST(ForceRenderer, AForceThatFadesInARecoveryEndsWithoutAnswers) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  renderer.render(kAnchor, kUpright, after(0.0));
  renderer.update(pressed_by(2.0, 0.01, true));  // valid for 20 ms
  expect_near(renderer.render(kAnchor, kUpright, after(0.081)).force_n, Eigen::Vector3d::Zero());
}

TEST(ForceRenderer, ScalesDownForceAndStiffnessBeyondTheDevices) {
  Feedback stiff = pressed();
  stiff.stiffness_n_per_m = Eigen::Vector3d(500.0, 0.0, 4000.0).asDiagonal();
  stiff.largest_stiffness_n_per_m = 4000.0;
  ForceRenderer renderer(kOptions);
  renderer.update(stiff);
  // A quarter of 2 N, and 1000 N/m for 1 mm.
  expect_near(renderer.render({0.101, 0.2, 0.299}, kUpright, after(0.0)).force_n, {-0.125, 0.0, 1.5});
}

// Returns a press whose local model has no stiffness, `depth_m` deep in tissue of 400 N/m along z.
Feedback soft_model(double depth_m, double time_s) {
  Feedback feedback = pressed();
  feedback.arrival_ns = feedback.client_time_ns = after(time_s);
  feedback.position_m = {0.0, 0.0, -depth_m};
  feedback.force_n = {0.0, 0.0, 400.0 * depth_m};
  feedback.stiffness_n_per_m.setZero();
  feedback.largest_stiffness_n_per_m = 0.0;
  return feedback;
}

TEST(ForceRenderer, RaisesTheStiffnessToWhatFeedbacksShow) {
  ForceRenderer renderer(kOptions);
  renderer.update(soft_model(0.002, 0.0));
  expect_near(renderer.render({0.0, 0.0, -0.003}, kUpright, after(0.0)).force_n, {0.0, 0.0, 0.8});
  for (int i = 1; i <= 20; ++i) renderer.update(soft_model(0.002 + 0.001 * (i % 2), 0.01 * i));
  expect_near(renderer.render({0.001, 0.0, -0.003}, kUpright, after(0.2)).force_n, {0.0, 0.0, 1.2}, 1e-5);
}

TEST(ForceRenderer, BoundsTheRaisedStiffnessByTheDevice) {
  ForceRendererOptions options = kOptions;
  options.max_stiffness_n_per_m = 100.0;
  ForceRenderer renderer(options);
  for (int i = 0; i <= 20; ++i) renderer.update(soft_model(0.002 + 0.001 * (i % 2), 0.01 * i));
  // 400 N/m appear as 100 N/m, in the force as in its change.
  expect_near(renderer.render({0.0, 0.0, -0.002}, kUpright, after(0.2)).force_n, {0.0, 0.0, 0.2}, 1e-5);
  expect_near(renderer.render({0.0, 0.0, -0.003}, kUpright, after(0.2)).force_n, {0.0, 0.0, 0.3}, 1e-5);
}

TEST(ForceRenderer, TissueDoesNotPullAToolThatLeavesIt) {
  ForceRenderer renderer(kOptions);
  renderer.update(pressed());
  // 20 mm outside the tissue the linear model would pull with 2 N. Sideways components remain.
  expect_near(renderer.render({0.102, 0.2, 0.32}, kUpright, after(0.0)).force_n, {-0.1, 0.0, 0.0});
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
