#pragma once

#include "physics/decomposition.h"

/// Isotropic laws as functions of the principal stretches.
///
/// Why: in the axes of the stretches the stiffness falls apart into blocks with known eigenvalues, so each indefinite
/// part is mended exactly and alone. A law only writes down its energy ψ(σ) and derivatives; this file does the rest.
///
///   F ──signed_singular_values──► U, σ, V ──Derived::in_stretches──► ψ, ψ_i, ψ_ij, D, R ──► stress, stiffness
///
/// Symbols; planes are numbered by the axis k normal to them, and i ≠ j are the other two axes:
///
///   F = U diag(σ) Vᵀ      rotations U, V and principal stretches σ0 ≥ σ1 ≥ |σ2|
///   ψ(σ) = W(F)           energy density [J/m³]
///   ψ_i, ψ_ij             ∂ψ/∂σ_i and ∂²ψ/∂σ_i∂σ_j [Pa]
///   D_k                   (ψ_i − ψ_j) / (σ_i − σ_j): stiffness against a symmetric distortion in plane k [Pa]
///   R_k                   (ψ_i + ψ_j) / (σ_i + σ_j): stiffness against a rotation in plane k [Pa]
///
/// In the axes of U and V, where F' = diag(σ) (Ogden 1984; Stomakhin, Howes, Schroeder, Teran 2012):
///
///   P' = diag(ψ_i)      S = V diag(ψ_i / σ_i) Vᵀ
///   ∂P'_ii / ∂F'_jj = ψ_ij
///   ∂P'_ij / ∂F'_ij = (D + R) / 2,   ∂P'_ij / ∂F'_ji = (D − R) / 2,   i ≠ j
///
/// So the nine eigenvalues of ∂P/∂F are the three D, the three R and those of ψ_ij (Smith, de Goes, Kim 2019):
///
///           11 22 33   12 21   23 32   31 13
///          [   ψ_ij  |       |       |       ]    each 2 × 2 block  [ (D+R)/2  (D−R)/2 ]
///          [         | D2 R2 |       |       ]                      [ (D−R)/2  (D+R)/2 ]
///          [         |       | D0 R0 |       ]    has the eigenvalues D and R
///          [         |       |       | D1 R1 ]
namespace tensormass::physics {

/// ψ and its derivatives at a point.
template <class T>
struct StretchEnergy {
  T energy;            // ψ
  Vec3<T> gradient;    // ψ_i
  Mat3<T> hessian;     // ψ_ij
  Vec3<T> distortion;  // D of each plane
  Vec3<T> rotation;    // R of each plane
};

/// The Point of such a law: decomposed F and its energy.
template <class T>
struct StretchPoint {
  SignedSingularValues<T> f;
  StretchEnergy<T> w;
};

/// Base of a law that is given by its StretchEnergy. The law provides
///
///   template <class T> static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters);
///
/// which is called once for each point, with σ0 ≥ σ1 ≥ |σ2|. It must compute D and R in a form that does not cancel
/// where σ_i = ±σ_j.
///
/// A law whose stiffness has a shorter form may derive a Point of its own from StretchPoint. It then redefines `at`,
/// Node, project_to_psd and all functions that take a Node.
template <class Derived>
struct StretchLaw {
  static constexpr bool kConstantStiffness = false;

  template <class T>
  using Point = StretchPoint<T>;

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const SignedSingularValues<T>& deformation_gradient, const T* parameters) {
    return {deformation_gradient, Derived::in_stretches(deformation_gradient.sigma, parameters)};
  }
  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    return at(signed_singular_values(deformation_gradient), parameters);
  }

  template <class T>
  TM_HOST_DEVICE static T energy(const StretchPoint<T>& p) {
    return p.w.energy;
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const StretchPoint<T>& p) {
    return p.f.u * p.w.gradient.asDiagonal() * p.f.v.transpose();
  }

  /// Returns S. Where |σ| < kFlat it is scaled down to zero with σ: a collapsed element would otherwise leave
  /// viscoelastic internal variables that outweigh all later stress.
  template <class T>
  TM_HOST_DEVICE static Mat3<T> second_piola(const StretchPoint<T>& p) {
    const T least = T(kFlat * kFlat);
    Vec3<T> s;
    for (int i = 0; i < 3; ++i) {
      s[i] = p.w.gradient[i] * p.f.sigma[i] / maximum(T(p.f.sigma[i] * p.f.sigma[i]), least);
    }
    return p.f.v * s.asDiagonal() * p.f.v.transpose();
  }

  template <class T>
  struct Node {
    Vec3<T> gradient;  // Vᵀ a
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const StretchPoint<T>& p, const Vec3<T>& gradient) {
    return {p.f.v.transpose() * gradient};
  }

  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>& p, int axis) {
    return {p.f.v.row(axis).transpose()};
  }

  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const StretchPoint<T>& p, const Node<T>& a) {
    return p.f.u * p.w.gradient.cwiseProduct(a.gradient);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const StretchPoint<T>& p, const Node<T>& a, const Node<T>& b) {
    const Vec3<T> same = (p.w.distortion + p.w.rotation) * T(0.5), across = (p.w.distortion - p.w.rotation) * T(0.5);
    const Mat3<T> ab = a.gradient * b.gradient.transpose();
    Mat3<T> k;
    for (int i = 0; i < 3; ++i) {
      const int j = (i + 1) % 3, l = (i + 2) % 3;
      k(i, i) = p.w.hessian(i, i) * ab(i, i) + same[l] * ab(j, j) + same[j] * ab(l, l);
      k(j, l) = p.w.hessian(j, l) * ab(j, l) + across[i] * ab(l, j);
      k(l, j) = p.w.hessian(l, j) * ab(l, j) + across[i] * ab(j, l);
    }
    return p.f.u * k * p.f.u.transpose();
  }

  template <class T>
  TM_HOST_DEVICE static void project_to_psd(StretchPoint<T>& p) {
    p.w.hessian = with_absolute_eigenvalues(p.w.hessian);
    for (int i = 0; i < 3; ++i) {
      p.w.distortion[i] = absolute(p.w.distortion[i]);
      p.w.rotation[i] = absolute(p.w.rotation[i]);
    }
  }

 private:
  static constexpr double kFlat = 0.05;  // a principal stretch; unrelated to Law::kLeastStretch
};

/// W as a function of the invariants I1 = Σ σ_i², I2 = Σ_{i<j} σ_i² σ_j² and J = σ0 σ1 σ2, in this order.
template <class T>
struct InvariantEnergy {
  T energy;
  Vec3<T> gradient;  // ∂W / ∂I_a
  Mat3<T> hessian;   // ∂²W / ∂I_a ∂I_b
};

/// The invariants of F, from its principal stretches.
template <class T>
struct Invariants {
  Vec3<T> squares;  // σ_i²
  T i1, i2, j;

  TM_HOST_DEVICE explicit Invariants(const Vec3<T>& sigma)
      : squares(sigma.cwiseProduct(sigma)),
        i1(squares[0] + squares[1] + squares[2]),
        i2(squares[0] * squares[1] + squares[1] * squares[2] + squares[2] * squares[0]),
        j(sigma[0] * sigma[1] * sigma[2]) {}
};

/// Converts from invariants to principal stretches by the chain rule.
///
/// The quotients D and R of each invariant are polynomials, so nothing cancels:
///
///   D of I1 is 2, of I2 it is 2 (σ_k² − σ_i σ_j), of J it is −σ_k
///   R of I1 is 2, of I2 it is 2 (σ_k² + σ_i σ_j), of J it is +σ_k
template <class T>
TM_HOST_DEVICE StretchEnergy<T> from_invariants(const InvariantEnergy<T>& w, const Vec3<T>& sigma,
                                                const Invariants<T>& invariants) {
  StretchEnergy<T> out;
  out.energy = w.energy;
  const T two_w1 = w.gradient[0] + w.gradient[0], two_w2 = w.gradient[1] + w.gradient[1];
  Mat3<T> slope;  // [invariant, stretch] ∂I_a/∂σ_i
  for (int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    const T others = invariants.squares[j] + invariants.squares[k], product = sigma[j] * sigma[k];
    slope(0, i) = sigma[i] + sigma[i];
    slope(1, i) = slope(0, i) * others;
    slope(2, i) = product;
    // Terms in this order cancel without rounding at rest.
    out.gradient[i] = (slope(0, i) * w.gradient[0] + slope(1, i) * w.gradient[1]) + slope(2, i) * w.gradient[2];
    out.hessian(i, i) = two_w1 + two_w2 * others;
    out.hessian(j, k) = out.hessian(k, j) = T(2) * two_w2 * product + w.gradient[2] * sigma[i];
    const T shear = two_w1 + two_w2 * invariants.squares[i], mixed = two_w2 * product + w.gradient[2] * sigma[i];
    out.distortion[i] = shear - mixed;
    out.rotation[i] = shear + mixed;
  }
  out.hessian += slope.transpose() * w.hessian * slope;
  return out;
}

}  // namespace tensormass::physics
