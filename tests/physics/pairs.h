#pragma once

#include <random>
#include <tuple>

#include <gtest/gtest.h>
#include <Eigen/Dense>

#include "physics/element/element.h"
#include "physics/laws.h"
#include "physics/lists.h"

/// Every (shape, law) of physics/lists.h as a typed test, with what such a test needs: an element at rest, the law's
/// parameters, and element quantities as plain vectors and matrices.
namespace tensormass::physics::testing {

template <class Shape_, class Law_>
struct Pair {
  using Shape = Shape_;
  using Law = Law_;
};

namespace detail {

template <class Shape, class... Laws>
std::tuple<Pair<Shape, Laws>...> with_laws(TypeList<Laws...>);
template <class... Shapes, class Laws>
auto cross(TypeList<Shapes...>, Laws laws) -> decltype(std::tuple_cat(with_laws<Shapes>(laws)...));
template <class... Pairs>
::testing::Types<Pairs...> as_types(std::tuple<Pairs...>);

}  // namespace detail

using AllPairs = decltype(detail::as_types(detail::cross(Shapes{}, Laws{})));

struct PairNames {
  template <class P>
  static std::string GetName(int) {
    return std::string(P::Shape::kName) + "_" + P::Law::kName;
  }
};

/// Nodes of a well-shaped element. A shape needs a specialization here.
template <class Shape>
void reference_nodes(Vec3<double> (&x)[Shape::kNodes]);
template <>
inline void reference_nodes<LinearTetrahedron>(Vec3<double> (&x)[4]) {
  x[0] = {0, 0, 0};
  x[1] = {1, 0, 0};
  x[2] = {0, 1, 0};
  x[3] = {0, 0, 1};
}

template <class Shape>
struct Element {
  Vec3<double> x[Shape::kNodes];
  double rest[Shape::kQuadraturePoints][Shape::kRestReals];

  /// The reference, 2 cm large, moved a little at random.
  explicit Element(std::mt19937& random) {
    std::uniform_real_distribution<double> uniform(-0.15, 0.15);
    reference_nodes<Shape>(x);
    for (Vec3<double>& node : x) {
      node += Vec3<double>(uniform(random), uniform(random), uniform(random));
      node *= 0.02;
    }
    for (int q = 0; q < Shape::kQuadraturePoints; ++q) Shape::rest(x, q, rest[q]);
  }
};

/// Displacements of an element.
template <class Shape>
struct Displacement {
  Vec3<double> u[Shape::kNodes];
  static constexpr int kSize = 3 * Shape::kNodes;

  double& operator[](int i) { return u[i / 3][i % 3]; }

  /// x -> F x
  static Displacement affine(const Element<Shape>& element, const Mat3<double>& f) {
    Displacement out;
    for (int k = 0; k < Shape::kNodes; ++k) out.u[k] = f * element.x[k] - element.x[k];
    return out;
  }
  static Displacement random(std::mt19937& generator, double scale_m) {
    std::uniform_real_distribution<double> uniform(-scale_m, scale_m);
    Displacement out;
    for (int i = 0; i < kSize; ++i) out[i] = uniform(generator);
    return out;
  }
};

template <class Shape>
Eigen::VectorXd force(const ElementTensors<Shape, double>& tensors) {
  Eigen::VectorXd out(3 * Shape::kNodes);
  for (int k = 0; k < Shape::kNodes; ++k) out.segment<3>(3 * k) = tensors.force[k];
  return out;
}

template <class Shape>
Eigen::MatrixXd stiffness(const ElementTensors<Shape, double>& tensors) {
  Eigen::MatrixXd out(3 * Shape::kNodes, 3 * Shape::kNodes);
  for (int k = 0; k < Shape::kNodes; ++k) {
    out.block<3, 3>(3 * k, 3 * k) = vertex_stiffness(tensors, k);
    for (int l = k + 1; l < Shape::kNodes; ++l) {
      const Mat3<double>& edge = tensors.edge_stiffness[pair_index(Shape::kNodes, k, l)];
      out.block<3, 3>(3 * k, 3 * l) = edge;
      out.block<3, 3>(3 * l, 3 * k) = edge.transpose();
    }
  }
  return out;
}

inline Mat3<double> random_rotation(std::mt19937& random) {
  std::normal_distribution<double> normal;
  const Eigen::Quaterniond q(normal(random), normal(random), normal(random), normal(random));
  return q.normalized().toRotationMatrix();
}

}  // namespace tensormass::physics::testing
