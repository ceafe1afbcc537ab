#pragma once

#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// W = λ/2 (tr E)² + μ E:E with the Green-Lagrange strain E = (FᵀF − I)/2 (Picinbono, Delingette, Ayache 2003).
///
/// Exact under rotation. It softens under strong compression (in uniaxial compression its stress peaks at a stretch of
/// 1/√3) and has no resistance to inversion: states beyond that are caught, not recovered.
struct StVenantKirchhoff {
  static constexpr const char* kName = "st_venant_kirchhoff";
  static constexpr bool kConstantStiffness = false;
  static constexpr int kParameterCount = kIsotropicParameters;

  template <class T>
  struct Point {
    Mat3<T> deformation_gradient;  // F
    Mat3<T> left_cauchy_green;     // F Fᵀ
    Mat3<T> strain;                // E
    Mat3<T> second_piola;          // S = λ tr(E) I + 2 μ E
    Mat3<T> geometric_stress;      // S as the stiffness uses it; see make_positive
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
    p.second_piola = p.strain * (T(2) * p.mu) + Mat3<T>::Identity() * (p.lambda * p.strain.trace());
    p.geometric_stress = p.second_piola;
    return p;
  }

  /// [J/m³]
  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    const T trace = p.strain.trace();
    return T(0.5) * p.lambda * trace * trace + p.mu * p.strain.cwiseProduct(p.strain).sum();
  }

  /// First Piola-Kirchhoff stress P = F S [Pa].
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return p.deformation_gradient * p.second_piola;
  }

  /// a : ∂P/∂F : b = (a·S b) I + λ (Fa)(Fb)ᵀ + μ (Fb)(Fa)ᵀ + μ (a·b) F Fᵀ [Pa/m²].
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Vec3<T>& a, const Vec3<T>& b) {
    const Vec3<T> fa = p.deformation_gradient * a;
    const Vec3<T> fb = p.deformation_gradient * b;
    const Vec3<T> sb = p.geometric_stress * b;
    return (fa * fb.transpose()) * p.lambda + (fb * fa.transpose()) * p.mu + p.left_cauchy_green * (p.mu * a.dot(b)) +
           Mat3<T>::Identity() * a.dot(sb);
  }

  /// Compression makes the geometric term (a·S b) I indefinite, which conjugate gradients cannot take. It is shifted
  /// by Gershgorin's lower bound of S's eigenvalues where that is negative: positive semi-definite, no branch, no
  /// eigenvectors, and unchanged in tension. The forces stay exact; the shift only damps the approach to them.
  template <class T>
  TM_HOST_DEVICE static void make_positive(Point<T>& p) {
    const Mat3<T>& s = p.second_piola;
    const T xy = absolute(s(0, 1)), yz = absolute(s(1, 2)), zx = absolute(s(2, 0));
    const T bound = minimum(minimum(T(s(0, 0) - xy - zx), T(s(1, 1) - xy - yz)), minimum(T(s(2, 2) - yz - zx), T(0)));
    p.geometric_stress = s - Mat3<T>::Identity() * bound;
  }
};

}  // namespace tensormass::physics
