#pragma once

#include <array>

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// W = μ/α (σ̄0^α + σ̄1^α + σ̄2^α − 3) + K/2 (J − 1)², σ̄ = J^−1/3 σ (Ogden 1972, one term). The shear modulus at rest
/// is μ α / 2.
///
/// With large |α| it is fitted to soft tissue such as brain and fat. α sets how fast the tissue stiffens; a negative α
/// stiffens more in compression than in tension. Meant for K well above the shear modulus. A uniform collapse costs
/// only K/2.
///
/// Defined for J > 0. At J ≤ 0 it is NaN, which stops the scene.
struct Ogden : StretchLaw<Ogden> {
  static constexpr const char* kName = "ogden";
  static constexpr Inversion kInversion = Inversion::kCaught;
  static constexpr int kParameterCount = 3;  // μ/α [Pa], α, K [Pa]

  /// Needs μ and α of the same sign. μ and K in Pa.
  static std::array<double, kParameterCount> parameters(double mu_pa, double alpha, double bulk_modulus_pa) {
    return {mu_pa / alpha, alpha, bulk_modulus_pa};
  }
  static constexpr Moduli moduli_at_rest(const double* parameters) {
    return {parameters[2], parameters[0] * parameters[1] * parameters[1] / 2};
  }

  template <class T>
  TM_HOST_DEVICE static void scale_moduli(T* parameters, T deviatoric, T volumetric) {
    parameters[0] *= deviatoric;
    parameters[2] *= volumetric;
  }

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T alpha = parameters[1], mu = parameters[0] * alpha, bulk = parameters[2];
    const T j = sigma[0] * sigma[1] * sigma[2], dilatation = j - T(1), pressure = bulk * dilatation;
    Vec3<T> log_stretch, power;  // ln σ, σ̄^α
    for (int i = 0; i < 3; ++i) log_stretch[i] = logarithm(sigma[i]);
    const T third = log_stretch.sum() * T(1.0 / 3);
    for (int i = 0; i < 3; ++i) power[i] = exponential(T(alpha * (log_stretch[i] - third)));
    const T mean = power.sum() * T(1.0 / 3);

    StretchEnergy<T> w;
    w.energy = parameters[0] * (power.sum() - T(3)) + T(0.5) * pressure * dilatation;
    for (int i = 0; i < 3; ++i) {
      const int a = (i + 1) % 3, b = (i + 2) % 3;
      const T ab = sigma[a] * sigma[b], inverse_ab = T(1) / ab;
      // β = σ ∂W/∂σ is μ (σ̄^α − mean) for the first term and K (J − 1) J for the second.
      const T beta = mu * (power[i] - mean);
      w.gradient[i] = beta / sigma[i] + pressure * ab;
      w.hessian(i, i) = (mu * alpha * (power[i] + mean) * T(1.0 / 3) - beta) / (sigma[i] * sigma[i]) + bulk * ab * ab;
      w.hessian(a, b) = w.hessian(b, a) =
          mu * alpha * (mean - power[a] - power[b]) * T(1.0 / 3) * inverse_ab + (bulk * j + pressure) * sigma[i];
      // With t = ½ ln(σ_a / σ_b): half the difference β_a − β_b is μ (σ̄_a σ̄_b)^(α/2) sinh(α t), and (σ_a − σ_b) /
      // (σ_a + σ_b) is tanh t. The quotient sinh(α t) / sinh t is smooth and even in t; at t = 0 it is α.
      const T middle = mu * ((power[a] + power[b]) * T(0.5) - mean), sum = sigma[a] + sigma[b];
      const T t = maximum(T(absolute(T(log_stretch[a] - log_stretch[b])) * T(0.5)), T(1e-9));
      const T sines = hyperbolic_sine(T(alpha * t)) / hyperbolic_sine(t);
      const T steep = mu * square_root(T(power[a] * power[b] * inverse_ab)) * sines * sum * T(0.5);
      const T flat = mu * (power[a] - power[b]) * T(0.5) * (sigma[a] - sigma[b]) / sum;
      w.distortion[i] = (steep - middle) * inverse_ab - pressure * sigma[i];
      w.rotation[i] = (middle - flat) * inverse_ab + pressure * sigma[i];
    }
    return w;
  }
};

}  // namespace tensormass::physics
