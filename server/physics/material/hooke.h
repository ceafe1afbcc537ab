#pragma once

#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// Linear elasticity, W = λ/2 (tr ε)² + μ ε:ε with ε = sym(F) − I (Cotin, Delingette, Ayache 2000).
///
/// Valid for small strain and small rotation only: a rotated body sees spurious strain. Its stiffness does not depend
/// on F, so its tensors are assembled once.
struct Hooke {
  static constexpr const char* kName = "hooke";
  static constexpr bool kConstantStiffness = true;
  static constexpr int kParameterCount = kIsotropicParameters;

  template <class T>
  struct Point {
    Mat3<T> strain;
    T lambda, mu;
  };

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    const Mat3<T> symmetric = (deformation_gradient + deformation_gradient.transpose()) * T(0.5);
    return {symmetric - Mat3<T>::Identity(), parameters[0], parameters[1]};
  }

  /// [J/m³]
  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    const T trace = p.strain.trace();
    return T(0.5) * p.lambda * trace * trace + p.mu * p.strain.cwiseProduct(p.strain).sum();
  }

  /// First Piola-Kirchhoff stress P = ∂W/∂F [Pa].
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return p.strain * (T(2) * p.mu) + Mat3<T>::Identity() * (p.lambda * p.strain.trace());
  }

  /// a : ∂P/∂F : b, the 3×3 stiffness between two nodes with shape gradients a, b [Pa/m²].
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Vec3<T>& a, const Vec3<T>& b) {
    return (a * b.transpose()) * p.lambda + (b * a.transpose()) * p.mu + Mat3<T>::Identity() * (p.mu * a.dot(b));
  }

  /// Its stiffness is positive semi-definite as it is.
  template <class T>
  TM_HOST_DEVICE static void make_positive(Point<T>&) {}
};

}  // namespace tensormass::physics
