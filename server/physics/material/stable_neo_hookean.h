#pragma once

#include "physics/material/invariant_law.h"
#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// W = μ'/2 (I1 − 3) − μ'/2 ln((I1 + 1) / 4) + λ'/2 (J − α)² + constant (Smith, de Goes, Kim 2018)
///
/// with α = 1 + μ'/λ' − μ'/(4 λ'), μ' = 4/3 μ and λ' = λ + 5/6 μ, so that the small-strain limit is Hooke's law.
///
/// Multiplied out, λ' leaves the denominator:  W = 2/3 μ (I1 − 3 − ln((I1 + 1) / 4)) − μ (J − 1) + λ'/2 (J − 1)².
///
/// Smooth in F everywhere. Finite in collapse and inversion, and recovers from both. λ' is positive for any ν in (−1,
/// 0.5).
struct StableNeoHookean : InvariantLaw<StableNeoHookean>, LameParameters {
  static constexpr const char* kName = "stable_neo_hookean";
  static constexpr Inversion kInversion = Inversion::kRecovers;

  template <class T>
  TM_HOST_DEVICE static InvariantSlopes<T> in_invariants(const T& i1, const T& j, const T* parameters) {
    const T mu = parameters[1], lambda = lambda_of(parameters), inverse = T(1) / (i1 + T(1));
    // 2/3 (1 − 1/(I1 + 1)), written so that it is exactly one half at rest.
    return {mu * (T(0.5) + (i1 - T(3)) * inverse * T(1.0 / 6)), lambda * (j - T(1)) - mu,
            T(2.0 / 3) * mu * inverse * inverse, lambda};
  }

  template <class T>
  TM_HOST_DEVICE static T energy_of(const T& i1, const T& j, const T* parameters) {
    const T mu = parameters[1], dilatation = j - T(1);
    return T(2.0 / 3) * mu * (i1 - T(3) - logarithm(T((i1 + T(1)) * T(0.25)))) +
           (T(0.5) * lambda_of(parameters) * dilatation - mu) * dilatation;
  }

 private:
  template <class T>
  TM_HOST_DEVICE static T lambda_of(const T* parameters) {
    return parameters[0] + parameters[1] * T(5.0 / 6);
  }
};

}  // namespace tensormass::physics
