#include "contact/line.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "contact/tools.h"

/// A capsule above one triangle, against the energy of line.h and its differences.
namespace tensormass::contact {
namespace {

constexpr double kRadiusM = 0.2, kLengthM = 4, kDepthM = 0.1;
using Motion = Eigen::Matrix<double, 9, 1>;

/// A capsule along z from (0, 0, −L/2), which turns about x by an angle.
physics::PlacedTool<double> capsule(double tilt_rad) {
  physics::PlacedTool<double> tool{};
  const double c = std::cos(tilt_rad), s = std::sin(tilt_rad);
  const double rows[3][3] = {{1, 0, 0}, {0, c, -s}, {0, s, c}};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) tool.rotation[3 * i + j] = rows[i][j];
  }
  tool.position_m[1] = s * kLengthM / 2;
  tool.position_m[2] = -c * kLengthM / 2;
  tool.radius_m = kRadiusM;
  tool.parameters[0] = kLengthM;
  return tool;
}

/// A triangle below the capsule with its outward normal up. Its face is below the capsule's axis from kFirstM to
/// kLastM.
constexpr double kFirstM = -0.26, kLastM = 0.4;
Corners<double> triangle(double below_m) {
  return {{{-0.4, -below_m, -0.5}, {-0.4, -below_m, 0.6}, {0.6, -below_m, 0.1}}};
}

Touch<double> touch_of(const physics::PlacedTool<double>& tool, const Corners<double>& corners, double kept_m = 0) {
  Touch<double> deepest;
  double place = 0;
  physics::Capsule::for_each_candidate(tool, corners.x[0], corners.x[1], corners.x[2],
                                       [&](const Vec3<double>& weights, const auto& core) {
                                         const Vec3<double> away = corners.at(weights) - core.position;
                                         const double depth = kRadiusM - away.norm() + kept_m;
                                         if (!(depth > deepest.depth_m)) return;
                                         deepest.depth_m = depth;
                                         deepest.lever_m = away.norm();
                                         deepest.weights = weights;
                                         deepest.normal = away.normalized();
                                         place = core.place;
                                       });
  return along_line<physics::Capsule>(tool, corners, deepest, place, kept_m, kLineAhead);
}

/// Forces on the corners for a stiffness of 1 N/m.
Motion forces(const Touch<double>& touch) {
  Motion out;
  for (int c = 0; c < 3; ++c) out.segment<3>(3 * c) = touch.normal * (touch.share * touch.depth_m * touch.weights[c]);
  return out;
}

view::TriangleContact<double> contact_of(const Touch<double>& touch) {
  view::TriangleContact<double> out{};
  for (int c = 0; c < 3; ++c) {
    out.weight[c] = touch.weights[c];
    out.normal[c] = touch.normal[c];
  }
  out.stiffness = touch.share;
  out.depth_m = out.loaded_m = touch.depth_m;
  out.lever_m = touch.lever_m;
  return out;
}
Motion random_motion(std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-1, 1);
  Motion out = Motion::Zero();
  for (int c = 0; c < 3; ++c) out[3 * c + 1] = uniform(random);  // along the normal
  return out;
}
Corners<double> moved(const Corners<double>& corners, const Motion& by) {
  Corners<double> out;
  for (int c = 0; c < 3; ++c) out.x[c] = corners.x[c] + by.segment<3>(3 * c);
  return out;
}
/// Half the square of M.
double energy(const Corners<double>& corners) {
  const Touch<double> touch = touch_of(capsule(0), corners);
  return touch.share * touch.depth_m * touch.depth_m / 2;
}

TEST(Line, LiesInTheMiddleOfWhatIsEquallyDeep) {
  const Touch<double> touch = touch_of(capsule(0), triangle(kRadiusM - kDepthM));
  const Vec3<double> at = triangle(0).at(touch.weights);
  EXPECT_NEAR(at.x(), 0, 1e-12);
  EXPECT_NEAR(at.z(), (kFirstM + kLastM) / 2, 1e-12);
  EXPECT_NEAR(touch.depth_m, kDepthM, 1e-12);
  EXPECT_NEAR(touch.share, std::pow(1 / (1 - kLineWidth / 4), 2), 1e-12);
}

/// The deepest point alone jumps by the whole length of the line.
TEST(Line, MovesWithoutAJumpFromOneEndToTheOther) {
  constexpr double kStepRad = 2e-5;
  const Corners<double> corners = triangle(kRadiusM - kDepthM);
  double before = 0, longest = 0;
  for (int i = -2000; i <= 2000; ++i) {
    const double z = corners.at(touch_of(capsule(i * kStepRad), corners).weights).z();
    if (i > -2000) longest = std::max(longest, std::abs(z - before));
    before = z;
    if (i == -2000) {
      EXPECT_NEAR(z, kFirstM, 0.02);
    } else if (i == 2000) {
      EXPECT_NEAR(z, kLastM, 0.02);
    }
  }
  EXPECT_LT(longest, 0.01 * (kLastM - kFirstM));
}

TEST(Line, HasTheForceAndTheStiffnessOfItsEnergy) {
  constexpr double kStep = 1e-5;
  std::mt19937 random(3);
  const Corners<double> corners = triangle(kRadiusM - kDepthM);
  const Touch<double> touch = touch_of(capsule(0), corners);
  for (int trial = 0; trial < 20; ++trial) {
    const Motion motion = random_motion(random);
    const double ahead = energy(moved(corners, motion * kStep)), behind = energy(moved(corners, motion * -kStep));
    EXPECT_NEAR((ahead - behind) / (2 * kStep), -forces(touch).dot(motion), 1e-6 * kDepthM);
    double along = 0, to_end = 0;
    for (int c = 0; c < 3; ++c) {
      along += touch.weights[c] * motion[3 * c + 1];
      to_end += touch.line[c] * motion[3 * c + 1];
    }
    const Tilt<double> tilt(corners, contact_of(touch));
    const Vec3<double> tilted =
        tilt.of(moved({{Vec3<double>::Zero(), Vec3<double>::Zero(), Vec3<double>::Zero()}}, motion));
    const double stiffness =
        touch.share * along * along + touch.line_share * to_end * to_end + tilt.stiffness() * tilted.dot(tilted);
    EXPECT_NEAR((ahead - 2 * energy(corners) + behind) / (kStep * kStep), stiffness, 0.02 * stiffness);
  }
}

TEST(Line, KeepsAForceAsItIs) {
  constexpr double kKeptM = 0.01;
  const Touch<double> touch = touch_of(capsule(0), triangle(kRadiusM), kKeptM);
  EXPECT_NEAR(touch.share * touch.depth_m, kKeptM, 1e-12);
}

TEST(Line, LeavesATipThatTouchesAlone) {
  const Corners<double> corners = triangle(kRadiusM - kDepthM);
  physics::PlacedTool<double> tool = capsule(0.5);
  tool.position_m[1] += kLengthM / 2 * std::sin(0.5);  // its end touches
  const Touch<double> touch = touch_of(tool, corners);
  EXPECT_EQ(touch.share, 1);
  EXPECT_EQ(touch.line_share, 0);
}

}  // namespace
}  // namespace tensormass::contact
