#pragma once

#include <algorithm>
#include <array>
#include <type_traits>
#include <vector>

#include "core/scalar.h"
#include "physics/element/prony.h"
#include "physics/element/rest.h"

/// Any law in any shape: displacements to forces and stiffness tensors.
///
///   F = I + Σ_k U_k ⊗ a_k      f_k = −Σ_q w_q P(F) a_k      K_kl = Σ_q w_q a_k : ∂P/∂F : a_l
///
/// with a_k = ∇N_k at rest and U_k the displacement of node k (Faure, Zara, Jaillet, Moreau 2012; for one quadrature
/// point and Hooke's law this is Cotin's tensor). The gradients sum to zero, so K_kk = −Σ_l K_kl: only the edge tensors
/// are computed and stored, and a node's vertex tensor is minus the sum of its edges.
///
/// A shape enters by its number of nodes only; what else it is, rest.h has put into gradients and weights.
namespace tensormass::physics {

/// Index of K_kl, k < l, among the pairs of an element with `nodes` nodes: rows of the upper triangle one by one.
TM_HOST_DEVICE constexpr int pair_index(int nodes, int k, int l) { return k * (2 * nodes - k - 1) / 2 + l - k - 1; }

template <int Nodes>
inline constexpr int kPairs = Nodes*(Nodes - 1) / 2;

template <class Shape, class T>
struct ElementTensors {
  Vec3<T> force[Shape::kNodes];                   // f_k [N]
  Mat3<T> edge_stiffness[kPairs<Shape::kNodes>];  // K_kl, k < l [N/m]; K_lk is its transpose

  /// What add_point writes to: the first contribution is assigned, so that nothing need be zero before.
  TM_HOST_DEVICE void add_force(int k, const Vec3<T>& f, bool first) { force[k] = first ? f : Vec3<T>(force[k] + f); }
  TM_HOST_DEVICE void add_edge(int pair, const Mat3<T>& block, bool first) {
    edge_stiffness[pair] = first ? block : Mat3<T>(edge_stiffness[pair] + block);
  }
};

/// K_kk [N/m].
template <class Shape, class T>
TM_HOST_DEVICE Mat3<T> vertex_stiffness(const ElementTensors<Shape, T>& tensors, int k) {
  Mat3<T> sum = Mat3<T>::Zero();
  for (int l = 0; l < Shape::kNodes; ++l) {
    if (l < k) sum -= tensors.edge_stiffness[pair_index(Shape::kNodes, l, k)].transpose();
    if (l > k) sum -= tensors.edge_stiffness[pair_index(Shape::kNodes, k, l)];
  }
  return sum;
}

/// A quadrature point as the element pass has it.
template <class Shape, class T>
struct PointGradients {
  Vec3<T> a[Shape::kNodes];  // ∇N_k [1/m]
  T weight;                  // [m³]

  /// reals(c): the c-th of the point's kRestReals.
  template <class Reals>
  TM_HOST_DEVICE static PointGradients read(Reals&& reals) {
    PointGradients point;
    point.a[0] = Vec3<T>::Zero();
    TM_UNROLL_ALL
    for (int k = 1; k < Shape::kNodes; ++k) {
      point.a[k] = Vec3<T>(reals(3 * k - 3), reals(3 * k - 2), reals(3 * k - 1));
      point.a[0] -= point.a[k];
    }
    point.weight = reals(kRestReals<Shape> - 1);
    return point;
  }
  TM_HOST_DEVICE Mat3<T> deformation_gradient(const Vec3<T> (&displacement)[Shape::kNodes]) const {
    Mat3<T> f = Mat3<T>::Identity();
    TM_UNROLL_ALL
    for (int k = 0; k < Shape::kNodes; ++k) f += displacement[k] * a[k].transpose();
    return f;
  }
  /// Of displacements against that of node 0, which F does not notice.
  TM_HOST_DEVICE Mat3<T> deformation_gradient_against_first(const Vec3<T> (&displacement)[Shape::kNodes]) const {
    Mat3<T> f = Mat3<T>::Identity();
    TM_UNROLL_ALL
    for (int k = 1; k < Shape::kNodes; ++k) f += displacement[k] * a[k].transpose();
    return f;
  }
};

enum class Stiffness {
  kConsistent,  ///< the derivative of the forces
  kPositive,    ///< positive semi-definite, for the solver
};

/// Adds what one quadrature point contributes to `out`, an ElementTensors or what has its add_force and add_edge.
/// point: Law::at(f); viscous: nullptr for a law without memory.
template <class Shape, class Law, class T, class Out>
TM_HOST_DEVICE void add_point(const PointGradients<Shape, T>& gradients, const Mat3<T>& f,
                              typename Law::template Point<T>& point, std::type_identity_t<const Viscous<T>*> viscous,
                              Stiffness kind, bool first, Out& out) {
  if (kind == Stiffness::kPositive) Law::make_positive(point);
  Mat3<T> stress = Law::stress(point);
  T instant = gradients.weight;
  Mat3<T> memory;
  if (viscous != nullptr) {
    stress = viscous->template stress<Law>(f, stress);
    instant *= viscous->instant;
    memory = viscous->template geometric<Law>(kind == Stiffness::kPositive) * gradients.weight;
  }
  typename Law::template Node<T> nodes[Shape::kNodes];
  TM_UNROLL_ALL
  for (int k = 0; k < Shape::kNodes; ++k) nodes[k] = Law::at_node(point, gradients.a[k]);
  TM_UNROLL_ALL
  for (int k = 0; k < Shape::kNodes; ++k) {
    out.add_force(k, stress * gradients.a[k] * (-gradients.weight), first);
    TM_UNROLL_ALL
    for (int l = k + 1; l < Shape::kNodes; ++l) {
      Mat3<T> edge = Law::stiffness(point, nodes[k], nodes[l]) * instant;
      if (viscous != nullptr) edge += Mat3<T>::Identity() * gradients.a[k].dot(memory * gradients.a[l]);
      out.add_edge(pair_index(Shape::kNodes, k, l), edge, first);
    }
  }
}

/// A quadrature point as one of its nodes sees it: its own gradient and those of the other nodes, in their order.
template <class Shape, class T>
struct NodeGradients {
  static constexpr int kOthers = Shape::kNodes - 1;
  Vec3<T> others[kOthers];  // ∇N_l [1/m]
  Vec3<T> own;              // [1/m]
  T weight;                 // [m³]

  NodeGradients() = default;
  /// is_before(m): whether node m comes before the own one.
  template <class IsBefore>
  TM_HOST_DEVICE NodeGradients(const PointGradients<Shape, T>& point, const IsBefore& is_before)
      : own(point.a[0]), weight(point.weight) {
    TM_UNROLL_ALL
    for (int m = 0; m < kOthers; ++m) {
      for (int c = 0; c < 3; ++c) {
        others[m][c] = is_before(m) ? point.a[m][c] : point.a[m + 1][c];
        own[c] = is_before(m) ? point.a[m + 1][c] : own[c];
      }
    }
  }
};

/// What an element adds to one of its nodes.
template <class Shape, class T>
struct NodeTensors {
  Vec3<T> force;                         // f_k [N]
  Mat3<T> stiffness[Shape::kNodes - 1];  // K_kl of the other nodes l [N/m]
};

/// As add_point, but only what belongs to one node. point: Law::at(f), made positive if it is to be. The first
/// contribution is assigned.
template <class Shape, class Law, class T>
TM_HOST_DEVICE void add_point_to_node(const NodeGradients<Shape, T>& gradients, const Mat3<T>& f,
                                      const typename Law::template Point<T>& point,
                                      std::type_identity_t<const Viscous<T>*> viscous, Stiffness kind, bool first,
                                      NodeTensors<Shape, T>& out) {
  // Forces and stiffness are linear in the own gradient, which takes the weight along.
  const Vec3<T> own = gradients.own * gradients.weight;
  const auto own_node = Law::at_node(point, viscous != nullptr ? Vec3<T>(own * viscous->instant) : own);
  Vec3<T> force = -Law::traction(point, own_node);
  Mat3<T> memory;
  if (viscous != nullptr) {
    force += viscous->template relief<Law>(f, own);
    memory = viscous->template geometric<Law>(kind == Stiffness::kPositive);
  }
  out.force = first ? force : Vec3<T>(out.force + force);
  TM_UNROLL_ALL
  for (int m = 0; m < Shape::kNodes - 1; ++m) {
    Mat3<T> block = Law::stiffness(point, own_node, Law::at_node(point, gradients.others[m]));
    if (viscous != nullptr) block += Mat3<T>::Identity() * own.dot(memory * gradients.others[m]);
    out.stiffness[m] = first ? block : Mat3<T>(out.stiffness[m] + block);
  }
}

/// The rest points and shares of an element, as rest.h makes them.
template <class Shape>
struct ElementAtRest {
  std::vector<std::array<double, kRestReals<Shape>>> points;
  std::vector<PointShares> shares;

  ElementAtRest() = default;
  ElementAtRest(const Vec3<double> (&x)[Shape::kNodes], Quadrature quadrature)
      : points(rest_points<Shape>(x, quadrature)), shares(point_shares<Shape>(quadrature)) {}

  /// Calls visit(gradients, F, parameters of the point) for each quadrature point.
  template <class Law, class Visit>
  void for_each_point(const Vec3<double> (&u)[Shape::kNodes], const double* parameters, const Visit& visit) const {
    for (std::size_t q = 0; q < points.size(); ++q) {
      const auto gradients =
          PointGradients<Shape, double>::read([&](int c) { return points[q][static_cast<std::size_t>(c)]; });
      std::array<double, Law::kParameterCount> own;
      std::copy_n(parameters, own.size(), own.begin());
      if (shares[q].deviatoric != 1 || shares[q].volumetric != 1) {
        Law::take_shares(own.data(), shares[q].deviatoric, shares[q].volumetric);
      }
      visit(gradients, gradients.deformation_gradient(u), own.data());
    }
  }
};

/// One element on the host: what the element pass does for many. [N], [N/m]
template <class Law, class Shape>
ElementTensors<Shape, double> element_tensors(const ElementAtRest<Shape>& rest, const Vec3<double> (&u)[Shape::kNodes],
                                              const double* parameters, Stiffness kind) {
  ElementTensors<Shape, double> out;
  bool first = true;
  rest.template for_each_point<Law>(u, parameters,
                                    [&](const auto& gradients, const Mat3<double>& f, const double* own) {
                                      auto point = Law::at(f, own);
                                      add_point<Shape, Law>(gradients, f, point, nullptr, kind, first, out);
                                      first = false;
                                    });
  return out;
}

/// Elastic energy of one element on the host [J].
template <class Law, class Shape>
double element_energy(const ElementAtRest<Shape>& rest, const Vec3<double> (&u)[Shape::kNodes],
                      const double* parameters) {
  double energy = 0;
  rest.template for_each_point<Law>(u, parameters,
                                    [&](const auto& gradients, const Mat3<double>& f, const double* own) {
                                      energy += gradients.weight * Law::energy(Law::at(f, own));
                                    });
  return energy;
}

}  // namespace tensormass::physics
