#pragma once

#include <array>

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
///
/// A tetrahedron of a ring (model/clusters.h) keeps no resistance to change of volume, and could collapse within its
/// ring. It therefore has, in addition,
///
///   W_c = p_c (J_c − J)³ / (3 J_c²)   for J < J_c, else 0
///
///   J_c   below it the element counts as collapsing: kCollapse
///   p_c   pressure at J = 0 [Pa]; zero outside of rings
struct StableNeoHookean : StretchLaw<StableNeoHookean>, LameParameters {
  static constexpr const char* kName = "stable_neo_hookean";
  static constexpr Inversion kInversion = Inversion::kRecovers;
  static constexpr int kParameterCount = 3;  // λ, μ, p_c [Pa]

  /// Needs ν in (−1, 0.5).
  static std::array<double, kParameterCount> parameters(double young_modulus_pa, double poisson_ratio) {
    const Lame lame = lame_from_young(young_modulus_pa, poisson_ratio);
    return {lame.lambda_pa, lame.mu_pa, 0};
  }

  /// Sets p_c of an element that keeps no resistance to change of volume.
  static constexpr void resist_collapse(double* parameters) { parameters[2] = kCollapsePressure * parameters[1]; }

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
    const T gap = maximum(T(T(kCollapse) - invariants.j), T(0)) * T(1 / kCollapse);
    const T collapse = parameters[2] * gap * gap;
    w.energy += collapse * gap * T(kCollapse / 3);
    w.gradient[2] -= collapse;
    w.hessian(2, 2) = lambda + parameters[2] * gap * T(2 / kCollapse);
    return from_invariants(w, sigma, invariants);
  }

 private:
  // Measured with the demo's probe at 25 mm (docs/decisions/mesh.md).
  static constexpr double kCollapse = 0.4;
  static constexpr double kCollapsePressure = 100;  // p_c / μ
};

}  // namespace tensormass::physics
