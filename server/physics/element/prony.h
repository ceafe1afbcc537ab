#pragma once

#include "core/scalar.h"
#include "physics/decomposition.h"

/// Visco-elasticity on top of any law: the stress remembers. With S⁰ the law's second Piola-Kirchhoff stress,
///
///   S = S⁰ − Σ Γ_i,   dΓ_i/dt = (α_i S⁰ − Γ_i) / τ_i
///
/// and implicit Euler over a step, Γ_i ← A_i S⁰ + B_i Γ_i with A_i = α_i Δt / (Δt + τ_i), B_i = τ_i / (Δt + τ_i)
/// (Schwartz et al. 2005; Marchesseau et al. 2010). Within a step the old Γ_i stand still, so that
///
///   S = g S⁰ − H,   g = 1 − Σ A_i,   H = Σ B_i Γ_i
///
/// is the law scaled by g with a constant stress in addition: its tensors are g K and a geometric term of −H.
namespace tensormass::physics {

/// Terms of one law; a scene with more is refused.
inline constexpr int kMaxPronyTerms = 4;
/// Reals of a symmetric stress in a history: xx yy zz yz xz xy.
inline constexpr int kSymmetricReals = 6;

/// A term: α_i, τ_i.
struct PronyTerm {
  double share = 0;
  double relaxation_time_s = 0;
  bool operator==(const PronyTerm&) const = default;
};

/// A_i, B_i of a step.
template <class Real>
struct PronyStep {
  Real gain, decay;
};
template <class Real>
TM_HOST_DEVICE constexpr PronyStep<Real> prony_step(Real share, Real relaxation_time_s, Real dt_s) {
  return {share * dt_s / (dt_s + relaxation_time_s), relaxation_time_s / (dt_s + relaxation_time_s)};
}

template <class T>
TM_HOST_DEVICE Mat3<T> symmetric(const T (&s)[kSymmetricReals]) {
  Mat3<T> m;
  m << s[0], s[5], s[4], s[5], s[1], s[3], s[4], s[3], s[2];
  return m;
}
template <class T>
TM_HOST_DEVICE void to_symmetric(const Mat3<T>& m, T (&s)[kSymmetricReals]) {
  s[0] = m(0, 0);
  s[1] = m(1, 1);
  s[2] = m(2, 2);
  s[3] = m(1, 2);
  s[4] = m(0, 2);
  s[5] = m(0, 1);
}

/// What a point's history does to it within a step.
template <class T>
struct Viscous {
  T instant;       // g
  Mat3<T> memory;  // H [Pa]

  /// First Piola-Kirchhoff stress from the law's own, `elastic`. A linear law does not tell the two apart.
  template <class Law>
  TM_HOST_DEVICE Mat3<T> stress(const Mat3<T>& deformation_gradient, const Mat3<T>& elastic) const {
    if constexpr (Law::kConstantStiffness) return elastic * instant - memory;
    return elastic * instant - deformation_gradient * memory;
  }
  /// What the memory takes off P a.
  template <class Law>
  TM_HOST_DEVICE Vec3<T> relief(const Mat3<T>& deformation_gradient, const Vec3<T>& a) const {
    const Vec3<T> kept = memory * a;
    if constexpr (Law::kConstantStiffness) return kept;
    return deformation_gradient * kept;
  }
  /// G of the geometric term (a·G b) I.
  template <class Law>
  TM_HOST_DEVICE Mat3<T> geometric(bool positive) const {
    if (Law::kConstantStiffness) return Mat3<T>::Zero();
    const Mat3<T> g = -memory;
    if (!positive) return g;
    return g - Mat3<T>::Identity() * minimum(gershgorin_lower_bound(g), T(0));
  }
};

}  // namespace tensormass::physics
