#include "physics/material/law.h"

#include <type_traits>
#include <vector>

#include "core/pack.h"
#include "physics/laws.h"

/// Properties that every law must have at a point, for any shape. The list is that of physics/lists.h: a new entry
/// there is tested here without a change.
namespace tensormass::physics {
namespace {

using testing::kIsotropic;
using testing::kNeedsPositiveVolume;
using testing::kPoissonRatio;
using testing::kYoungModulusPa;
using testing::random_deformation;
using testing::random_rotation;
using Tangent = Eigen::Matrix<double, 9, 9>;

template <class L>
class EveryMaterial : public ::testing::Test {
 protected:
  static_assert(Law<L>);
  using Point = typename L::template Point<double>;

  Point at(const Mat3<double>& f) const { return L::at(f, parameters_.data()); }
  double energy(const Mat3<double>& f) const { return L::energy(at(f)); }
  Mat3<double> stress(const Mat3<double>& f) const { return L::stress(at(f)); }

  /// Returns mild to severe deformations; also inverted ones if the law is defined there.
  std::vector<Mat3<double>> states() {
    std::vector<Mat3<double>> out;
    for (int i = 0; i < 40; ++i) {
      out.push_back(random_deformation(random_, 0.9, 1.1));
      out.push_back(random_deformation(random_, 0.3, 1.8));
      if constexpr (!kNeedsPositiveVolume<L>) {
        // The smallest stretch is the inverted one, so that no two stretches add up to zero.
        out.push_back(random_rotation(random_) * Vec3<double>(1.3, 0.9, -0.02 * i).asDiagonal() *
                      random_rotation(random_).transpose());
      }
    }
    return out;
  }

  std::mt19937 random_{17};
  std::array<double, L::kParameterCount> parameters_ = testing::parameters<L>();
};

TYPED_TEST_SUITE(EveryMaterial, testing::AllLaws, testing::LawNames);

TYPED_TEST(EveryMaterial, StressIsTheDerivativeOfTheEnergy) {
  const double h = 1e-6;
  for (const Mat3<double>& f : this->states()) {
    const Mat3<double> stress = this->stress(f);
    const double scale = stress.norm() + 1e-3 * kYoungModulusPa;
    for (int i = 0; i < 9; ++i) {
      Mat3<double> above = f, below = f;
      above(i) += h;
      below(i) -= h;
      ASSERT_NEAR(stress(i), (this->energy(above) - this->energy(below)) / (2 * h), 1e-6 * scale) << "F =\n" << f;
    }
  }
}

TYPED_TEST(EveryMaterial, StiffnessIsTheDerivativeOfTheStress) {
  const double h = 1e-6;
  for (const Mat3<double>& f : this->states()) {
    const Tangent tangent = testing::tangent<TypeParam>(this->at(f));
    ASSERT_LT((tangent - tangent.transpose()).norm(), 1e-13 * tangent.norm());
    for (int i = 0; i < 9; ++i) {
      Mat3<double> above = f, below = f;
      above(i) += h;
      below(i) -= h;
      const Mat3<double> difference = (this->stress(above) - this->stress(below)) / (2 * h);
      ASSERT_LT((tangent.col(i) - difference.reshaped()).norm(), 1e-7 * tangent.norm()) << "F =\n" << f;
    }
  }
}

TYPED_TEST(EveryMaterial, TractionIsTheStressTimesTheGradientAlsoAfterProjection) {
  const Vec3<double> a(0.3, -1.2, 0.7);
  for (const Mat3<double>& f : this->states()) {
    auto point = this->at(f);
    const Vec3<double> expected = TypeParam::stress(point) * a;
    const double scale = expected.norm() + 1e-3 * kYoungModulusPa;
    EXPECT_LT((TypeParam::traction(point, TypeParam::at_node(point, a)) - expected).norm(), 1e-12 * scale);
    TypeParam::project_to_psd(point);
    EXPECT_LT((TypeParam::traction(point, TypeParam::at_node(point, a)) - expected).norm(), 1e-12 * scale);
  }
}

TYPED_TEST(EveryMaterial, StiffnessAtTheAxesGivesThatOfEveryGradient) {
  const Vec3<double> a(0.3, -1.2, 0.7), b(-0.4, 0.9, 1.1);
  for (const Mat3<double>& f : this->states()) {
    auto point = this->at(f);
    for (const bool positive : {false, true}) {
      if (positive) TypeParam::project_to_psd(point);
      const auto node = TypeParam::at_node(point, a);
      Mat3<double> sum = Mat3<double>::Zero();
      for (int c = 0; c < 3; ++c) sum += TypeParam::stiffness(point, node, TypeParam::at_axis(point, c)) * b[c];
      const double scale = testing::tangent<TypeParam>(point).norm();
      EXPECT_LT((sum - TypeParam::stiffness(point, node, TypeParam::at_node(point, b))).norm(), 1e-13 * scale);
    }
  }
}

/// Exactly zero, in float too, so that a body at rest stays at rest.
TYPED_TEST(EveryMaterial, RestIsFreeOfStressAndEnergy) {
  const Mat3<double> rest = Mat3<double>::Identity();
  EXPECT_EQ(this->energy(rest), 0);
  EXPECT_EQ(this->stress(rest).norm(), 0);
  EXPECT_EQ(TypeParam::second_piola(this->at(rest)).norm(), 0);

  float parameters[TypeParam::kParameterCount];
  for (int i = 0; i < TypeParam::kParameterCount; ++i) parameters[i] = static_cast<float>(this->parameters_[i]);
  const auto point = TypeParam::at(Mat3<float>(Mat3<float>::Identity()), parameters);
  EXPECT_EQ(TypeParam::energy(point), 0);
  EXPECT_EQ(TypeParam::stress(point).norm(), 0);
}

/// Only a law with constant stiffness may depend on rotation: it is linear, and its header says so.
TYPED_TEST(EveryMaterial, IsObjectiveUnlessLinear) {
  for (const Mat3<double>& f : this->states()) {
    const Mat3<double> rotation = random_rotation(this->random_), turned = rotation * f;
    const Mat3<double> stress = this->stress(f);
    const double scale = stress.norm() + 1e-3 * kYoungModulusPa;
    const double difference = (this->stress(turned) - rotation * stress).norm() / scale;
    if constexpr (TypeParam::kConstantStiffness) {
      EXPECT_GT(difference, 0.05);
    } else {
      EXPECT_LT(difference, 1e-11) << "F =\n" << f;
      EXPECT_NEAR(this->energy(turned), this->energy(f), 1e-12 * scale);
    }
  }
}

/// Rotating an isotropic solid before it is deformed changes nothing; with fibres it changes the energy.
TYPED_TEST(EveryMaterial, IsIsotropicUnlessItHasFibres) {
  for (int trial = 0; trial < 20; ++trial) {
    const Mat3<double> f = random_deformation(this->random_, 0.6, 1.5), rotation = random_rotation(this->random_);
    const Mat3<double> turned =
        TypeParam::kConstantStiffness ? Mat3<double>(rotation.transpose() * f * rotation) : Mat3<double>(f * rotation);
    const double difference = std::abs(this->energy(turned) - this->energy(f)) / this->energy(f);
    if constexpr (kIsotropic<TypeParam>) {
      EXPECT_LT(difference, 1e-11);
    } else {
      EXPECT_GT(difference, 1e-5);
    }
  }
}

TYPED_TEST(EveryMaterial, SmallStrainIsHooke) {
  const Mat3<double> rest = Mat3<double>::Identity();
  for (const double poisson : {-0.3, 0.0, 0.3, 0.45, 0.4999}) {
    const auto own = testing::parameters<TypeParam>(kYoungModulusPa, poisson);
    const auto linear = testing::parameters<Hooke>(kYoungModulusPa, poisson);
    const YoungPoisson moduli = young_poisson_from(TypeParam::moduli_at_rest(own.data()));
    EXPECT_NEAR(moduli.young_modulus_pa, kYoungModulusPa, 1e-9 * kYoungModulusPa);
    EXPECT_NEAR(moduli.poisson_ratio, poisson, 1e-12);

    const Tangent expected = testing::tangent<Hooke>(Hooke::at(rest, linear.data()));
    Tangent difference = testing::tangent<TypeParam>(TypeParam::at(rest, own.data())) - expected;
    if constexpr (!kIsotropic<TypeParam>) {
      // Fibres add modulus a0 ⊗ a0 ⊗ a0 ⊗ a0.
      const Vec3<double> a0 = Vec3<double>(1, 2, -1).normalized();
      const Eigen::Matrix<double, 9, 1> fibre = (a0 * a0.transpose()).reshaped();
      difference -= testing::kFibreModulusPa * fibre * fibre.transpose();
    }
    EXPECT_LT(difference.norm(), 1e-13 * expected.norm()) << "ν = " << poisson;
  }
}

TYPED_TEST(EveryMaterial, SecondPiolaIsTheStressPulledBack) {
  for (const Mat3<double>& f : this->states()) {
    const auto point = this->at(f);
    const Mat3<double> s = TypeParam::second_piola(point), p = TypeParam::stress(point);
    EXPECT_LT((s - s.transpose()).norm(), 1e-13 * s.norm());
    if constexpr (TypeParam::kConstantStiffness) {
      EXPECT_EQ(s, p);
    } else if (Eigen::JacobiSVD<Mat3<double>>(f).singularValues()[2] > 0.05) {
      EXPECT_LT((f * s - p).norm(), 1e-12 * p.norm()) << "F =\n" << f;
    }
  }
}

/// Selective reduced integration adds two parts: one resists change of shape only, the other change of volume only.
TYPED_TEST(EveryMaterial, DeviatoricAndVolumetricPartsAddUp) {
  auto deviatoric = this->parameters_, volumetric = this->parameters_, scaled = this->parameters_;
  TypeParam::scale_moduli(deviatoric.data(), 1.0, 0.0);
  TypeParam::scale_moduli(volumetric.data(), 0.0, 1.0);
  TypeParam::scale_moduli(scaled.data(), 0.5, 2.0);
  for (const Mat3<double>& f : this->states()) {
    const auto shape = TypeParam::at(f, deviatoric.data()), volume = TypeParam::at(f, volumetric.data());
    const auto mixed = TypeParam::at(f, scaled.data()), whole = this->at(f);
    const Mat3<double> stress = TypeParam::stress(whole);
    const double scale = TypeParam::stress(shape).norm() + TypeParam::stress(volume).norm();
    EXPECT_NEAR(TypeParam::energy(shape) + TypeParam::energy(volume), TypeParam::energy(whole), 1e-12 * scale);
    EXPECT_NEAR(0.5 * TypeParam::energy(shape) + 2 * TypeParam::energy(volume), TypeParam::energy(mixed),
                1e-12 * scale);
    EXPECT_LT((TypeParam::stress(shape) + TypeParam::stress(volume) - stress).norm(), 1e-12 * scale);
    const Tangent sum = testing::tangent<TypeParam>(shape) + testing::tangent<TypeParam>(volume);
    EXPECT_LT((sum - testing::tangent<TypeParam>(whole)).norm(), 1e-12 * sum.norm());
  }
  Mat3<double> sheared = Mat3<double>::Identity();
  sheared(0, 1) = 1e-6;
  const Mat3<double> swollen = (1 + 1e-6) * Mat3<double>::Identity();
  const double shear = TypeParam::stress(this->at(sheared)).norm(), swell = TypeParam::stress(this->at(swollen)).norm();
  EXPECT_LT(TypeParam::stress(TypeParam::at(sheared, volumetric.data())).norm(), 1e-5 * shear);
  if constexpr (kIsotropic<TypeParam>) {
    EXPECT_LT(TypeParam::stress(TypeParam::at(swollen, deviatoric.data())).norm(), 1e-5 * swell);
  }
}

TYPED_TEST(EveryMaterial, ProjectedStiffnessIsPsd) {
  auto states = this->states();
  for (int i = 0; i < 300; ++i) states.push_back(random_deformation(this->random_, 0.1, 1.5));
  int indefinite = 0;
  for (const Mat3<double>& f : states) {
    auto point = this->at(f);
    const Tangent consistent = testing::tangent<TypeParam>(point);
    const double energy = TypeParam::energy(point), least = testing::least_eigenvalue(consistent);
    const Mat3<double> stress = TypeParam::stress(point), s = TypeParam::second_piola(point);
    TypeParam::project_to_psd(point);
    const Tangent positive = testing::tangent<TypeParam>(point);
    EXPECT_GT(testing::least_eigenvalue(positive), -1e-12 * consistent.norm()) << "F =\n" << f;
    EXPECT_EQ(TypeParam::energy(point), energy);
    EXPECT_EQ(TypeParam::stress(point), stress);
    EXPECT_EQ(TypeParam::second_piola(point), s);
    indefinite += least < -1e-6 * consistent.norm();
  }
  if constexpr (!TypeParam::kConstantStiffness) {
    EXPECT_GT(indefinite, 20) << "too few states have an indefinite stiffness";
  }
}

/// A stiffness that is already positive semi-definite is unchanged bitwise by the projection: in tension for every law.
/// Laws in principal stretches keep it wherever it is positive; elsewhere negative eigenvalues change their sign.
TYPED_TEST(EveryMaterial, ProjectionKeepsAPositiveStiffness) {
  int unchanged = 0;
  for (const Mat3<double>& f : this->states()) {
    auto point = this->at(f);
    const Tangent consistent = testing::tangent<TypeParam>(point);
    TypeParam::project_to_psd(point);
    const Tangent positive = testing::tangent<TypeParam>(point);
    if constexpr (requires { point.w.rotation; }) {
      const Eigen::SelfAdjointEigenSolver<Tangent> eigen(consistent);
      const Tangent absolute =
          eigen.eigenvectors() * eigen.eigenvalues().cwiseAbs().asDiagonal() * eigen.eigenvectors().transpose();
      EXPECT_LT((positive - absolute).norm(), 1e-11 * consistent.norm()) << "F =\n" << f;
      if (eigen.eigenvalues()[0] > 1e-12 * consistent.norm()) {
        EXPECT_EQ(positive, consistent);
        ++unchanged;
      }
    }
  }
  std::uniform_real_distribution<double> stretch(1.1, 1.6), shear(-0.01, 0.01);
  for (int trial = 0; trial < 50; ++trial) {
    Mat3<double> f = Mat3<double>::NullaryExpr([&] { return shear(this->random_); });
    for (int i = 0; i < 3; ++i) f(i, i) = stretch(this->random_);
    auto point = this->at(random_rotation(this->random_) * f);
    const Tangent consistent = testing::tangent<TypeParam>(point);
    if (testing::least_eigenvalue(consistent) < -1e-12 * consistent.norm()) continue;
    TypeParam::project_to_psd(point);
    EXPECT_EQ(testing::tangent<TypeParam>(point), consistent) << "F =\n" << f;
    ++unchanged;
  }
  EXPECT_GT(unchanged, 15);
}

TYPED_TEST(EveryMaterial, FloatAgreesWithDouble) {
  float parameters[TypeParam::kParameterCount];
  for (int i = 0; i < TypeParam::kParameterCount; ++i) parameters[i] = static_cast<float>(this->parameters_[i]);
  for (const Mat3<double>& f : this->states()) {
    const Mat3<float> rounded = f.template cast<float>();
    auto expected = this->at(rounded.template cast<double>());
    auto actual = TypeParam::at(rounded, parameters);
    TypeParam::project_to_psd(expected);
    TypeParam::project_to_psd(actual);
    const double stiffness = testing::tangent<TypeParam>(expected).norm();
    EXPECT_LT((TypeParam::stress(actual).template cast<double>() - TypeParam::stress(expected)).norm(),
              5e-6 * stiffness)
        << "F =\n"
        << f;
    EXPECT_NEAR(TypeParam::energy(actual), TypeParam::energy(expected), 5e-6 * stiffness);
    const Vec3<float> a(0.3f, -0.7f, 0.2f), b(-0.5f, 0.1f, 0.9f);
    const Mat3<float> k = TypeParam::stiffness(actual, TypeParam::at_node(actual, a), TypeParam::at_node(actual, b));
    const Vec3<double> ad = a.cast<double>(), bd = b.cast<double>();
    const Mat3<double> kd =
        TypeParam::stiffness(expected, TypeParam::at_node(expected, ad), TypeParam::at_node(expected, bd));
    EXPECT_LT((k.cast<double>() - kd).norm(), 2e-5 * stiffness) << "F =\n" << f;
  }
}

template <class L, class Real>
void expect_lanes_to_agree(const std::vector<Mat3<double>>& states) {
  using Lanes = NativeLanes<Real>;
  using T = typename Lanes::Scalar;
  constexpr int kWidth = static_cast<int>(Lanes::kWidth);
  const auto all = [](const auto& point) {
    using Scalar = std::decay_t<decltype(L::energy(point))>;
    const Vec3<Scalar> a(Scalar(0.3), Scalar(-0.7), Scalar(0.2)), b(Scalar(-0.5), Scalar(0.1), Scalar(0.9));
    std::vector<Scalar> out{L::energy(point)};
    for (const Mat3<Scalar>& m : {Mat3<Scalar>(L::stress(point)), Mat3<Scalar>(L::second_piola(point)),
                                  Mat3<Scalar>(L::stiffness(point, L::at_node(point, a), L::at_node(point, b)))}) {
      for (int i = 0; i < 9; ++i) out.push_back(m(i));
    }
    return out;
  };
  const double epsilon = std::numeric_limits<Real>::epsilon();
  for (std::size_t first = 0; first + kWidth <= states.size(); first += kWidth) {
    Mat3<T> f;
    T packed_parameters[L::kParameterCount];
    Real parameters[kWidth][L::kParameterCount];
    for (int lane = 0; lane < kWidth; ++lane) {
      for (int i = 0; i < 9; ++i) f(i).v[lane] = static_cast<Real>(states[first + lane](i));
      const auto own = testing::parameters<L>((1 + 0.1 * lane) * kYoungModulusPa, 0.05 * lane);
      for (int i = 0; i < L::kParameterCount; ++i) {
        packed_parameters[i].v[lane] = parameters[lane][i] = static_cast<Real>(own[i]);
      }
    }
    auto packed = L::at(f, packed_parameters);
    L::project_to_psd(packed);
    const auto actual = all(packed);
    for (int lane = 0; lane < kWidth; ++lane) {
      auto point = L::at(Mat3<Real>(states[first + lane].cast<Real>()), parameters[lane]);
      L::project_to_psd(point);
      const auto expected = all(point);
      double size = kYoungModulusPa;
      for (const Real value : expected) size = std::max(size, std::abs(static_cast<double>(value)));
      // Equal except where the compiler fuses a multiplication with an addition.
      for (std::size_t i = 0; i < expected.size(); ++i) {
        EXPECT_NEAR(actual[i].v[lane], expected[i], 300 * epsilon * size) << "value " << i << " of lane " << lane;
      }
    }
  }
}

TYPED_TEST(EveryMaterial, EachLaneOfAPackIsTheScalarResult) {
  expect_lanes_to_agree<TypeParam, float>(this->states());
  expect_lanes_to_agree<TypeParam, double>(this->states());
}

TEST(Moduli, YoungAndPoissonRoundTrip) {
  for (const double poisson : {-0.5, 0.0, 0.25, 0.4999}) {
    const Lame lame = lame_from_young(7.0, poisson);
    const YoungPoisson found = young_poisson_from({lame.lambda_pa + 2 * lame.mu_pa / 3, lame.mu_pa});
    EXPECT_NEAR(found.young_modulus_pa, 7, 1e-12);
    EXPECT_NEAR(found.poisson_ratio, poisson, 1e-12);
  }
}

}  // namespace
}  // namespace tensormass::physics
