#include "physics/decomposition.h"

#include <cmath>
#include <limits>
#include <random>
#include <vector>

#include <gtest/gtest.h>
#include <Eigen/Dense>

namespace tensormass::physics {
namespace {

template <class Real>
class Decomposition : public ::testing::Test {
 protected:
  using Matrix = Mat3<Real>;
  static constexpr Real kEpsilon = std::numeric_limits<Real>::epsilon();

  Matrix normal() {
    std::normal_distribution<double> normal;
    return Matrix::NullaryExpr([&] { return static_cast<Real>(normal(random_)); });
  }
  Matrix rotation() {
    std::normal_distribution<double> normal;
    const Eigen::Quaterniond q(normal(random_), normal(random_), normal(random_), normal(random_));
    return q.normalized().toRotationMatrix().template cast<Real>();
  }

  /// Returns likely and unlikely deformation gradients: random, nearly at rest, singular, inverted, with equal
  /// stretches, tiny and large.
  std::vector<Matrix> matrices() {
    std::vector<Matrix> out;
    std::uniform_real_distribution<double> exponent(-4, 1);
    std::uniform_int_distribution<int> digit(-1, 1);
    for (int i = 0; i < 4000; ++i) {
      out.push_back(normal());
      out.push_back(Matrix::Identity() + Real(0.1) * normal());
      out.push_back(Matrix::Identity() + Real(1e-4) * normal());
      out.push_back(Matrix::NullaryExpr([&] { return static_cast<Real>(digit(random_)); }));
      const auto size = [&] { return static_cast<Real>(std::pow(10.0, exponent(random_))); };
      out.push_back(rotation() * Vec3<Real>(size(), size(), -size()).asDiagonal() * rotation());
      // Two equal stretches, and one or two zero stretches.
      const Real twice = size();
      out.push_back(rotation() * Vec3<Real>(twice, size(), twice).asDiagonal() * rotation());
      out.push_back(rotation() * Vec3<Real>(0, size(), size()).asDiagonal() * rotation());
      out.push_back(rotation() * Vec3<Real>(0, size(), 0).asDiagonal() * rotation());
    }
    for (const double scale : {0.0, 1e-30, 1e-12, 1.0, 1e6}) {
      out.push_back(static_cast<Real>(scale) * Matrix::Identity());
      out.push_back(static_cast<Real>(scale) * Matrix(Vec3<Real>(1, 1, -1).asDiagonal()));
      out.push_back(static_cast<Real>(scale) * Matrix(Vec3<Real>(-1, -1, -1).asDiagonal()));
      out.push_back(static_cast<Real>(scale) * normal());
    }
    for (int i = 0; i < 9; ++i) {
      Matrix single = Matrix::Zero();
      single(i) = 1;
      out.push_back(single);
      out.push_back(-single);
    }
    return out;
  }

  std::mt19937 random_{29};
};

using Reals = ::testing::Types<float, double>;
TYPED_TEST_SUITE(Decomposition, Reals);

TYPED_TEST(Decomposition, SingularValuesReproduceTheMatrix) {
  using Real = TypeParam;
  const double tolerance = 20 * this->kEpsilon;
  for (const auto& f : this->matrices()) {
    const SignedSingularValues<Real> found = signed_singular_values(f);
    const double scale = f.template cast<double>().norm();
    const double floor = scale < 1e-8 ? 1e-9 : 0;  // columns this small count as zero
    for (const auto& q : {found.u, found.v}) {
      ASSERT_LT((q * q.transpose() - Mat3<Real>::Identity()).norm(), tolerance) << "F =\n" << f;
      ASSERT_NEAR(q.determinant(), 1, tolerance) << "F =\n" << f;
    }
    const Mat3<Real> product = found.product();
    ASSERT_LE((product - f).norm(), tolerance * scale + floor) << "F =\n" << f;

    ASSERT_GE(found.sigma[0], found.sigma[1] * (1 - 4 * this->kEpsilon)) << "F =\n" << f;
    ASSERT_GE(found.sigma[1], std::abs(found.sigma[2]) - tolerance * scale - floor) << "F =\n" << f;
    const Mat3<double> exact = f.template cast<double>();
    const Vec3<double> expected = Eigen::JacobiSVD<Mat3<double>>(exact).singularValues();
    for (int i = 0; i < 3; ++i) {
      ASSERT_NEAR(std::abs(found.sigma[i]), expected[i], tolerance * scale + floor) << "F =\n" << f;
    }
    if (expected[2] > tolerance * scale + floor) {
      ASSERT_EQ(found.sigma[2] < 0, exact.determinant() < 0) << "F =\n" << f;
    }
  }
}

/// Exact, so that a body at rest has no rounding errors to start from.
TYPED_TEST(Decomposition, IdentityAndStretchAlongTheAxesAreExact) {
  using Real = TypeParam;
  for (const Vec3<Real>& sigma : {Vec3<Real>(1, 1, 1), Vec3<Real>(1.5, 1.25, 0.7), Vec3<Real>(2, 1, -0.5)}) {
    const SignedSingularValues<Real> found = signed_singular_values(Mat3<Real>(sigma.asDiagonal()));
    EXPECT_EQ(found.sigma, sigma);
    EXPECT_EQ(found.u, Mat3<Real>(Mat3<Real>::Identity()));
    EXPECT_EQ(found.v, Mat3<Real>(Mat3<Real>::Identity()));
  }
}

/// Also for matrices that are shifted to be just singular.
TYPED_TEST(Decomposition, WhatIsCalledPositiveDefiniteHasNoNegativeEigenvalue) {
  using Real = TypeParam;
  int positive = 0, found = 0;
  for (const auto& f : this->matrices()) {
    const Mat3<double> symmetric = (f + f.transpose()).template cast<double>();
    const double least = Eigen::SelfAdjointEigenSolver<Mat3<double>>(symmetric).eigenvalues()[0];
    for (const double shift : {0.0, -least * (1 - 1e-6), -least, -least * (1 + 1e-6), symmetric.norm() - least}) {
      const Mat3<Real> shifted = (symmetric + shift * Mat3<double>::Identity()).template cast<Real>();
      const double smallest =
          Eigen::SelfAdjointEigenSolver<Mat3<double>>(shifted.template cast<double>()).eigenvalues()[0];
      if (is_positive_definite(shifted)) {
        ASSERT_GT(smallest, 4e-6 * shifted.template cast<double>().trace()) << shifted;
        ++found;
      }
      positive += smallest > 0.01 * shifted.template cast<double>().trace();
    }
  }
  EXPECT_GT(positive, 1000);
  EXPECT_GT(found, positive);  // few are left to the rotations
}

TYPED_TEST(Decomposition, OnlyNegativeEigenvaluesChangeTheirSign) {
  using Real = TypeParam;
  int unchanged = 0;
  for (const auto& f : this->matrices()) {
    const Mat3<Real> symmetric = f + f.transpose();
    const Eigen::SelfAdjointEigenSolver<Mat3<double>> eigen(symmetric.template cast<double>());
    const Mat3<double> expected =
        eigen.eigenvectors() * eigen.eigenvalues().cwiseAbs().asDiagonal() * eigen.eigenvectors().transpose();
    const Mat3<Real> found = with_absolute_eigenvalues(symmetric);
    const double scale = symmetric.template cast<double>().norm();
    ASSERT_LE((found.template cast<double>() - expected).norm(), 40 * this->kEpsilon * scale + 1e-17) << symmetric;
    if (eigen.eigenvalues()[0] > 20 * this->kEpsilon * scale) {
      ASSERT_EQ(found, symmetric);
      ++unchanged;
    }
    ASSERT_LE(gershgorin_lower_bound(symmetric), eigen.eigenvalues()[0] + 4 * this->kEpsilon * scale) << symmetric;
  }
  EXPECT_GT(unchanged, 1000);
}

}  // namespace
}  // namespace tensormass::physics
