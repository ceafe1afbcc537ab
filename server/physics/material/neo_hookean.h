#pragma once

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// W = μ/2 (I1 − 3) − μ ln J + λ/2 (ln J)² (Bonet, Wood 2008), for any ν in (−1, 0.5).
///
/// Resistance grows without bound towards collapse. The term λ (ln J)² softens in strong expansion, beyond J = e.
///
/// Defined for J > 0. At J ≤ 0 the logarithm is NaN, which stops the scene.
struct NeoHookean : StretchLaw<NeoHookean>, LameParameters {
  static constexpr const char* kName = "neo_hookean";
  static constexpr Inversion kInversion = Inversion::kCaught;

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T lambda = parameters[0], mu = parameters[1];
    const Invariants<T> invariants(sigma);
    const T log_j = logarithm(invariants.j), inverse_j = T(1) / invariants.j;
    InvariantEnergy<T> w;
    w.energy = T(0.5) * (mu * (invariants.i1 - T(3)) + lambda * log_j * log_j) - mu * log_j;
    w.gradient = Vec3<T>(T(0.5) * mu, T(0), (lambda * log_j - mu) * inverse_j);
    w.hessian = Mat3<T>::Zero();
    w.hessian(2, 2) = (lambda - lambda * log_j + mu) * inverse_j * inverse_j;
    return from_invariants(w, sigma, invariants);
  }
};

}  // namespace tensormass::physics
