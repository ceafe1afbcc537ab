#pragma once

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// W = μ'/2 (I1 − 3) − μ'/2 ln((I1 + 1) / 4) + λ'/2 (J − α)² + constant (Smith, de Goes, Kim 2018)
///
/// with α = 1 + μ'/λ' − μ'/(4 λ'), μ' = 4/3 μ and λ' = λ + 5/6 μ, so that the small-strain limit is Hooke's law.
///
/// Multiplied out, λ' leaves the denominator:  W = 2/3 μ (I1 − 3 − ln((I1 + 1) / 4)) − μ (J − 1) + λ'/2 (J − 1)².
///
/// Smooth in F everywhere. Finite in collapse and inversion, and recovers from both. λ' is positive for any ν in (−1,
/// 0.5).
struct StableNeoHookean : StretchLaw<StableNeoHookean>, LameParameters {
  static constexpr const char* kName = "stable_neo_hookean";
  static constexpr Inversion kInversion = Inversion::kRecovers;

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T mu = parameters[1], lambda = parameters[0] + mu * T(5.0 / 6);
    const Invariants<T> invariants(sigma);
    const T stretch = invariants.i1 - T(3), dilatation = invariants.j - T(1);
    const T inverse = T(1) / (invariants.i1 + T(1));
    InvariantEnergy<T> w;
    w.energy = T(2.0 / 3) * mu * (stretch - logarithm(T((invariants.i1 + T(1)) * T(0.25)))) +
               (T(0.5) * lambda * dilatation - mu) * dilatation;
    // 2/3 (1 − 1/(I1 + 1)), written so that it is exactly one half at rest.
    w.gradient = Vec3<T>(mu * (T(0.5) + stretch * inverse * T(1.0 / 6)), T(0), lambda * dilatation - mu);
    w.hessian = Mat3<T>::Zero();
    w.hessian(0, 0) = T(2.0 / 3) * mu * inverse * inverse;
    w.hessian(2, 2) = lambda;
    return from_invariants(w, sigma, invariants);
  }
};

}  // namespace tensormass::physics
