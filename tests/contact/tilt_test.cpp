#include "contact/tilt.h"

#include <random>

#include <gtest/gtest.h>

/// The stiffness of one contact against differences of its energy.
namespace tensormass::contact {
namespace {

constexpr double kStiffness = 40, kRadiusM = 0.3;  // N/m, m
using Stiffness = Eigen::Matrix<double, 9, 9>;
using Motion = Eigen::Matrix<double, 9, 1>;

Corners<double> moved(const Corners<double>& corners, const Motion& by) {
  Corners<double> out;
  for (int c = 0; c < 3; ++c) out.x[c] = corners.x[c] + by.segment<3>(3 * c);
  return out;
}

physics::ClosestPoint<double> closest(const Corners<double>& corners) {
  return physics::closest_point_on_triangle<double>(Vec3<double>::Zero(), corners.x[0], corners.x[1], corners.x[2]);
}

/// k/2 (radius − L)² of a sphere about the origin.
double energy(const Corners<double>& corners) {
  const double depth = kRadiusM - corners.at(closest(corners).weights).norm();
  return kStiffness / 2 * depth * depth;
}

view::TriangleContact<double> touch_of(const Corners<double>& corners) {
  view::TriangleContact<double> touch{};
  const Vec3<double> weights = closest(corners).weights, point = corners.at(weights);
  touch.stiffness = kStiffness;
  touch.lever_m = point.norm();
  touch.depth_m = touch.loaded_m = kRadiusM - point.norm();
  for (int c = 0; c < 3; ++c) {
    touch.weight[c] = weights[c];
    touch.normal[c] = point[c] / point.norm();
  }
  return touch;
}

/// Returns a triangle whose closest point to the origin, 0.25 m away, is of that kind.
Corners<double> triangle_with(physics::TriangleFeature feature, std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-0.4, 0.4);
  for (;;) {
    Corners<double> corners;
    for (auto& x : corners.x) x = {uniform(random), uniform(random), uniform(random)};
    const auto found = closest(corners);
    const Vec3<double> point = corners.at(found.weights);
    if (found.feature != feature || found.weights.maxCoeff() < 0.1 || corners.normal().norm() < 0.02) continue;
    if (feature == physics::TriangleFeature::kFace && found.weights.minCoeff() < 0.05) continue;
    const Vec3<double> outwards = point * (0.25 / point.norm() - 1);
    for (auto& x : corners.x) x += outwards;
    if (closest(corners).feature == feature) return corners;
  }
}

class TiltOf : public testing::TestWithParam<physics::TriangleFeature> {
 protected:
  std::mt19937 random_{7};
};

TEST_P(TiltOf, IsTheSecondDerivativeOfTheEnergyWithoutThePartThatSlipsOff) {
  constexpr double kStep = 1e-4;
  for (int trial = 0; trial < 20; ++trial) {
    const Corners<double> corners = triangle_with(GetParam(), random_);
    const auto touch = touch_of(corners);
    const Tilt<double> tilt(corners, touch);
    const Vec3<double> n(touch.normal[0], touch.normal[1], touch.normal[2]);
    const double slip = touch.stiffness * touch.depth_m / touch.lever_m;
    Stiffness expected, found;
    for (int i = 0; i < 9; ++i) {
      for (int j = 0; j < 9; ++j) {
        const Motion a = kStep * Motion::Unit(i), b = kStep * Motion::Unit(j);
        expected(i, j) = (energy(moved(corners, a + b)) - energy(moved(corners, a - b)) -
                          energy(moved(corners, b - a)) + energy(moved(corners, -a - b))) /
                         (4 * kStep * kStep);
      }
    }
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) {
        const Mat3<double> along = touch.stiffness * n * n.transpose(),
                           across = slip * (Mat3<double>::Identity() - n * n.transpose());
        found.block<3, 3>(3 * a, 3 * b) = touch.weight[a] * touch.weight[b] * (along - across) + tilt.block(a, b);
      }
    }
    EXPECT_LT((found - expected).norm(), 1e-4 * expected.norm());
  }
}

/// Forces are minus stiffness times motion, their sum is total_force, and they have no moment about the tool's centre.
TEST_P(TiltOf, HasForcesWithoutMomentAboutTheCentre) {
  std::uniform_real_distribution<double> uniform(-0.01, 0.01);
  for (int trial = 0; trial < 20; ++trial) {
    const Corners<double> corners = triangle_with(GetParam(), random_);
    const auto touch = touch_of(corners);
    const Tilt<double> tilt(corners, touch);
    ASSERT_EQ(tilt.block(0, 0).norm() + tilt.block(1, 1).norm() > 0, GetParam() != physics::TriangleFeature::kVertex1);
    Corners<double> motion;
    for (auto& d : motion.x) d = {uniform(random_), uniform(random_), uniform(random_)};
    const Vec3<double> of = tilt.of(motion);
    Vec3<double> sum = Vec3<double>::Zero(), moment = Vec3<double>::Zero();
    for (int a = 0; a < 3; ++a) {
      Vec3<double> force = Vec3<double>::Zero();
      for (int b = 0; b < 3; ++b) force -= tilt.block(a, b) * motion.x[b];
      EXPECT_LT((tilt.force(a, of) - force).norm(), 1e-12);
      sum += force;
      moment += physics::cross<double>(corners.x[a], force);
    }
    EXPECT_LT((tilt.total_force(of) - sum).norm(), 1e-12);
    EXPECT_LT(moment.norm(), 1e-12);
  }
}

INSTANTIATE_TEST_SUITE_P(Features, TiltOf,
                         testing::Values(physics::TriangleFeature::kFace, physics::TriangleFeature::kEdge12,
                                         physics::TriangleFeature::kVertex1));

}  // namespace
}  // namespace tensormass::contact
