#pragma once

#include "physics/decomposition.h"
#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// W = λ/2 (tr E)² + μ E:E with the Green-Lagrange strain E = (FᵀF − I)/2 (Picinbono, Delingette, Ayache 2003).
///
/// Exact under rotation. It softens in strong compression: the uniaxial stress peaks at a stretch of 1/√3. It has no
/// resistance to inversion, so states beyond that are detected, not recovered.
struct StVenantKirchhoff : LameParameters {
  static constexpr const char* kName = "st_venant_kirchhoff";
  static constexpr Inversion kInversion = Inversion::kCaught;
  static constexpr double kLeastStretch = 0.577;  ///< 1/√3
  static constexpr bool kConstantStiffness = false;

  template <class T>
  struct Point {
    Mat3<T> deformation_gradient;  // F
    Mat3<T> left_cauchy_green;     // F Fᵀ
    Mat3<T> strain;                // E
    Mat3<T> second_piola;          // S = λ tr(E) I + 2 μ E
    Mat3<T> geometric_stress;      // S for the stiffness only; see project_to_psd
    T lambda, mu;
  };

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    Point<T> p;
    p.lambda = parameters[0];
    p.mu = parameters[1];
    p.deformation_gradient = deformation_gradient;
    p.left_cauchy_green.noalias() = deformation_gradient * deformation_gradient.transpose();
    Mat3<T> right_cauchy_green;
    right_cauchy_green.noalias() = deformation_gradient.transpose() * deformation_gradient;
    p.strain = (right_cauchy_green - Mat3<T>::Identity()) * T(0.5);
    p.second_piola = quadratic_stress(p.strain, p.lambda, p.mu);
    p.geometric_stress = p.second_piola;
    return p;
  }

  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    return quadratic_energy(p.strain, p.lambda, p.mu);
  }

  /// Returns P = F S.
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return p.deformation_gradient * p.second_piola;
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> second_piola(const Point<T>& p) {
    return p.second_piola;
  }

  template <class T>
  struct Node {
    Vec3<T> gradient;  // a
    Vec3<T> moved;     // F a
    Vec3<T> stress;    // S a
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>& p, const Vec3<T>& gradient) {
    return {gradient, p.deformation_gradient * gradient, p.geometric_stress * gradient};
  }

  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>& p, int axis) {
    return {Vec3<T>::Unit(axis), p.deformation_gradient.col(axis), p.geometric_stress.col(axis)};
  }

  /// Returns F S a.
  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    const Vec3<T> pulled = p.second_piola * a.gradient;
    return p.deformation_gradient * pulled;
  }

  /// Returns (a·S b) I + λ (Fa)(Fb)ᵀ + μ (Fb)(Fa)ᵀ + μ (a·b) F Fᵀ.
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Node<T>& a, const Node<T>& b) {
    const Vec3<T> dilated = a.moved * p.lambda, sheared = a.moved * p.mu;
    Mat3<T> block = p.left_cauchy_green * (p.mu * a.gradient.dot(b.gradient));
    block += dilated * b.moved.transpose();
    block += b.moved * sheared.transpose();
    block.diagonal().array() += a.stress.dot(b.gradient);
    return block;
  }

  /// Makes the geometric term (a·S b) I positive semi-definite; compression makes it indefinite, and conjugate
  /// gradients then fail.
  ///
  /// If Gershgorin's lower bound of S's eigenvalues is negative, S is shifted up by it. That needs no branch and no
  /// eigenvectors, and leaves tension unchanged. The shift only damps the approach to equilibrium.
  template <class T>
  TM_HOST_DEVICE static void project_to_psd(Point<T>& p) {
    p.geometric_stress -= Mat3<T>::Identity() * minimum(gershgorin_lower_bound(p.second_piola), T(0));
  }
};

}  // namespace tensormass::physics
