#pragma once

#include <array>

#include "physics/material/inversion.h"
#include "physics/material/st_venant_kirchhoff.h"

namespace tensormass::physics {

/// St-Venant-Kirchhoff's law with fibres along a0: W += (Δλ/2 + Δμ) (a0·E a0)² (Picinbono, Delingette, Ayache 2003).
///
/// Fibres resist compression as they resist tension. Range and limits are those of St-Venant-Kirchhoff's law. In this
/// file "matrix" is the isotropic ground substance, not an array of numbers.
struct TransverselyIsotropic {
  static constexpr const char* kName = "transversely_isotropic";
  static constexpr Inversion kInversion = Inversion::kCaught;
  static constexpr double kLeastStretch = StVenantKirchhoff::kLeastStretch;
  static constexpr bool kConstantStiffness = false;
  static constexpr int kParameterCount = 6;  // λ, μ, Δλ/2 + Δμ [Pa], a0

  using Matrix = StVenantKirchhoff;

  /// fibre_modulus_pa: Δλ + 2 Δμ ≥ 0. fibre_direction: any length but zero.
  static std::array<double, kParameterCount> parameters(double young_modulus_pa, double poisson_ratio,
                                                        double fibre_modulus_pa, const Vec3<double>& fibre_direction) {
    const auto matrix = Matrix::parameters(young_modulus_pa, poisson_ratio);
    const Vec3<double> a0 = fibre_direction / fibre_direction.norm();
    return {matrix[0], matrix[1], fibre_modulus_pa / 2, a0[0], a0[1], a0[2]};
  }
  static constexpr Moduli moduli_at_rest(const double* parameters) { return Matrix::moduli_at_rest(parameters); }

  /// Scales the matrix's moduli; fibres count as deviatoric.
  template <class T>
  TM_HOST_DEVICE static void scale_moduli(T* parameters, T deviatoric, T volumetric) {
    Matrix::scale_moduli(parameters, deviatoric, volumetric);
    parameters[2] *= deviatoric;
  }

  template <class T>
  struct Point {
    Matrix::Point<T> matrix;
    Vec3<T> fibre;        // a0
    Vec3<T> moved_fibre;  // F a0
    T stiffness;          // 2 (Δλ/2 + Δμ)
    T tension;            // 2 (Δλ/2 + Δμ) a0·E a0, the second Piola-Kirchhoff stress along the fibre
    T geometric_tension;  // tension for the stiffness only; see project_to_psd
  };

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    Point<T> p;
    p.matrix = Matrix::at(deformation_gradient, parameters);
    p.fibre = Vec3<T>(parameters[3], parameters[4], parameters[5]);
    p.moved_fibre = deformation_gradient * p.fibre;
    p.stiffness = parameters[2] + parameters[2];
    p.tension = p.stiffness * p.fibre.dot(p.matrix.strain * p.fibre);
    p.geometric_tension = p.tension;
    return p;
  }

  template <class T>
  TM_HOST_DEVICE static T energy(const Point<T>& p) {
    return Matrix::energy(p.matrix) + T(0.5) * p.tension * p.fibre.dot(p.matrix.strain * p.fibre);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stress(const Point<T>& p) {
    return Matrix::stress(p.matrix) + p.moved_fibre * (p.fibre * p.tension).transpose();
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> second_piola(const Point<T>& p) {
    return p.matrix.second_piola + p.fibre * (p.fibre * p.tension).transpose();
  }

  template <class T>
  struct Node {
    Matrix::Node<T> matrix;
    T along;  // a0·a
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>& p, const Vec3<T>& gradient) {
    return {Matrix::at_node(p.matrix, gradient), p.fibre.dot(gradient)};
  }

  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>& p, int axis) {
    return {Matrix::at_axis(p.matrix, axis), p.fibre[axis]};
  }

  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    return Matrix::traction(p.matrix, a.matrix) + p.moved_fibre * (p.tension * a.along);
  }

  /// Returns the matrix's stiffness + (a0·a) (a0·b) (2 (Δλ/2 + Δμ) (Fa0)(Fa0)ᵀ + tension I).
  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Node<T>& a, const Node<T>& b) {
    const T along = a.along * b.along;
    return Matrix::stiffness(p.matrix, a.matrix, b.matrix) +
           p.moved_fibre * (p.moved_fibre * (p.stiffness * along)).transpose() +
           Mat3<T>::Identity() * (p.geometric_tension * along);
  }

  /// Projects the matrix. A compressed fibre, which would buckle, loses its geometric term.
  template <class T>
  TM_HOST_DEVICE static void project_to_psd(Point<T>& p) {
    Matrix::project_to_psd(p.matrix);
    p.geometric_tension = maximum(p.tension, T(0));
  }
};

}  // namespace tensormass::physics
