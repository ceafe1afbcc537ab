#pragma once

#include <array>

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// W = C10 (J^−2/3 I1 − 3) + C01 (J^−4/3 I2 − 3) + K/2 (J − 1)² (Mooney 1940, Rivlin 1948; split into isochoric and
/// volumetric parts as in Holzapfel 2000). The shear modulus at rest is 2 (C10 + C01).
///
/// For rubber and nearly incompressible tissue, with K well above the shear modulus. A uniform collapse costs only K/2.
///
/// Defined for J > 0. At J ≤ 0 it is NaN, which stops the scene.
struct MooneyRivlin : StretchLaw<MooneyRivlin> {
  static constexpr const char* kName = "mooney_rivlin";
  static constexpr Inversion kInversion = Inversion::kCaught;
  static constexpr int kParameterCount = 3;

  /// All moduli in Pa.
  static std::array<double, kParameterCount> parameters(double c10_pa, double c01_pa, double bulk_modulus_pa) {
    return {c10_pa, c01_pa, bulk_modulus_pa};
  }
  static constexpr Moduli moduli_at_rest(const double* parameters) {
    return {parameters[2], 2 * (parameters[0] + parameters[1])};
  }

  template <class T>
  TM_HOST_DEVICE static void scale_moduli(T* parameters, T deviatoric, T volumetric) {
    parameters[0] *= deviatoric;
    parameters[1] *= deviatoric;
    parameters[2] *= volumetric;
  }

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const Invariants<T> invariants(sigma);
    const T inverse_j = T(1) / invariants.j, dilatation = invariants.j - T(1), bulk = parameters[2];
    const T root = exponential(T(logarithm(invariants.j) * T(-2.0 / 3)));  // J^−2/3
    const T c1 = parameters[0] * root, c2 = parameters[1] * root * root;
    // Computes with a third of each part, so that terms which cancel at rest cancel without rounding.
    const T third1 = c1 * (invariants.i1 * T(1.0 / 3)), third2 = c2 * (invariants.i2 * T(1.0 / 3));
    InvariantEnergy<T> w;
    w.energy = parameters[0] * (root * invariants.i1 - T(3)) + parameters[1] * (root * root * invariants.i2 - T(3)) +
               T(0.5) * bulk * dilatation * dilatation;
    w.gradient = Vec3<T>(c1, c2, bulk * dilatation - T(2) * (third1 + T(2) * third2) * inverse_j);
    const T h1 = T(-2.0 / 3) * c1 * inverse_j, h2 = T(-4.0 / 3) * c2 * inverse_j;
    const T hj = bulk + (T(10) * third1 + T(28) * third2) * inverse_j * inverse_j * T(1.0 / 3);
    w.hessian << T(0), T(0), h1, T(0), T(0), h2, h1, h2, hj;
    return from_invariants(w, sigma, invariants);
  }
};

}  // namespace tensormass::physics
