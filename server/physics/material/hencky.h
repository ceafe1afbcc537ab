#pragma once

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// Hooke's law in the logarithmic strain, W = μ Σ (ln σ_i)² + λ/2 (ln J)² (Hencky 1928). σ_i are the principal
/// stretches.
///
/// Stretching to twice the length costs the same energy as compressing to half, and compression to zero costs infinite
/// energy. Measured solids follow the law for stretches of 0.7 to 1.3 (Anand 1979). It is not convex beyond a stretch
/// of e.
///
/// Defined for J > 0. At J ≤ 0 it is NaN, which stops the scene.
struct Hencky : StretchLaw<Hencky>, LameParameters {
  static constexpr const char* kName = "hencky";
  static constexpr Inversion kInversion = Inversion::kCaught;

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T lambda = parameters[0], mu = parameters[1], two_mu = mu + mu;
    Vec3<T> strain;  // ln σ
    for (int i = 0; i < 3; ++i) strain[i] = logarithm(sigma[i]);
    const T pressure = lambda * strain.sum();

    StretchEnergy<T> w;
    w.energy = mu * strain.squaredNorm() + T(0.5) * pressure * strain.sum();
    for (int i = 0; i < 3; ++i) {
      const int a = (i + 1) % 3, b = (i + 2) % 3;
      const T beta = two_mu * strain[i] + pressure;  // β = σ ∂W/∂σ, the principal Kirchhoff stress
      w.gradient[i] = beta / sigma[i];
      w.hessian(i, i) = (two_mu + lambda - beta) / (sigma[i] * sigma[i]);
      const T inverse_ab = T(1) / (sigma[a] * sigma[b]), sum = sigma[a] + sigma[b];
      w.hessian(a, b) = w.hessian(b, a) = lambda * inverse_ab;
      // With t = ½ ln(σ_a / σ_b): half the difference β_a − β_b is 2 μ t, and (σ_a − σ_b) / (σ_a + σ_b) is tanh t. The
      // quotient t / sinh t does not cancel where σ_a = σ_b.
      const T middle = mu * (strain[a] + strain[b]) + pressure;
      const T t = maximum(T(absolute(T(strain[a] - strain[b])) * T(0.5)), T(1e-9));
      const T steep = mu * (t / hyperbolic_sine(t)) * square_root(inverse_ab) * sum;  // 2 μ t / tanh t
      const T flat = mu * (strain[a] - strain[b]) * (sigma[a] - sigma[b]) / sum;
      w.distortion[i] = (steep - middle) * inverse_ab;
      w.rotation[i] = (middle - flat) * inverse_ab;
    }
    return w;
  }
};

}  // namespace tensormass::physics
