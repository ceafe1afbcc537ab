#pragma once

#include <cmath>
#include <vector>

#include <Eigen/LU>

#include "physics/element/quadrature.h"

/// An element at rest, evaluated on the host in double precision when a scene is compiled. Positive volume is the
/// caller's to check.
namespace tensormass::physics {

/// Of one quadrature point, what the element pass reads: the gradients of nodes 1 to Nodes − 1 (node 0 has minus their
/// sum) [1/m] and the weight [m³].
template <class Shape>
inline constexpr int kRestReals = 3 * (Shape::kNodes - 1) + 1;

/// Of one quadrature point, for all elements of a group: the share of the deviatoric and of the volumetric moduli that
/// it integrates (see Quadrature::kSelective).
struct ModuliWeights {
  double deviatoric = 1, volumetric = 1;
};

template <class Shape>
std::vector<ModuliWeights> moduli_weights(Quadrature quadrature) {
  const std::size_t full = Shape::full_rule().size();
  if (full == 1 || quadrature == Quadrature::kReduced) return {{1, 1}};
  if (quadrature == Quadrature::kFull) return std::vector<ModuliWeights>(full, {1, 1});
  std::vector<ModuliWeights> shares(full, {1, 0});
  shares.push_back({0, 1});
  return shares;
}

/// Jacobian ∂x/∂r at a point of the reference shape.
template <class Shape>
Mat3<double> jacobian(const Vec3<double> (&x)[Shape::kNodes], const Vec3<double> (&dn)[Shape::kNodes]) {
  Mat3<double> j = Mat3<double>::Zero();
  for (int k = 0; k < Shape::kNodes; ++k) j += x[k] * dn[k].transpose();
  return j;
}

/// ∂N_k/∂r at the points of the full rule, [point][node][3]: of the reference shape, and so the same for all elements.
template <class Shape>
std::vector<double> reference_gradients() {
  std::vector<double> out;
  for (const QuadraturePoint& point : Shape::full_rule()) {
    Vec3<double> dn[Shape::kNodes];
    Shape::gradients(point.at, dn);
    for (const Vec3<double>& gradient : dn) out.insert(out.end(), gradient.begin(), gradient.end());
  }
  return out;
}

/// [point][kRestReals], the points as moduli_weights counts them.
template <class Shape>
std::vector<std::array<double, kRestReals<Shape>>> rest_points(const Vec3<double> (&x)[Shape::kNodes],
                                                               Quadrature quadrature) {
  using Gradients = Eigen::Matrix<double, 3, Shape::kNodes>;
  std::vector<std::array<double, kRestReals<Shape>>> out;
  const auto add = [&](const Gradients& a, double weight) {
    auto& rest = out.emplace_back();
    for (int k = 1; k < Shape::kNodes; ++k) {
      for (int c = 0; c < 3; ++c) rest[static_cast<std::size_t>(3 * (k - 1) + c)] = a(c, k);
    }
    rest.back() = weight;
  };
  static const QuadratureRule rule = Shape::full_rule();
  Gradients mean = Gradients::Zero();
  double volume = 0;
  for (const QuadraturePoint& point : rule) {
    Vec3<double> dn[Shape::kNodes];
    Shape::gradients(point.at, dn);
    const Mat3<double> j = jacobian<Shape>(x, dn);
    const double weight = point.weight * j.determinant();
    const Mat3<double> inverse = j.inverse().transpose();
    Gradients a;
    for (int k = 0; k < Shape::kNodes; ++k) a.col(k) = inverse * dn[k];
    mean += weight * a;
    volume += weight;
    if (rule.size() == 1 || quadrature != Quadrature::kReduced) add(a, weight);
  }
  if (rule.size() > 1 && quadrature != Quadrature::kFull) add(mean / volume, volume);
  return out;
}

/// ∫ N_k N_l dV [m³], exact for straight-sided elements.
template <class Shape>
Eigen::Matrix<double, Shape::kNodes, Shape::kNodes> mass_integrals(const Vec3<double> (&x)[Shape::kNodes]) {
  static const QuadratureRule rule = Shape::mass_rule();
  Eigen::Matrix<double, Shape::kNodes, Shape::kNodes> out;
  out.setZero();
  for (const QuadraturePoint& point : rule) {
    Eigen::Matrix<double, Shape::kNodes, 1> n;
    Vec3<double> dn[Shape::kNodes];
    double values[Shape::kNodes];
    Shape::values(point.at, values);
    Shape::gradients(point.at, dn);
    for (int k = 0; k < Shape::kNodes; ++k) n[k] = values[k];
    out += n * n.transpose() * (point.weight * jacobian<Shape>(x, dn).determinant());
  }
  return out;
}

/// Volume that each node carries [m³]: row sums where they are positive by nature (first order); for second order,
/// whose corners would get negative masses, in proportion to the diagonal (Hinton, Rock, Zienkiewicz 1976).
template <class Shape>
std::array<double, Shape::kNodes> lumped_volumes(const Vec3<double> (&x)[Shape::kNodes]) {
  std::array<double, Shape::kNodes> out;
  if constexpr (Shape::kSinglePoint) {
    const double six_volumes = (x[1] - x[0]).dot((x[2] - x[0]).cross(x[3] - x[0]));
    out.fill(six_volumes / 24);
    return out;
  }
  const auto mass = mass_integrals<Shape>(x);
  const bool second_order = Shape::kOrder == 2;
  const double share = second_order ? mass.sum() / mass.trace() : 1;
  for (int k = 0; k < Shape::kNodes; ++k) {
    out[static_cast<std::size_t>(k)] = second_order ? share * mass(k, k) : mass.row(k).sum();
  }
  return out;
}

}  // namespace tensormass::physics
