#pragma once

#include "core/scalar.h"

/// Any law in any shape: displacements to forces and stiffness tensors.
///
///   F = I + Σ_k U_k ⊗ a_k      f_k = −Σ_q w_q P(F) a_k      K_kl = Σ_q w_q a_k : ∂P/∂F : a_l
///
/// with a_k = ∇N_k at rest and U_k the displacement of node k (Faure, Zara, Jaillet, Moreau 2012; for one quadrature
/// point and Hooke's law this is Cotin's tensor). The gradients sum to zero, so K_kk = −Σ_l K_kl: only the edge tensors
/// are computed and stored, and a node's vertex tensor is minus the sum of its edges.
namespace tensormass::physics {

/// Index of K_kl, k < l, among the pairs of an element with `nodes` nodes: rows of the upper triangle one by one.
TM_HOST_DEVICE constexpr int pair_index(int nodes, int k, int l) { return k * (2 * nodes - k - 1) / 2 + l - k - 1; }

template <int Nodes>
inline constexpr int kPairs = Nodes*(Nodes - 1) / 2;

template <class Shape, class T>
struct ElementTensors {
  Vec3<T> force[Shape::kNodes];                   // f_k [N]
  Mat3<T> edge_stiffness[kPairs<Shape::kNodes>];  // K_kl, k < l [N/m]; K_lk is its transpose
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

template <class T, int Nodes>
TM_HOST_DEVICE Mat3<T> deformation_gradient(const Vec3<T> (&displacement)[Nodes], const Vec3<T> (&a)[Nodes]) {
  Mat3<T> f = Mat3<T>::Identity();
  for (int k = 0; k < Nodes; ++k) f += displacement[k] * a[k].transpose();
  return f;
}

/// Elastic energy of the element [J].
/// rest: [kQuadraturePoints][kRestReals]
template <class Shape, class Law, class T>
TM_HOST_DEVICE T element_energy(const Vec3<T> (&displacement)[Shape::kNodes],
                                const T (&rest)[Shape::kQuadraturePoints][Shape::kRestReals], const T* parameters) {
  T energy = T(0);
  for (int q = 0; q < Shape::kQuadraturePoints; ++q) {
    Vec3<T> a[Shape::kNodes];
    T weight;
    Shape::gradients(rest[q], a, weight);
    energy += weight * Law::energy(Law::at(deformation_gradient(displacement, a), parameters));
  }
  return energy;
}

enum class Stiffness {
  kConsistent,  ///< the derivative of the forces
  kPositive,    ///< positive semi-definite, for the solver
};

template <class Shape, class Law, Stiffness Kind, class T>
TM_HOST_DEVICE ElementTensors<Shape, T> element_tensors(const Vec3<T> (&displacement)[Shape::kNodes],
                                                        const T (&rest)[Shape::kQuadraturePoints][Shape::kRestReals],
                                                        const T* parameters) {
  ElementTensors<Shape, T> out;
  for (int q = 0; q < Shape::kQuadraturePoints; ++q) {
    Vec3<T> a[Shape::kNodes];
    T weight;
    Shape::gradients(rest[q], a, weight);
    auto point = Law::at(deformation_gradient(displacement, a), parameters);
    if constexpr (Kind == Stiffness::kPositive) Law::make_positive(point);
    const Mat3<T> stress = Law::stress(point);
    for (int k = 0; k < Shape::kNodes; ++k) {
      const Vec3<T> f = stress * a[k] * (-weight);
      out.force[k] = q == 0 ? f : Vec3<T>(out.force[k] + f);
      for (int l = k + 1; l < Shape::kNodes; ++l) {
        Mat3<T>& slot = out.edge_stiffness[pair_index(Shape::kNodes, k, l)];
        const Mat3<T> edge = Law::stiffness(point, a[k], a[l]) * weight;
        slot = q == 0 ? edge : Mat3<T>(slot + edge);
      }
    }
  }
  return out;
}

}  // namespace tensormass::physics
