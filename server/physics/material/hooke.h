#pragma once

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"

namespace tensormass::physics {

/// Linear elasticity, W = λ/2 (tr ε)² + μ ε:ε with ε = sym(F) − I (Cotin, Delingette, Ayache 2000).
///
/// Valid for small strain and small rotation only: a rotated body shows spurious strain. The stiffness does not depend
/// on F, so its tensors are assembled once. The law does not distinguish stress measures: S and P are the same.
struct Hooke : LameParameters {
  static constexpr const char* kName = "hooke";
  static constexpr Inversion kInversion = Inversion::kOutOfRange;
  static constexpr bool kConstantStiffness = true;

  /// End of the range of validity: largest strain, and largest rotation [rad]. Beyond them, the neglected terms exceed
  /// half a percent or a tenth of the result. These terms are the squares of the strain, and the spurious strain θ²/2
  /// of a rotation by θ.
  static constexpr double kMaxStrain = 0.05;
  static constexpr double kMaxRotation = 0.1;

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

  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    return quadratic_energy(p.strain, p.lambda, p.mu);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return quadratic_stress(p.strain, p.lambda, p.mu);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> second_piola(const Point<T>& p) {
    return stress(p);
  }

  template <class T>
  struct Node {
    Vec3<T> gradient;
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>&, const Vec3<T>& gradient) {
    return {gradient};
  }

  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>&, int axis) {
    return {Vec3<T>::Unit(axis)};
  }

  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    return stress(p) * a.gradient;
  }

  /// Returns λ a bᵀ + μ b aᵀ + μ (a·b) I.
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Node<T>& at_a, const Node<T>& at_b) {
    const Vec3<T>&a = at_a.gradient, &b = at_b.gradient;
    return (a * b.transpose()) * p.lambda + (b * a.transpose()) * p.mu + Mat3<T>::Identity() * (p.mu * a.dot(b));
  }

  /// Does nothing: the stiffness is positive semi-definite already.
  template <class T>
  TM_HOST_DEVICE static void project_to_psd(Point<T>&) {}
};

}  // namespace tensormass::physics
