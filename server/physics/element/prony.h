#pragma once

#include "core/scalar.h"
#include "physics/decomposition.h"

/// Viscoelasticity on top of any law: Prony series. Stress relaxes after a change of strain, in up to kMaxPronyTerms
/// terms with a relaxation time each.
///
///   S⁰         second Piola-Kirchhoff stress of the law alone [Pa]
///   S          viscoelastic second Piola-Kirchhoff stress [Pa]
///   α_i, τ_i   relaxing fraction of the stress (no unit) and relaxation time [s] of term i
///   Γ_i        viscoelastic internal variable of term i, a symmetric stress [Pa]
///   g, H       instantaneous fraction of the stress within a step (no unit); what the past steps take off it [Pa]
///
/// The model (Schwartz et al. 2005; Marchesseau et al. 2010):
///
///   S = S⁰ − Σ Γ_i,   dΓ_i/dt = (α_i S⁰ − Γ_i) / τ_i
///
/// Implicit Euler over a step Δt:
///
///   Γ_i ← A_i S⁰ + B_i Γ_i,   A_i = α_i Δt / (Δt + τ_i),   B_i = τ_i / (Δt + τ_i)
///
/// Within a step the old Γ_i are constant. The stress is therefore
///
///   S = g S⁰ − H,   g = 1 − Σ A_i,   H = Σ B_i Γ_i
///
/// That is the law scaled by g, with a constant stress −H added. Its stiffness is g K plus a geometric term of −H.
///
/// The members `memory` and `instant` are H and g.
namespace tensormass::physics {

/// Largest number of terms of one law; a scene with more is refused.
inline constexpr int kMaxPronyTerms = 4;
/// Number of reals of a symmetric stress: xx yy zz yz xz xy.
inline constexpr int kSymmetricReals = 6;

/// A term: α_i and τ_i.
struct PronyTerm {
  double share = 0;
  double relaxation_time_s = 0;
  bool operator==(const PronyTerm&) const = default;
};

/// A_i and B_i of a step.
template <class Real>
struct PronyStep {
  Real gain, decay;
};
/// Returns A_i and B_i of a term for a step of dt_s.
template <class Real>
TM_HOST_DEVICE constexpr PronyStep<Real> prony_step(Real share, Real relaxation_time_s, Real dt_s) {
  return {share * dt_s / (dt_s + relaxation_time_s), relaxation_time_s / (dt_s + relaxation_time_s)};
}

/// Returns the symmetric matrix with the given six reals.
template <class T>
TM_HOST_DEVICE Mat3<T> symmetric(const T (&s)[kSymmetricReals]) {
  Mat3<T> m;
  m << s[0], s[5], s[4], s[5], s[1], s[3], s[4], s[3], s[2];
  return m;
}
/// Writes the six reals of a symmetric matrix.
template <class T>
TM_HOST_DEVICE void to_symmetric(const Mat3<T>& m, T (&s)[kSymmetricReals]) {
  s[0] = m(0, 0);
  s[1] = m(1, 1);
  s[2] = m(2, 2);
  s[3] = m(1, 2);
  s[4] = m(0, 2);
  s[5] = m(0, 1);
}

/// The viscoelastic part of a quadrature point within a step, from its internal variables.
template <class T>
struct Viscous {
  T instant;       // g
  Mat3<T> memory;  // H [Pa]

  /// Returns the first Piola-Kirchhoff stress g P⁰ − F H from the law's own stress P⁰ (`elastic`). A linear law does
  /// not distinguish first and second, so it subtracts H.
  template <class Law>
  TM_HOST_DEVICE Mat3<T> stress(const Mat3<T>& deformation_gradient, const Mat3<T>& elastic) const {
    if constexpr (Law::kConstantStiffness) return elastic * instant - memory;
    return elastic * instant - deformation_gradient * memory;
  }
  /// Returns what the internal variables take off the traction P a: F H a, or H a for a linear law.
  template <class Law>
  TM_HOST_DEVICE Vec3<T> relief(const Mat3<T>& deformation_gradient, const Vec3<T>& a) const {
    const Vec3<T> kept = memory * a;
    if constexpr (Law::kConstantStiffness) return kept;
    return deformation_gradient * kept;
  }
  /// Returns G of the geometric stiffness (a·G b) I: −H, or zero for a linear law. If `positive`, G is projected to
  /// positive semi-definite by Gershgorin's bound.
  template <class Law>
  TM_HOST_DEVICE Mat3<T> geometric(bool positive) const {
    if (Law::kConstantStiffness) return Mat3<T>::Zero();
    const Mat3<T> g = -memory;
    if (!positive) return g;
    return g - Mat3<T>::Identity() * minimum(gershgorin_lower_bound(g), T(0));
  }
};

}  // namespace tensormass::physics
