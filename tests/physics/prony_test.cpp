#include <gtest/gtest.h>
#include <Eigen/Eigenvalues>

#include "physics/element/prony.h"

namespace tensormass::physics {
namespace {

/// After a sudden constant strain the stress relaxes from S⁰ to S⁰ (1 − α), as (1 + Δt/τ)⁻ⁿ in n steps.
TEST(Prony, StressRelaxesAfterASuddenStrain) {
  const double share = 0.4, time = 0.25, dt = 0.01;
  const PronyStep<double> step = prony_step(share, time, dt);
  double gamma = 0;
  for (int n = 1; n <= 400; ++n) {
    gamma = step.gain + step.decay * gamma;
    EXPECT_NEAR(gamma, share * (1 - std::pow(1 + dt / time, -n)), 1e-14);
  }
  EXPECT_NEAR(gamma, share, 1e-6);
}

TEST(Prony, SymmetricStressRoundTripsThroughSixReals) {
  Mat3<double> s = Mat3<double>::Random();
  s = (s + s.transpose()).eval();
  double reals[kSymmetricReals];
  to_symmetric(s, reals);
  EXPECT_EQ(symmetric(reals), s);
  EXPECT_EQ(reals[3], s(1, 2));
  EXPECT_EQ(reals[4], s(0, 2));
  EXPECT_EQ(reals[5], s(0, 1));
}

struct Objective {
  static constexpr bool kConstantStiffness = false;
};

TEST(Prony, GeometricTermIsMinusHAndProjectedOnRequest) {
  Mat3<double> memory = Mat3<double>::Random();
  memory = (memory + memory.transpose()).eval();
  const Viscous<double> viscous{0.8, memory};
  EXPECT_EQ(viscous.geometric<Objective>(false), -memory);
  const Mat3<double> positive = viscous.geometric<Objective>(true);
  EXPECT_GE(Eigen::SelfAdjointEigenSolver<Mat3<double>>(positive).eigenvalues()[0], -1e-15);
}

}  // namespace
}  // namespace tensormass::physics
