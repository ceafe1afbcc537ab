#pragma once

#include "physics/material/invariant_law.h"
#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// W = μ/2 (I1 − 3) − μ ln J + λ/2 (ln J)² (Bonet, Wood 2008), for any ν in (−1, 0.5).
///
/// Resistance grows without bound towards collapse. The term λ (ln J)² softens in strong expansion, beyond J = e.
///
/// Defined for J > 0. At J ≤ 0 the logarithm is NaN, which stops the scene.
struct NeoHookean : InvariantLaw<NeoHookean>, LameParameters {
  static constexpr const char* kName = "neo_hookean";
  static constexpr Inversion kInversion = Inversion::kCaught;

  template <class T>
  TM_HOST_DEVICE static InvariantSlopes<T> in_invariants(const T& /*i1*/, const T& j, const T* parameters) {
    const T lambda = parameters[0], mu = parameters[1], log_j = logarithm(j), inverse_j = T(1) / j;
    return {T(0.5) * mu, (lambda * log_j - mu) * inverse_j, T(0),
            (lambda - lambda * log_j + mu) * inverse_j * inverse_j};
  }

  template <class T>
  TM_HOST_DEVICE static T energy_of(const T& i1, const T& j, const T* parameters) {
    const T lambda = parameters[0], mu = parameters[1], log_j = logarithm(j);
    return T(0.5) * (mu * (i1 - T(3)) + lambda * log_j * log_j) - mu * log_j;
  }
};

}  // namespace tensormass::physics
