#pragma once

#include <Eigen/Geometry>

#include "physics/material/inversion.h"
#include "physics/material/isotropic.h"
#include "physics/material/stretch_law.h"

namespace tensormass::physics {

/// Hooke's law for the stretch, W = μ |S − I|² + λ/2 (tr S − 3)², where F = Q S with Q a rotation (Müller, Gross 2004;
/// exact stiffness by Chao, Pinkall, Sanan, Schröder 2010). S is the stretch here, not a stress. Any ν in (−1, 0.5).
///
/// Exact under rotation. The stress is linear in the stretches, so the law is soft in strong compression and stays
/// finite in collapse. It recovers from inversion, because S keeps the sign of the smallest stretch. Resistance to
/// change of volume is of first order only. Where two stretches add up to zero, Q is not unique and the stress jumps;
/// the stiffness against rotation is bounded there.
///
/// Why its own stiffness: with the symbols of stretch_law.h, all D are 2 μ and ψ_ij is 2 μ δ_ij + λ. Only the term for
/// rotations (R − D) therefore needs the axes of U:
///
///   K = 2 μ (a'·b') I + λ a' b'ᵀ + [a']× H [b']×ᵀ,   H = Σ_k (R_k − D_k)/2 u_k u_kᵀ
///
///   Q = U Vᵀ      the rotation of F
///   a', b'        Q a and Q b: shape gradients of two nodes, rotated with the element
///   [a']×         the matrix with [a']× x = a' × x
///   u_k           columns of U; D_k and R_k belong to the plane normal to u_k
struct Corotational : StretchLaw<Corotational>, LameParameters {
  static constexpr const char* kName = "corotational";
  static constexpr Inversion kInversion = Inversion::kRecovers;

  template <class T>
  TM_HOST_DEVICE static StretchEnergy<T> in_stretches(const Vec3<T>& sigma, const T* parameters) {
    const T lambda = parameters[0], two_mu = parameters[1] + parameters[1];
    const Vec3<T> strain = sigma - Vec3<T>::Ones();
    const T pressure = lambda * strain.sum();
    StretchEnergy<T> w;
    w.energy = T(0.5) * (two_mu * strain.squaredNorm() + pressure * strain.sum());
    w.gradient = strain * two_mu + Vec3<T>::Constant(pressure);
    w.hessian = Mat3<T>::Identity() * two_mu + Mat3<T>::Constant(lambda);
    for (int i = 0; i < 3; ++i) {
      const T sum = sigma[(i + 1) % 3] + sigma[(i + 2) % 3];
      w.distortion[i] = two_mu;
      w.rotation[i] = two_mu + T(2) * (pressure - two_mu) / maximum(sum, T(kLeastSum));
    }
    return w;
  }

  /// A stretch point with the rotation of F and the matrix H.
  template <class T>
  struct Point : StretchPoint<T> {
    Mat3<T> turn;   // Q = U Vᵀ
    Mat3<T> twist;  // H

    Point() = default;
    TM_HOST_DEVICE explicit Point(const StretchPoint<T>& of)
        : StretchPoint<T>(of), turn(of.f.u * of.f.v.transpose()), twist(twist_of(of)) {}
  };

  template <class T>
  TM_HOST_DEVICE static Point<T> at(const SignedSingularValues<T>& deformation_gradient, const T* parameters) {
    return Point<T>(StretchLaw<Corotational>::at(deformation_gradient, parameters));
  }
  template <class T>
  TM_HOST_DEVICE static Point<T> at(const Mat3<T>& deformation_gradient, const T* parameters) {
    return Point<T>(StretchLaw<Corotational>::at(deformation_gradient, parameters));
  }

  template <class T>
  struct Node {
    Vec3<T> turned;   // a' = Q a
    Mat3<T> twisted;  // [a']× H
  };

  template <class T>
  TM_HOST_DEVICE static Node<T> at_node(const Point<T>& p, const Vec3<T>& gradient) {
    return turned_to<T>(p, p.turn * gradient);
  }
  template <class T>
  TM_HOST_DEVICE static Node<T> at_axis(const Point<T>& p, int axis) {
    return turned_to<T>(p, p.turn.col(axis));
  }

  template <class T>
  TM_HOST_DEVICE static Vec3<T> traction(const Point<T>& p, const Node<T>& a) {
    return p.f.u * p.w.gradient.cwiseProduct(p.f.u.transpose() * a.turned);
  }

  template <class T>
  TM_HOST_DEVICE static Mat3<T> stiffness(const Point<T>& p, const Node<T>& a, const Node<T>& b) {
    const Vec3<T>& y = b.turned;
    const T two_mu = p.w.distortion[0], lambda = p.w.hessian(0, 1);
    Mat3<T> k = (a.turned * lambda) * y.transpose();
    k.diagonal().array() += two_mu * a.turned.dot(y);
    for (int c = 0; c < 3; ++c) {  // + M [y]×ᵀ with M = [a']× H
      const int i = (c + 1) % 3, j = (c + 2) % 3;
      k.col(c) += a.twisted.col(j) * y[i] - a.twisted.col(i) * y[j];
    }
    return k;
  }

  /// Takes R absolutely. The rest is positive already: D and the eigenvalues of ψ_ij are, for every ν.
  template <class T>
  TM_HOST_DEVICE static void project_to_psd(Point<T>& p) {
    for (int i = 0; i < 3; ++i) p.w.rotation[i] = absolute(p.w.rotation[i]);
    p.twist = twist_of(p);
  }

 private:
  /// Smallest sum of two stretches that R divides by; bounds the stiffness where Q is not unique.
  static constexpr double kLeastSum = 0.01;

  template <class T>
  TM_HOST_DEVICE static Node<T> turned_to(const Point<T>& p, const Vec3<T>& turned) {
    Node<T> node{turned, {}};
    for (int c = 0; c < 3; ++c) node.twisted.col(c) = turned.cross(p.twist.col(c));
    return node;
  }
  template <class T>
  TM_HOST_DEVICE static Mat3<T> twist_of(const StretchPoint<T>& p) {
    const Vec3<T> share = (p.w.rotation - p.w.distortion) * T(0.5);
    return p.f.u * share.asDiagonal() * p.f.u.transpose();
  }
};

}  // namespace tensormass::physics
