#include "physics/material/invariant_law.h"

#include <vector>

#include "core/pack.h"
#include "physics/laws.h"

/// The projection of laws in the invariants: cheap near rest, exact far from it. Right values are eigenvalues of the
/// 9 × 9 stiffness, in double precision by Eigen.
///
///   e   strain ‖FᵀF − I‖; the share of the exact projection grows from zero at kNear to one at kFar
namespace tensormass::physics {
namespace {

using testing::kNeedsPositiveVolume;
using testing::kYoungModulusPa;
using testing::random_deformation;
using testing::random_rotation;
using Tangent = Eigen::Matrix<double, 9, 9>;

constexpr double kNear = 0.3, kFar = 0.5;

/// A whole law, or a part of it that selective reduced integration evaluates.
struct Part {
  double poisson, deviatoric, volumetric;
};
constexpr Part kParts[] = {{0.45, 1, 1}, {0.45, 0.3, 0}, {0.45, 0, 1}, {-0.3, 1, 1}, {0.499, 0.7, 1}};

template <class L>
class InvariantLaws : public ::testing::Test {
 protected:
  auto at(const Mat3<double>& f, const Part& part) const {
    auto parameters = testing::parameters<L>(kYoungModulusPa, part.poisson);
    L::scale_moduli(parameters.data(), part.deviatoric, part.volumetric);
    return L::at(f, parameters.data());
  }
  Tangent projected(const Mat3<double>& f, const Part& part) const {
    auto point = at(f, part);
    L::project_to_psd(point);
    return testing::tangent<L>(point);
  }
  /// Returns a random F with this strain e and J > 0.
  Mat3<double> with_strain(double e) {
    std::normal_distribution<double> normal;
    for (;;) {
      const Vec3<double> direction(normal(random_), normal(random_), normal(random_));
      const Vec3<double> squares = Vec3<double>::Ones() + direction.normalized() * e;
      if (squares.minCoeff() < 1e-3) continue;
      return random_rotation(random_) * squares.cwiseSqrt().asDiagonal() * random_rotation(random_).transpose();
    }
  }
  double uniform(double least, double most) { return std::uniform_real_distribution<double>(least, most)(random_); }

  std::mt19937 random_{23};
};

using Both = ::testing::Types<StableNeoHookean, NeoHookean>;
TYPED_TEST_SUITE(InvariantLaws, Both, testing::LawNames);

Tangent with_absolute(const Tangent& symmetric) {
  const Eigen::SelfAdjointEigenSolver<Tangent> eigen(symmetric);
  return eigen.eigenvectors() * eigen.eigenvalues().cwiseAbs().asDiagonal() * eigen.eigenvectors().transpose();
}

/// Collapsed and inverted elements too, where the law is defined.
TYPED_TEST(InvariantLaws, TakeAbsoluteEigenvaluesFarFromRest) {
  int indefinite = 0;
  for (const Part& part : kParts) {
    for (int trial = 0; trial < 1000; ++trial) {
      Mat3<double> f = trial % 2 == 0 ? this->with_strain(this->uniform(kFar + 1e-9, 2))
                                      : random_deformation(this->random_, -1.8, 1.8);
      if (f.determinant() <= 0 && kNeedsPositiveVolume<TypeParam>) continue;
      if (f.determinant() > 0 && (f.transpose() * f - Mat3<double>::Identity()).norm() <= kFar) continue;
      const Tangent consistent = testing::tangent<TypeParam>(this->at(f, part));
      const Tangent actual = this->projected(f, part), expected = with_absolute(consistent);
      EXPECT_LT((actual - expected).norm(), 1e-11 * expected.norm()) << "F =\n" << f;
      const double least = testing::least_eigenvalue(consistent);
      if (least > 1e-12 * consistent.norm()) {
        EXPECT_EQ(actual, consistent) << "F =\n" << f;
      }
      indefinite += least < 0;
    }
  }
  EXPECT_GT(indefinite, 1000);
}

/// An inverted element has small FᵀF − I as well.
TEST(InvariantLaw, AMirroredElementIsFarFromRest) {
  const auto parameters = StableNeoHookean::parameters(kYoungModulusPa, 0.45);
  auto point = StableNeoHookean::at(Mat3<double>(Vec3<double>(1, 1, -1).asDiagonal()), parameters.data());
  StableNeoHookean::project_to_psd(point);
  EXPECT_EQ(point.far, 1);
}

/// From rest to beyond kFar no direction is softer than three quarters of what absolute eigenvalues give it, but for a
/// hundredth of ‖K‖. With less, fast tools passed through thin sheets.
TYPED_TEST(InvariantLaws, AreNeverMuchSofterThanAbsoluteEigenvalues) {
  for (const Part& part : kParts) {
    for (int trial = 0; trial < 4000; ++trial) {
      const double e = this->uniform(0, 1.2 * kFar);
      const Mat3<double> f = this->with_strain(e);
      const Tangent consistent = testing::tangent<TypeParam>(this->at(f, part));
      const Tangent difference = this->projected(f, part) - 0.75 * with_absolute(consistent);
      ASSERT_GT(testing::least_eigenvalue(difference), -0.01 * consistent.norm()) << "e = " << e << ", F =\n" << f;
    }
  }
}

/// Millions of states near the two thresholds and between: positive semi-definite in double, and in float to rounding.
TYPED_TEST(InvariantLaws, StayPositiveNearTheThresholds) {
  constexpr int kTrials = 100'000;  // for each part, law and precision
  const auto is_positive = [](const Tangent& k, double rounding) {
    return Eigen::LLT<Tangent>(k + Tangent::Identity() * (rounding * k.norm())).info() == Eigen::Success;
  };
  for (const Part& part : kParts) {
    float parameters[2];
    auto exact = testing::parameters<TypeParam>(kYoungModulusPa, part.poisson);
    TypeParam::scale_moduli(exact.data(), part.deviatoric, part.volumetric);
    for (int c = 0; c < 2; ++c) parameters[c] = static_cast<float>(exact[c]);
    for (int trial = 0; trial < kTrials; ++trial) {
      const double at = trial % 3 == 0 ? kNear : trial % 3 == 1 ? kFar : this->uniform(kNear, kFar);
      const Mat3<double> f = this->with_strain(at * (1 + this->uniform(-1e-3, 1e-3)));
      ASSERT_TRUE(is_positive(this->projected(f, part), 1e-12)) << "F =\n" << f;
      auto point = TypeParam::at(Mat3<float>(f.template cast<float>()), parameters);
      TypeParam::project_to_psd(point);
      Tangent rounded;
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) {
          rounded.block<3, 3>(3 * a, 3 * b) =
              testing::stiffness<TypeParam, float>(point, Vec3<float>::Unit(a), Vec3<float>::Unit(b))
                  .template cast<double>();
        }
      }
      ASSERT_TRUE(is_positive((rounded + rounded.transpose()) / 2, 2e-6)) << "F =\n" << f;
    }
  }
}

/// A share that jumped would make the solver's path jump with it.
TYPED_TEST(InvariantLaws, ChangeWithoutAJump) {
  for (const Part& part : kParts) {
    for (int trial = 0; trial < 200; ++trial) {
      for (const double e : {kNear, kFar}) {
        const Mat3<double> f = this->with_strain(e), inside = f * (1 - 1e-9), outside = f * (1 + 1e-9);
        const Tangent k = this->projected(f, part);
        EXPECT_LT((this->projected(outside, part) - this->projected(inside, part)).norm(), 1e-6 * k.norm());
      }
    }
  }
}

/// Near rest: at most 1.2 times what absolute eigenvalues change, and nothing in most states whose stiffness is
/// positive. (1 + σ²) / 2 instead of σ counts a rotation that has almost no stiffness as negative.
TYPED_TEST(InvariantLaws, ChangeLittleNearRest) {
  for (const Part& part : kParts) {
    for (const double most : {0.003, 0.03, 0.1}) {
      double changes = 0, least_changes = 0;
      int definite = 0, kept = 0;
      for (int trial = 0; trial < 200; ++trial) {
        const Mat3<double> f = random_deformation(this->random_, 1 - most, 1 + most);
        const Tangent consistent = testing::tangent<TypeParam>(this->at(f, part));
        const Tangent positive = this->projected(f, part);
        changes += (positive - consistent).norm();
        least_changes += (with_absolute(consistent) - consistent).norm();
        if (testing::least_eigenvalue(consistent) > 1e-9 * consistent.norm()) {
          ++definite;
          kept += positive == consistent;
        }
      }
      EXPECT_LE(changes, 1.2 * least_changes) << "ν = " << part.poisson << ", strains to " << most;
      EXPECT_GE(kept, 0.85 * definite - 1) << "ν = " << part.poisson << ", strains to " << most;
    }
  }
}

/// Lanes of a pack hold points near and far: each gets what it would get alone, whatever its neighbours need.
TYPED_TEST(InvariantLaws, LanesDoNotSeeTheirNeighbours) {
  using Lanes = NativeLanes<float>;
  using T = typename Lanes::Scalar;
  constexpr int kWidth = static_cast<int>(Lanes::kWidth);
  const auto exact = testing::parameters<TypeParam>(kYoungModulusPa, 0.45);
  T parameters[2] = {T(exact[0]), T(exact[1])};
  const Vec3<T> a(T(0.3), T(-0.7), T(0.2)), b(T(-0.5), T(0.1), T(0.9));
  const auto of = [&](const Mat3<T>& f) {
    auto point = TypeParam::at(f, parameters);
    TypeParam::project_to_psd(point);
    return testing::stiffness<TypeParam>(point, a, b);
  };
  for (int trial = 0; trial < 200; ++trial) {
    Mat3<T> mixed;
    std::vector<Mat3<float>> single;
    for (int lane = 0; lane < kWidth; ++lane) {
      single.push_back(this->with_strain(lane % 2 == 0 ? 0.2 : 0.8).template cast<float>());
      for (int i = 0; i < 9; ++i) mixed(i).v[lane] = single.back()(i);
    }
    const Mat3<T> k = of(mixed);
    for (int lane = 0; lane < kWidth; ++lane) {
      Mat3<T> same;
      for (int i = 0; i < 9; ++i) same(i) = T(single[static_cast<std::size_t>(lane)](i));
      const Mat3<T> alone = of(same);
      for (int i = 0; i < 9; ++i) EXPECT_EQ(k(i).v[lane], alone(i).v[lane]) << "lane " << lane;
    }
  }
}

}  // namespace
}  // namespace tensormass::physics
