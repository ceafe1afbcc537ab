#pragma once

#include <array>

#include "core/scalar.h"

/// Moduli of isotropic solids, and the code that laws with Young's modulus and Poisson's ratio share.
///
///   E, ν     Young's modulus [Pa], Poisson's ratio
///   λ, μ     Lamé parameters [Pa]; μ is the shear modulus
///   K        bulk modulus [Pa], λ + 2 μ / 3
namespace tensormass::physics {

/// Lamé parameters [Pa] of an isotropic solid.
struct Lame {
  double lambda_pa;
  double mu_pa;
};

/// Returns λ = E ν / ((1+ν)(1−2ν)) and μ = E / (2(1+ν)), for ν in (−1, 0.5).
constexpr Lame lame_from_young(double young_modulus_pa, double poisson_ratio) {
  return {young_modulus_pa * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio)),
          young_modulus_pa / (2 * (1 + poisson_ratio))};
}

/// Bulk modulus (resistance to change of volume) and shear modulus (resistance to change of shape) [Pa].
struct Moduli {
  double bulk_pa;
  double shear_pa;
};

/// Young's modulus [Pa] and Poisson's ratio.
struct YoungPoisson {
  double young_modulus_pa;
  double poisson_ratio;
};

/// Returns E = 9 K μ / (3 K + μ) and ν = (3 K − 2 μ) / (2 (3 K + μ)).
constexpr YoungPoisson young_poisson_from(const Moduli& m) {
  const double sum = 3 * m.bulk_pa + m.shear_pa;
  return {9 * m.bulk_pa * m.shear_pa / sum, (3 * m.bulk_pa - 2 * m.shear_pa) / (2 * sum)};
}

/// Base of laws whose parameters are λ, μ [Pa].
struct LameParameters {
  static constexpr int kParameterCount = 2;

  /// Needs ν in (−1, 0.5).
  static std::array<double, kParameterCount> parameters(double young_modulus_pa, double poisson_ratio) {
    const Lame lame = lame_from_young(young_modulus_pa, poisson_ratio);
    return {lame.lambda_pa, lame.mu_pa};
  }

  static constexpr Moduli moduli_at_rest(const double* parameters) {
    return {parameters[0] + 2 * parameters[1] / 3, parameters[1]};
  }

  /// Scales μ by `deviatoric` and K by `volumetric`.
  template <class T>
  TM_HOST_DEVICE static void scale_moduli(T* parameters, T deviatoric, T volumetric) {
    const T bulk = parameters[0] + parameters[1] * T(2.0 / 3);
    parameters[1] *= deviatoric;
    parameters[0] = bulk * volumetric - parameters[1] * T(2.0 / 3);
  }
};

/// Returns W = λ/2 (tr E)² + μ E:E [J/m³] for a strain E.
template <class T>
TM_HOST_DEVICE T quadratic_energy(const Mat3<T>& strain, T lambda, T mu) {
  const T trace = strain.trace();
  return T(0.5) * lambda * trace * trace + mu * strain.cwiseProduct(strain).sum();
}

/// Returns ∂W/∂E = λ tr(E) I + 2 μ E [Pa].
template <class T>
TM_HOST_DEVICE Mat3<T> quadratic_stress(const Mat3<T>& strain, T lambda, T mu) {
  return strain * (T(2) * mu) + Mat3<T>::Identity() * (lambda * strain.trace());
}

}  // namespace tensormass::physics
