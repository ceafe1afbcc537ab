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
  if (kind == Stiffness::kPositive) Law::project_to_psd(point);
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

/// The other nodes of one of an element's nodes are counted from node 1 on, with node 0 in place of the one.
template <class Shape>
inline constexpr int kOthers = Shape::kNodes - 1;

/// A quadrature point as one of its nodes sees it.
template <class Shape, class T>
struct NodeGradients {
  Vec3<T> others[kOthers<Shape>];  // ∇N_l [1/m]; of several points those of nodes 1 and on, see NodeTensors
  Vec3<T> own;                     // [1/m]
  T weight;                        // [m³]

  NodeGradients() = default;
  /// is_own(l): whether node l is the one.
  template <class IsOwn>
  TM_HOST_DEVICE NodeGradients(const PointGradients<Shape, T>& point, const IsOwn& is_own)
      : own(point.a[0]), weight(point.weight) {
    TM_UNROLL_ALL
    for (int m = 0; m < kOthers<Shape>; ++m) {
      for (int c = 0; c < 3; ++c) {
        others[m][c] = Shape::kSinglePoint && is_own(m + 1) ? point.a[0][c] : point.a[m + 1][c];
        own[c] = is_own(m + 1) ? point.a[m + 1][c] : own[c];
      }
    }
  }
};

/// What an element adds to one of its nodes, k.
///
/// Of several points the blocks are summed for nodes 1 and on whichever k is, so that no point has to choose; that of
/// node 0, which is minus their sum, takes the place of K_kk when all points are in.
template <class Shape, class T>
struct NodeTensors {
  Vec3<T> force;                      // f_k [N]
  Mat3<T> stiffness[kOthers<Shape>];  // K_kl of the other nodes l [N/m]

  /// Zero; of a single point, which assigns, not yet anything.
  TM_HOST_DEVICE NodeTensors() {
    if constexpr (Shape::kSinglePoint) return;
    force.setZero();
    for (Mat3<T>& k : stiffness) k.setZero();
  }

  template <class IsOwn>
  TM_HOST_DEVICE void complete(const IsOwn& is_own) {
    if constexpr (Shape::kSinglePoint) return;
    Mat3<T> of_first = -stiffness[0];
    TM_UNROLL_ALL
    for (int m = 1; m < kOthers<Shape>; ++m) of_first -= stiffness[m];
    TM_UNROLL_ALL
    for (int m = 0; m < kOthers<Shape>; ++m) {
      for (int c = 0; c < 9; ++c) stiffness[m](c) = is_own(m + 1) ? of_first(c) : stiffness[m](c);
    }
  }
};

/// As add_point, but only what belongs to one node. point: Law::at(f), made positive if it is to be. Behind the last
/// point the tensors are to be completed.
template <class Shape, class Law, class T>
TM_HOST_DEVICE void add_point_to_node(const NodeGradients<Shape, T>& gradients, const Mat3<T>& f,
                                      const typename Law::template Point<T>& point,
                                      std::type_identity_t<const Viscous<T>*> viscous, Stiffness kind,
                                      NodeTensors<Shape, T>& out) {
  // Forces and stiffness are linear in the own gradient, which takes the weight along.
  const Vec3<T> own = gradients.own * gradients.weight;
  const auto own_node = Law::at_node(point, viscous != nullptr ? Vec3<T>(own * viscous->instant) : own);
  Vec3<T> force = -Law::traction(point, own_node);
  Vec3<T> remembered;
  if (viscous != nullptr) {
    force += viscous->template relief<Law>(f, own);
    remembered = viscous->template geometric<Law>(kind == Stiffness::kPositive) * own;
  }
  if constexpr (Shape::kSinglePoint) {
    out.force = force;
    TM_UNROLL_ALL
    for (int m = 0; m < kOthers<Shape>; ++m) {
      Mat3<T>& block = out.stiffness[m];
      block = Law::stiffness(point, own_node, Law::at_node(point, gradients.others[m]));
      if (viscous != nullptr) block += Mat3<T>::Identity() * remembered.dot(gradients.others[m]);
    }
  } else {
    // Of many others each block is a sum of three, those of the axes.
    out.force += force;
    Mat3<T> axes[3];
    TM_UNROLL_ALL
    for (int c = 0; c < 3; ++c) {
      axes[c] = Law::stiffness(point, own_node, Law::at_axis(point, c));
      if (viscous != nullptr) axes[c] += Mat3<T>::Identity() * remembered[c];
    }
    TM_UNROLL_ALL
    for (int m = 0; m < kOthers<Shape>; ++m) {
      TM_UNROLL_ALL
      for (int c = 0; c < 3; ++c) out.stiffness[m] += axes[c] * gradients.others[m][c];
    }
  }
}

/// The rest points and shares of an element, as rest.h makes them.
template <class Shape>
struct ElementAtRest {
  std::vector<std::array<double, kRestReals<Shape>>> points;
  std::vector<ModuliWeights> shares;

  ElementAtRest() = default;
  ElementAtRest(const Vec3<double> (&x)[Shape::kNodes], Quadrature quadrature)
      : points(rest_points<Shape>(x, quadrature)), shares(moduli_weights<Shape>(quadrature)) {}

  /// Calls visit(gradients, F, parameters of the point) for each quadrature point.
  template <class Law, class Visit>
  void for_each_point(const Vec3<double> (&u)[Shape::kNodes], const double* parameters, const Visit& visit) const {
    for (std::size_t q = 0; q < points.size(); ++q) {
      const auto gradients =
          PointGradients<Shape, double>::read([&](int c) { return points[q][static_cast<std::size_t>(c)]; });
      std::array<double, Law::kParameterCount> own;
      std::copy_n(parameters, own.size(), own.begin());
      if (shares[q].deviatoric != 1 || shares[q].volumetric != 1) {
        Law::scale_moduli(own.data(), shares[q].deviatoric, shares[q].volumetric);
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
