#include <cmath>

#include "physics/laws.h"

/// Compares each law with its closed forms, and checks what its header says about collapse and inversion.
namespace tensormass::physics {
namespace {

constexpr double kYoungPa = testing::kYoungModulusPa, kPoisson = testing::kPoissonRatio;
constexpr Lame kLame = lame_from_young(kYoungPa, kPoisson);
constexpr double kLambda = kLame.lambda_pa, kMu = kLame.mu_pa;

template <class L>
Mat3<double> stress(const Mat3<double>& f, const std::array<double, L::kParameterCount>& parameters) {
  return L::stress(L::at(f, parameters.data()));
}

struct Uniaxial {
  double contraction;  // lateral stretch
  double stress_pa;    // first Piola-Kirchhoff
};

/// Stretches a bar along x with free sides. Finds the lateral stretch by bisection.
template <class L>
Uniaxial pull(double stretch, const std::array<double, L::kParameterCount>& parameters) {
  double low = 0.2, high = 3;
  const auto at = [&](double across) {
    return stress<L>(Vec3<double>(stretch, across, across).asDiagonal(), parameters);
  };
  for (int i = 0; i < 200; ++i) {
    const double middle = (low + high) / 2;
    (at(middle)(1, 1) > 0 ? high : low) = middle;
  }
  return {low, at(low)(0, 0)};
}

template <class L>
double shear_stress(double gamma, const std::array<double, L::kParameterCount>& parameters) {
  Mat3<double> f = Mat3<double>::Identity();
  f(0, 1) = gamma;
  return stress<L>(f, parameters)(0, 1);
}

/// Compares the shear stress with a closed form over a range of shears γ.
///
///   expected(gamma)   returns the shear stress [Pa]
template <class L, class Expected>
void expect_shear(const Expected& expected,
                  const std::array<double, L::kParameterCount>& parameters = testing::parameters<L>()) {
  for (const double gamma : {-1.5, -0.2, 1e-4, 0.3, 1.0, 2.0}) {
    EXPECT_NEAR(shear_stress<L>(gamma, parameters), expected(gamma), 1e-11 * kYoungPa) << "γ = " << gamma;
  }
}

TEST(Hooke, IsLinearInTensionAndShear) {
  for (const double stretch : {0.7, 1.2, 1.8}) {
    const Uniaxial found = pull<Hooke>(stretch, testing::parameters<Hooke>());
    EXPECT_NEAR(found.contraction, 1 - kPoisson * (stretch - 1), 1e-12);
    EXPECT_NEAR(found.stress_pa, kYoungPa * (stretch - 1), 1e-10 * kYoungPa);
  }
  expect_shear<Hooke>([](double gamma) { return kMu * gamma; });
}

TEST(StVenantKirchhoff, FollowsGreensStrainInTension) {
  for (const double stretch : {0.7, 1.2, 1.5}) {
    const Uniaxial found = pull<StVenantKirchhoff>(stretch, testing::parameters<StVenantKirchhoff>());
    const double twice_strain = stretch * stretch - 1;
    EXPECT_NEAR(found.contraction, std::sqrt(1 - kPoisson * twice_strain), 1e-12);
    EXPECT_NEAR(found.stress_pa, kYoungPa / 2 * stretch * twice_strain, 1e-10 * kYoungPa);
  }
  expect_shear<StVenantKirchhoff>(
      [](double gamma) { return kMu * gamma + (kLambda / 2 + kMu) * gamma * gamma * gamma; });
}

TEST(Corotational, IsLinearInTensionAndRotatesInShear) {
  for (const double stretch : {0.5, 1.2, 1.8}) {
    const Uniaxial found = pull<Corotational>(stretch, testing::parameters<Corotational>());
    EXPECT_NEAR(found.contraction, 1 - kPoisson * (stretch - 1), 1e-12);
    EXPECT_NEAR(found.stress_pa, kYoungPa * (stretch - 1), 1e-10 * kYoungPa);
  }
  expect_shear<Corotational>([](double gamma) {
    const double half = std::sqrt(1 + gamma * gamma / 4), sine = gamma / 2 / half;  // tr S = 2 half + 1
    return 2 * kMu * (gamma - sine) + kLambda * (2 * half - 2) * sine;
  });
}

TEST(NeoHookean, FollowsItsLogarithmInTensionAndIsLinearInShear) {
  for (const double stretch : {0.3, 0.7, 1.2, 2.5}) {
    const Uniaxial found = pull<NeoHookean>(stretch, testing::parameters<NeoHookean>());
    const double across = found.contraction * found.contraction;
    const double pressure = kLambda * std::log(stretch * across);
    EXPECT_NEAR(kMu * (across - 1) + pressure, 0, 1e-10 * kYoungPa);
    EXPECT_NEAR(found.stress_pa, (kMu * (stretch * stretch - 1) + pressure) / stretch, 1e-10 * kYoungPa);
  }
  expect_shear<NeoHookean>([](double gamma) { return kMu * gamma; });
}

/// Compares with the formula of the paper, which contains α.
TEST(StableNeoHookean, FollowsThePublishedFormulasInTensionAndShear) {
  const double mu = 4 * kMu / 3, lambda = kLambda + 5 * kMu / 6, alpha = 1 + mu / lambda - mu / (4 * lambda);
  for (const double stretch : {0.3, 0.7, 1.2, 2.5}) {
    const Uniaxial found = pull<StableNeoHookean>(stretch, testing::parameters<StableNeoHookean>());
    const double across = found.contraction, squares = stretch * stretch + 2 * across * across;
    const double shape = mu * (1 - 1 / (squares + 1)), volume = lambda * (stretch * across * across - alpha);
    EXPECT_NEAR(shape * across + volume * stretch * across, 0, 1e-10 * kYoungPa);
    EXPECT_NEAR(found.stress_pa, shape * stretch + volume * across * across, 1e-10 * kYoungPa);
  }
  expect_shear<StableNeoHookean>([&](double gamma) { return mu * (1 - 1 / (4 + gamma * gamma)) * gamma; });
}

/// A nearly incompressible solid follows the textbook formulas of the incompressible one.
TEST(MooneyRivlin, FollowsRivlinsFormulasInTensionAndShear) {
  const double c10 = 300, c01 = 120;
  const auto parameters = MooneyRivlin::parameters(c10, c01, 1e7 * (c10 + c01));
  for (const double stretch : {0.5, 0.8, 1.5, 3.0}) {
    const Uniaxial found = pull<MooneyRivlin>(stretch, parameters);
    const double expected = 2 * (stretch - 1 / (stretch * stretch)) * (c10 + c01 / stretch);
    EXPECT_NEAR(found.contraction, 1 / std::sqrt(stretch), 1e-6);
    EXPECT_NEAR(found.stress_pa, expected, 1e-6 * std::abs(expected));
  }
  // Simple shear keeps the volume, so K does not matter.
  expect_shear<MooneyRivlin>([&](double gamma) { return 2 * (c10 + c01) * gamma; },
                             MooneyRivlin::parameters(c10, c01, 9e3));
  const double bulk_pa = 9e3, stretch = 1.3;
  const Mat3<double> swollen =
      stress<MooneyRivlin>(stretch * Mat3<double>::Identity(), MooneyRivlin::parameters(c10, c01, bulk_pa));
  EXPECT_NEAR(swollen(0, 0), bulk_pa * (std::pow(stretch, 3) - 1) * stretch * stretch, 1e-10 * bulk_pa);
}

TEST(Ogden, FollowsItsPowersInTensionAndShear) {
  for (const double alpha : {-9.0, -2.0, 2.0, 7.5}) {
    const double mu = 2 * kMu / alpha;
    const auto stiff = Ogden::parameters(mu, alpha, 1e7 * kMu);
    for (const double stretch : {0.5, 0.8, 1.5, 2.0}) {
      const Uniaxial found = pull<Ogden>(stretch, stiff);
      const double expected = mu * (std::pow(stretch, alpha - 1) - std::pow(stretch, -alpha / 2 - 1));
      EXPECT_NEAR(found.contraction, 1 / std::sqrt(stretch), 1e-4);
      EXPECT_NEAR(found.stress_pa, expected, 1e-4 * std::abs(expected)) << "α = " << alpha << ", λ = " << stretch;
    }
    const auto parameters = Ogden::parameters(mu, alpha, 5 * kMu);
    for (const double gamma : {-1.0, 1e-4, 0.3, 1.0}) {
      const double stretch = gamma / 2 + std::sqrt(1 + gamma * gamma / 4);
      const double expected = mu * (std::pow(stretch, alpha) - std::pow(stretch, -alpha)) / (stretch + 1 / stretch);
      EXPECT_NEAR(shear_stress<Ogden>(gamma, parameters), expected, 1e-11 * kYoungPa + 1e-12 * std::abs(expected));
    }
  }
}

/// With α = 2 Ogden's law is Mooney-Rivlin's with C01 = 0.
TEST(Ogden, IsMooneyRivlinForAlphaTwo) {
  std::mt19937 random(3);
  for (int trial = 0; trial < 50; ++trial) {
    const Mat3<double> f = testing::random_deformation(random, 0.3, 1.8);
    const auto ogden = Ogden::parameters(600, 2, 4e3);
    const auto mooney = MooneyRivlin::parameters(300, 0, 4e3);
    const auto one = Ogden::at(f, ogden.data());
    const auto other = MooneyRivlin::at(f, mooney.data());
    EXPECT_NEAR(Ogden::energy(one), MooneyRivlin::energy(other), 1e-11 * MooneyRivlin::energy(other));
    EXPECT_LT((Ogden::stress(one) - MooneyRivlin::stress(other)).norm(), 1e-11 * MooneyRivlin::stress(other).norm());
    const auto expected = testing::tangent<MooneyRivlin>(other);
    EXPECT_LT((testing::tangent<Ogden>(one) - expected).norm(), 1e-11 * expected.norm());
  }
}

/// Fibres along the stretch add Δλ + 2 Δμ to C_11; fibres across add nothing; at an angle θ the addition scales with
/// cos⁴ θ.
TEST(TransverselyIsotropic, FibresStiffenAlongThemselvesOnly) {
  const double modulus = testing::kFibreModulusPa;
  for (const double angle : {0.0, 0.4, 1.0, M_PI / 2}) {
    const Vec3<double> along(3 * std::cos(angle), 3 * std::sin(angle), 0);  // the length does not matter
    const auto fibres = TransverselyIsotropic::parameters(kYoungPa, kPoisson, modulus, along);
    for (const double stretch : {0.8, 1 + 1e-6, 1.4}) {
      const Mat3<double> f = Vec3<double>(stretch, 1, 1).asDiagonal();
      const Mat3<double> added = stress<TransverselyIsotropic>(f, fibres) -
                                 stress<StVenantKirchhoff>(f, StVenantKirchhoff::parameters(kYoungPa, kPoisson));
      // S = modulus (a0·E a0) a0 a0ᵀ with a0·E a0 = E_11 cos².
      const double c = std::cos(angle), s = std::sin(angle), e11 = (stretch * stretch - 1) / 2;
      const double tension = modulus * e11 * c * c;
      EXPECT_NEAR(added(0, 0), stretch * tension * c * c, 1e-10 * modulus);
      EXPECT_NEAR(added(0, 1), stretch * tension * c * s, 1e-10 * modulus);
      EXPECT_NEAR(added(1, 1), tension * s * s, 1e-10 * modulus);
      EXPECT_NEAR(added(2, 2), 0, 1e-10 * modulus);
    }
  }
}

template <class L>
class CollapsedMaterial : public ::testing::Test {};
TYPED_TEST_SUITE(CollapsedMaterial, testing::AllLaws, testing::LawNames);

/// For collapsed and inverted F: a law returns either NaN, or finite values with a positive semi-definite projected
/// stiffness. A law that recovers also pushes back.
TYPED_TEST(CollapsedMaterial, RecoversOrIsNaNOrIsFinite) {
  using L = TypeParam;
  const auto parameters = testing::parameters<L>();
  Mat3<double> rank_one = Mat3<double>::Zero();
  rank_one(0, 1) = 2;
  const Mat3<double> collapsed[] = {
      Mat3<double>::Zero(),      Vec3<double>(1, 1, 0).asDiagonal(),       Vec3<double>(1, 1, -1).asDiagonal(),
      -Mat3<double>::Identity(), Vec3<double>(0.5, -2, 1e-9).asDiagonal(), rank_one};
  for (const Mat3<double>& f : collapsed) {
    auto point = L::at(f, parameters.data());
    const Mat3<double> stress = L::stress(point);
    if constexpr (testing::kNeedsPositiveVolume<L>) {
      EXPECT_FALSE(stress.allFinite()) << "the guard cannot detect F =\n" << f;
      continue;
    }
    EXPECT_TRUE(std::isfinite(L::energy(point)));
    EXPECT_TRUE(stress.allFinite());
    EXPECT_TRUE(testing::tangent<L>(point).allFinite());
    EXPECT_LT(L::second_piola(point).norm(), 1e3 * kYoungPa) << "F =\n" << f;
    L::project_to_psd(point);
    const auto positive = testing::tangent<L>(point);
    EXPECT_TRUE(positive.allFinite());
    EXPECT_GE(testing::least_eigenvalue(positive), -1e-12 * positive.norm()) << "F =\n" << f;

    float narrow[L::kParameterCount];
    for (int i = 0; i < L::kParameterCount; ++i) narrow[i] = static_cast<float>(parameters[i]);
    EXPECT_TRUE(L::stress(L::at(Mat3<float>(f.cast<float>()), narrow)).allFinite());
  }
  if constexpr (testing::kRecovers<L>) {
    // Below a height of −1 another stretch is the smallest. Laws in principal stretches then count that one as
    // inverted.
    for (double height = 0.95; height > -1; height -= 0.1) {
      EXPECT_LT(stress<L>(Vec3<double>(1, 1, height).asDiagonal(), parameters)(2, 2), 0) << "at " << height;
    }
  }
}

/// Any ν of the protocol works; the published form of stable neo-Hookean divides by λ.
TEST(StableNeoHookean, WorksWhereLambdaIsZeroOrNegative) {
  for (const double poisson : {-0.9, -0.3, 0.0}) {
    const auto parameters = testing::parameters<StableNeoHookean>(kYoungPa, poisson);
    for (const double height : {-1.0, 0.0, 0.5}) {
      EXPECT_LT(stress<StableNeoHookean>(Vec3<double>(1, 1, height).asDiagonal(), parameters)(2, 2), 0);
    }
  }
}

}  // namespace
}  // namespace tensormass::physics
