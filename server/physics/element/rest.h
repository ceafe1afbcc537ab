#pragma once

#include <cmath>
#include <span>
#include <vector>

#include <Eigen/LU>

#include "core/assert.h"
#include "physics/element/quadrature.h"

/// The rest shape of one element as the element pass needs it: shape gradients and weights of its quadrature points,
/// and its masses. Evaluated on the host in double precision when a scene is compiled.
///
///   N_k, dn_k        shape function of node k, and ∂N_k/∂r
///   r, x             point of the reference shape; its position at rest [m]
///   j                Jacobian ∂x/∂r at rest [m]
///   a_k              shape gradient ∇N_k at rest [1/m]
///
/// All functions need an element with a positive Jacobian; the caller checks it (mesh/admission.h).
///
/// Selective reduced integration evaluates the deviatoric energy at all points, and the volumetric energy at one more
/// point with the mean gradients. It is data, not code: each point has weights for the two kinds of moduli.
///
///   quadrature     points of a shape with n > 1 points        ModuliWeights {deviatoric, volumetric}
///   kFull          n points of the full rule                  {1, 1} each
///   kReduced       1 point with the mean gradients            {1, 1}
///   kSelective     n points, then 1 with mean gradients       {1, 0} each, then {0, 1}
///
/// One point sees too little of a shape that has many nodes. Such a shape states a reduced rule. Its m points, all with
/// the same share of their weights, are the first ones of the full rule. Then
///
///   kReduced       m points of the reduced rule               {1, 1} each
///   kSelective     n points of the full rule                  {1, reduced weight / full weight} at m, {1, 0} at others
namespace tensormass::physics {

/// Number of reals of a quadrature point: the gradients of nodes 1 to Nodes − 1 [1/m], then the weight [m³]. The
/// gradient of node 0 is minus the sum of the others, so it is not stored.
template <class Shape>
inline constexpr int kRestReals = 3 * (Shape::kNodes - 1) + 1;

/// Selective reduced integration weights of a quadrature point: factors of the deviatoric and of the volumetric moduli
/// there (see Quadrature::kSelective). They are the same for all elements of a group.
struct ModuliWeights {
  double deviatoric = 1, volumetric = 1;
};

/// Whether a shape has a reduced rule of its own.
template <class Shape>
inline constexpr bool kHasReducedRule = requires {
  Shape::reduced_rule();
};

namespace detail {

/// Returns the weights of the points of a shape that has a reduced rule.
inline std::vector<ModuliWeights> moduli_weights(Quadrature quadrature, const QuadratureRule& full,
                                                 const QuadratureRule& reduced) {
  if (quadrature == Quadrature::kReduced) return std::vector<ModuliWeights>(reduced.size());
  std::vector<ModuliWeights> shares(full.size());
  for (std::size_t q = 0; quadrature == Quadrature::kSelective && q < full.size(); ++q) {
    TM_ASSERT(q >= reduced.size() || full[q].at == reduced[q].at, "the full rule begins with the reduced one");
    shares[q].volumetric = q < reduced.size() ? reduced[q].weight / full[q].weight : 0;
  }
  return shares;
}

}  // namespace detail

/// Returns the weights of each quadrature point, in the order of the tables above.
template <class Shape>
std::vector<ModuliWeights> moduli_weights(Quadrature quadrature) {
  if constexpr (kHasReducedRule<Shape>) {
    return detail::moduli_weights(quadrature, Shape::full_rule(), Shape::reduced_rule());
  }
  const std::size_t full = Shape::full_rule().size();
  if (full == 1 || quadrature == Quadrature::kReduced) return {{1, 1}};
  if (quadrature == Quadrature::kFull) return std::vector<ModuliWeights>(full, {1, 1});
  std::vector<ModuliWeights> shares(full, {1, 0});
  shares.push_back({0, 1});
  return shares;
}

/// Returns the Jacobian ∂x/∂r at a point of the reference shape, from the gradients dn there.
template <class Shape>
Mat3<double> jacobian(const Vec3<double> (&x)[Shape::kNodes], const Vec3<double> (&dn)[Shape::kNodes]) {
  Mat3<double> j = Mat3<double>::Zero();
  for (int k = 0; k < Shape::kNodes; ++k) j += x[k] * dn[k].transpose();
  return j;
}

/// Returns ∂N_k/∂r at the points of the full rule, [point][node][3]. They belong to the reference shape, so all
/// elements share them.
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

namespace detail {

/// Gradients a_k [1/m] and weight [m³] of a quadrature point.
template <class Shape>
struct RestPoint {
  using Gradients = Eigen::Matrix<double, 3, Shape::kNodes>;
  Gradients a;
  double weight;

  RestPoint(const Vec3<double> (&x)[Shape::kNodes], const QuadraturePoint& point) {
    Vec3<double> dn[Shape::kNodes];
    Shape::gradients(point.at, dn);
    const Mat3<double> j = jacobian<Shape>(x, dn);
    weight = point.weight * j.determinant();
    const Mat3<double> inverse = j.inverse().transpose();
    for (int k = 0; k < Shape::kNodes; ++k) a.col(k) = inverse * dn[k];
  }
  RestPoint(const Gradients& gradients, double volume) : a(gradients), weight(volume) {}
};
template <class Shape>
using RestPoints = std::vector<RestPoint<Shape>>;

/// Returns one point that has the volume of some points and their mean gradients.
template <class Shape>
RestPoint<Shape> mean_point(std::span<const RestPoint<Shape>> points) {
  RestPoint<Shape> mean{RestPoint<Shape>::Gradients::Zero(), 0};
  for (const RestPoint<Shape>& point : points) {
    mean.a += point.weight * point.a;
    mean.weight += point.weight;
  }
  mean.a /= mean.weight;
  return mean;
}

template <class Shape>
RestPoints<Shape> points_of_rule(const Vec3<double> (&x)[Shape::kNodes], const QuadratureRule& rule) {
  RestPoints<Shape> points;
  for (const QuadraturePoint& point : rule) points.emplace_back(x, point);
  return points;
}

/// Replaces the points that the full rule has beyond the reduced one. They get the volume and the mean gradients of the
/// reduced rule, each in their share. The patch test then holds for the full rule where it holds for the reduced one,
/// whatever degree the full one has.
/// share: of the reduced rule in the full one.
template <class Shape>
void balance(const RestPoint<Shape>& mean_of_reduced, double share, std::span<RestPoint<Shape>> others) {
  const RestPoint<Shape> mean = mean_point<Shape>(others);
  for (RestPoint<Shape>& point : others) {
    point.a += mean_of_reduced.a - mean.a;
    point.weight *= (1 - share) * mean_of_reduced.weight / mean.weight;
  }
}

}  // namespace detail

/// Returns [point][kRestReals] gradients and weight of each point, in the order of moduli_weights.
template <class Shape>
std::vector<std::array<double, kRestReals<Shape>>> rest_points(const Vec3<double> (&x)[Shape::kNodes],
                                                               Quadrature quadrature) {
  static const QuadratureRule full = Shape::full_rule();
  detail::RestPoints<Shape> points;
  if constexpr (kHasReducedRule<Shape>) {
    static const QuadratureRule reduced = Shape::reduced_rule();
    points = detail::points_of_rule<Shape>(x, reduced);
    if (quadrature != Quadrature::kReduced) {
      const double share = full.front().weight / reduced.front().weight;
      const detail::RestPoint<Shape> mean = detail::mean_point<Shape>(points);
      for (detail::RestPoint<Shape>& point : points) point.weight *= share;
      for (std::size_t q = reduced.size(); q < full.size(); ++q) points.emplace_back(x, full[q]);
      detail::balance<Shape>(mean, share, std::span(points).subspan(reduced.size()));
    }
  } else {
    points = detail::points_of_rule<Shape>(x, full);
    const detail::RestPoint<Shape> mean = detail::mean_point<Shape>(points);
    if (full.size() > 1 && quadrature == Quadrature::kReduced) points.clear();
    if (full.size() > 1 && quadrature != Quadrature::kFull) points.push_back(mean);
  }
  std::vector<std::array<double, kRestReals<Shape>>> out;
  out.reserve(points.size());
  for (const detail::RestPoint<Shape>& point : points) {
    auto& rest = out.emplace_back();
    for (int k = 1; k < Shape::kNodes; ++k) {
      for (int c = 0; c < 3; ++c) rest[static_cast<std::size_t>(3 * (k - 1) + c)] = point.a(c, k);
    }
    rest.back() = point.weight;
  }
  return out;
}

/// Returns ∫ N_k N_l dV [m³], the mass matrix for a density of one. Exact for straight-sided elements.
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

/// Returns the volume that each node carries [m³], for lumped masses.
///
/// First-order shapes take row sums of the mass matrix, which are positive. Second-order shapes would get negative
/// masses at the corners, so they distribute the volume in proportion to the diagonal (Hinton, Rock, Zienkiewicz 1976).
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
