#include "physics/contact/hertz.h"

#include <cmath>

#include <gtest/gtest.h>

namespace tensormass::physics {
namespace {

constexpr double kModulusPa = 5e3 / (1 - 0.45 * 0.45), kRadiusM = 0.01;

double hertz_force_n(double depth_m) { return 4.0 / 3.0 * kModulusPa * std::sqrt(kRadiusM) * std::pow(depth_m, 1.5); }

TEST(Hertz, TangentIsTheDerivativeOfTheForce) {
  for (const double depth_m : {1e-5, 1e-4, 1e-3, 5e-3}) {
    const double h = 1e-4 * depth_m;
    const double difference = (hertz_force_n(depth_m + h) - hertz_force_n(depth_m - h)) / (2 * h);
    EXPECT_NEAR(hertz_tangent_stiffness(hertz_force_n(depth_m), kModulusPa, kRadiusM), difference, 1e-6 * difference)
        << "at a depth of " << depth_m << " m";
  }
}

TEST(Hertz, NoForceGivesNoStiffness) {
  EXPECT_EQ(hertz_tangent_stiffness(0, kModulusPa, kRadiusM), 0);
  EXPECT_EQ(hertz_tangent_stiffness(-1, kModulusPa, kRadiusM), 0);
  EXPECT_EQ(hertz_tangent_stiffness(std::nan(""), kModulusPa, kRadiusM), 0);
}

}  // namespace
}  // namespace tensormass::physics
