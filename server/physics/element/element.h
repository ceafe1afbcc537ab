#pragma once

#include <algorithm>
#include <array>
#include <type_traits>
#include <vector>

#include "core/scalar.h"
#include "physics/element/prony.h"
#include "physics/element/rest.h"

/// From displacements to forces and stiffness, for any law in any shape.
///
/// Symbols:
///
///   a_k = ∇N_k    shape gradient of node k at rest [1/m]
///   U_k           displacement of node k [m]
///   F             deformation gradient
///   P             first Piola-Kirchhoff stress of the law [Pa]
///   w_q           weight of quadrature point q: its share of the volume at rest [m³]
///   f_k           elastic force on node k [N]
///   K_kl          stiffness −∂f_k/∂U_l [N/m]; K_lk = K_klᵀ
///
/// Formulas (Faure, Zara, Jaillet, Moreau 2012; with one quadrature point and Hooke's law these are Cotin's tensors):
///
///   F = I + Σ_k U_k ⊗ a_k      f_k = −Σ_q w_q P(F) a_k      K_kl = Σ_q w_q a_k : ∂P/∂F : a_l
///
/// The gradients add up to zero, therefore K_kk = −Σ_l≠k K_kl. Only the blocks K_kl with k < l ("edges" of the element)
/// are computed and stored.
///
/// Two ways to evaluate an element, because the two backends divide the work differently:
///
///   by element   add_point            all forces and edge blocks of an element: CPU, and the stiffness of linear laws
///   by node      add_point_to_node    force and blocks of one node k: GPU, where a thread owns a matrix row and
///                                     evaluates all elements of its node; no two threads write to the same place
///
/// A shape enters only by its number of nodes: rest.h has turned everything else into gradients and weights.
namespace tensormass::physics {

/// Returns the index of K_kl, k < l, among the node pairs of an element: the upper triangle, row by row.
TM_HOST_DEVICE constexpr int pair_index(int nodes, int k, int l) { return k * (2 * nodes - k - 1) / 2 + l - k - 1; }

/// Number of node pairs k < l.
template <int Nodes>
inline constexpr int kPairs = Nodes*(Nodes - 1) / 2;

/// Forces and edge blocks of one element.
template <class Shape, class T>
struct ElementTensors {
  Vec3<T> force[Shape::kNodes];                   // f_k [N]
  Mat3<T> edge_stiffness[kPairs<Shape::kNodes>];  // K_kl, k < l [N/m]; K_lk is its transpose

  /// Add a contribution of one quadrature point. The first one is assigned, so the struct need not be zeroed before.
  TM_HOST_DEVICE void add_force(int k, const Vec3<T>& f, bool first) { force[k] = first ? f : Vec3<T>(force[k] + f); }
  TM_HOST_DEVICE void add_edge(int pair, const Mat3<T>& block, bool first) {
    edge_stiffness[pair] = first ? block : Mat3<T>(edge_stiffness[pair] + block);
  }
};

/// Returns K_kk [N/m]: minus the sum of the node's edge blocks.
template <class Shape, class T>
TM_HOST_DEVICE Mat3<T> vertex_stiffness(const ElementTensors<Shape, T>& tensors, int k) {
  Mat3<T> sum = Mat3<T>::Zero();
  for (int l = 0; l < Shape::kNodes; ++l) {
    if (l < k) sum -= tensors.edge_stiffness[pair_index(Shape::kNodes, l, k)].transpose();
    if (l > k) sum -= tensors.edge_stiffness[pair_index(Shape::kNodes, k, l)];
  }
  return sum;
}

/// Shape gradients and weight of one quadrature point.
template <class Shape, class T>
struct PointGradients {
  Vec3<T> a[Shape::kNodes];  // ∇N_k [1/m]
  T weight;                  // [m³]

  /// Reads a point from its kRestReals numbers.
  ///
  ///   reals(c)   returns the c-th number
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
  /// Returns F from the displacements of the element's nodes [m].
  TM_HOST_DEVICE Mat3<T> deformation_gradient(const Vec3<T> (&displacement)[Shape::kNodes]) const {
    Mat3<T> f = Mat3<T>::Identity();
    TM_UNROLL_ALL
    for (int k = 0; k < Shape::kNodes; ++k) f += displacement[k] * a[k].transpose();
    return f;
  }
  /// Returns the same F from displacements relative to that of node 0.
  TM_HOST_DEVICE Mat3<T> deformation_gradient_against_first(const Vec3<T> (&displacement)[Shape::kNodes]) const {
    Mat3<T> f = Mat3<T>::Identity();
    TM_UNROLL_ALL
    for (int k = 1; k < Shape::kNodes; ++k) f += displacement[k] * a[k].transpose();
    return f;
  }
};

enum class Stiffness {
  kConsistent,  ///< the exact derivative of the forces
  kProjected,   ///< projected to positive semi-definite, for the solver
};

/// Adds the contribution of one quadrature point to all forces and edge blocks of its element.
///
///   gradients   the point's shape gradients and weight
///   f, point    deformation gradient, and Law::at(f); the point is projected if kind is kProjected
///   viscous     the point's viscoelastic part; nullptr for an elastic law
///   first       true for the element's first point: assigns instead of adding
///   out         ElementTensors, or any type with its members
///               add_force(k, force [N], first), called for each node, and
///               add_edge(pair_index, block [N/m], first), called for each pair
template <class Shape, class Law, class T, class Out>
TM_HOST_DEVICE void add_point(const PointGradients<Shape, T>& gradients, const Mat3<T>& f,
                              typename Law::template Point<T>& point, std::type_identity_t<const Viscous<T>*> viscous,
                              Stiffness kind, bool first, Out& out) {
  if (kind == Stiffness::kProjected) Law::project_to_psd(point);
  Mat3<T> stress = Law::stress(point);
  T instant = gradients.weight;
  Mat3<T> memory;
  if (viscous != nullptr) {
    stress = viscous->template stress<Law>(f, stress);
    instant *= viscous->instant;
    memory = viscous->template geometric<Law>(kind == Stiffness::kProjected) * gradients.weight;
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

/// Number of the other nodes of an element, seen from one of its nodes, k. They are listed as nodes 1, 2, ..., with
/// node 0 in place of k:
///
///   k = 0:  1 2 3        k = 2:  1 0 3        (four nodes)
template <class Shape>
inline constexpr int kOthers = Shape::kNodes - 1;

/// Gradients of a quadrature point as seen from one of the element's nodes.
template <class Shape, class T>
struct NodeGradients {
  Vec3<T> others[kOthers<Shape>];  // ∇N_l [1/m] in the order of kOthers; if the shape has several points, of nodes 1,
                                   // 2, ... (see NodeTensors)
  Vec3<T> own;                     // ∇N_k [1/m]
  T weight;                        // [m³]

  NodeGradients() = default;
  /// Selects the gradients of one node.
  ///
  ///   is_own(l)   returns whether node l is the one; called for l ≥ 1. It is a comparison, so that gradients stay in
  ///               registers: an index at run time would move them to local memory
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

/// Contribution of one element to the row of one of its nodes, k.
///
/// If the shape has several points, blocks are summed for nodes 1, 2, ... for every k, so that no point has to select.
/// `complete` then replaces the block of k itself by that of node 0, which is minus the sum of all others.
template <class Shape, class T>
struct NodeTensors {
  Vec3<T> force;                      // f_k [N]
  Mat3<T> stiffness[kOthers<Shape>];  // K_kl of the other nodes l [N/m], in the order of kOthers

  /// Sets everything to zero. With a single point, members stay uninitialized: that point assigns them.
  TM_HOST_DEVICE NodeTensors() {
    if constexpr (Shape::kSinglePoint) return;
    force.setZero();
    for (Mat3<T>& k : stiffness) k.setZero();
  }

  /// Moves the block of node 0 to its place. Call it once, after the last point.
  ///
  ///   is_own(l)   returns whether node l is k; called for l ≥ 1
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

/// Adds the contribution of one quadrature point to the row of one node. `complete` must follow the last point.
///
///   point   Law::at(f), projected by the caller if kind is kProjected
///
/// The other parameters are those of add_point.
template <class Shape, class Law, class T>
TM_HOST_DEVICE void add_point_to_node(const NodeGradients<Shape, T>& gradients, const Mat3<T>& f,
                                      const typename Law::template Point<T>& point,
                                      std::type_identity_t<const Viscous<T>*> viscous, Stiffness kind,
                                      NodeTensors<Shape, T>& out) {
  // Forces and stiffness are linear in the node's own gradient, so the weight is multiplied into it once.
  const Vec3<T> own = gradients.own * gradients.weight;
  const auto own_node = Law::at_node(point, viscous != nullptr ? Vec3<T>(own * viscous->instant) : own);
  Vec3<T> force = -Law::traction(point, own_node);
  Vec3<T> remembered;
  if (viscous != nullptr) {
    force += viscous->template relief<Law>(f, own);
    remembered = viscous->template geometric<Law>(kind == Stiffness::kProjected) * own;
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
    // With many other nodes it is cheaper to compute the stiffness against the three axes once. Each block is then
    // their sum, weighted with the components of the other node's gradient.
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

/// Rest points and moduli weights of one element (rest.h), for evaluation on the host.
template <class Shape>
struct ElementAtRest {
  std::vector<std::array<double, kRestReals<Shape>>> points;
  std::vector<ModuliWeights> shares;

  ElementAtRest() = default;
  ElementAtRest(const Vec3<double> (&x)[Shape::kNodes], Quadrature quadrature)
      : points(rest_points<Shape>(x, quadrature)), shares(moduli_weights<Shape>(quadrature)) {}

  /// Visits each quadrature point.
  ///
  ///   u, parameters   displacements [m] and the element's parameters of the law
  ///   visit(gradients, F, own parameters)   is called once for each point. The parameters are those of the law,
  ///                                         with the point's moduli weights applied
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

/// Returns the forces [N] and edge blocks [N/m] of one element on the host; the element pass does the same for many.
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

/// Returns the elastic energy of one element on the host [J].
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
