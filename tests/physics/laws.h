#pragma once

#include <array>
#include <cmath>
#include <random>
#include <string>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "physics/lists.h"
#include "physics/material/corotational.h"
#include "physics/material/mooney_rivlin.h"
#include "physics/material/neo_hookean.h"
#include "physics/material/ogden.h"
#include "physics/material/stable_neo_hookean.h"
#include "physics/material/transversely_isotropic.h"

/// The laws of physics/lists.h as the parameter of typed tests, and parameters to test them with.
namespace tensormass::physics::testing {

inline constexpr double kYoungModulusPa = 4e3, kPoissonRatio = 0.4;
inline constexpr double kOgdenAlpha = -5, kFibreModulusPa = 6e3;

/// Returns a law's parameters such that its small-strain limit, without fibres, is Hooke's law with these moduli. A law
/// with other parameters needs a specialization here.
template <class Law>
std::array<double, Law::kParameterCount> parameters(double young_modulus_pa = kYoungModulusPa,
                                                    double poisson_ratio = kPoissonRatio) {
  return Law::parameters(young_modulus_pa, poisson_ratio);
}
inline Moduli moduli(double young_modulus_pa, double poisson_ratio) {
  return {young_modulus_pa / (3 * (1 - 2 * poisson_ratio)), young_modulus_pa / (2 * (1 + poisson_ratio))};
}
template <>
inline std::array<double, 3> parameters<MooneyRivlin>(double young_modulus_pa, double poisson_ratio) {
  const Moduli m = moduli(young_modulus_pa, poisson_ratio);
  return MooneyRivlin::parameters(0.35 * m.shear_pa, 0.15 * m.shear_pa, m.bulk_pa);
}
template <>
inline std::array<double, 3> parameters<Ogden>(double young_modulus_pa, double poisson_ratio) {
  const Moduli m = moduli(young_modulus_pa, poisson_ratio);
  return Ogden::parameters(2 * m.shear_pa / kOgdenAlpha, kOgdenAlpha, m.bulk_pa);
}
template <>
inline std::array<double, 6> parameters<TransverselyIsotropic>(double young_modulus_pa, double poisson_ratio) {
  return TransverselyIsotropic::parameters(young_modulus_pa, poisson_ratio, kFibreModulusPa, {1, 2, -1});
}

template <class Law>
inline constexpr bool kIsotropic = !std::is_same_v<Law, TransverselyIsotropic>;
/// True if the law is undefined where det F is not positive.
template <class Law>
inline constexpr bool kNeedsPositiveVolume = std::is_same_v<Law, NeoHookean> || std::is_same_v<Law, MooneyRivlin> ||
                                             std::is_same_v<Law, Ogden> || std::is_same_v<Law, Hencky>;
/// True if the law recovers from collapse and inversion.
template <class Law>
inline constexpr bool kRecovers = Law::kInversion == Inversion::kRecovers;

namespace detail {
template <class... L>
::testing::Types<L...> as_types(TypeList<L...>);
}  // namespace detail

using AllLaws = decltype(detail::as_types(Laws{}));

struct LawNames {
  template <class L>
  static std::string GetName(int) {
    return L::kName;
  }
};

inline Mat3<double> random_rotation(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const Eigen::Quaterniond q(normal(random), normal(random), normal(random), normal(random));
  return q.normalized().toRotationMatrix();
}

/// Returns a random deformation gradient with principal stretches in [least, most].
inline Mat3<double> random_deformation(std::mt19937& random, double least, double most) {
  std::uniform_real_distribution<double> stretch(least, most);
  const Vec3<double> stretches(stretch(random), stretch(random), stretch(random));
  return random_rotation(random) * stretches.asDiagonal() * random_rotation(random).transpose();
}

/// Returns ∂P/∂F, with column-major indices of P and F.
template <class Law, class Point>
Eigen::Matrix<double, 9, 9> tangent(const Point& point) {
  Eigen::Matrix<double, 9, 9> out;
  for (int a = 0; a < 3; ++a) {
    for (int b = 0; b < 3; ++b) {
      out.block<3, 3>(3 * a, 3 * b) = Law::stiffness(point, Law::at_node(point, Vec3<double>(Vec3<double>::Unit(a))),
                                                     Law::at_node(point, Vec3<double>(Vec3<double>::Unit(b))));
    }
  }
  return out;
}

inline double least_eigenvalue(const Eigen::MatrixXd& symmetric) {
  return Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(symmetric, Eigen::EigenvaluesOnly).eigenvalues()[0];
}

}  // namespace tensormass::physics::testing
