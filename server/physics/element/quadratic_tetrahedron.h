#pragma once

#include "physics/element/linear_tetrahedron.h"

namespace tensormass::physics {

/// Tetrahedron with ten nodes: the corners, then the middles of the edges 01 12 02 03 13 23. It bends without locking.
///
/// The static interface is that of LinearTetrahedron, and so is the reference shape.
struct QuadraticTetrahedron {
  static constexpr const char* kName = "quadratic_tetrahedron";
  static constexpr int kOrder = 2;
  static constexpr int kNodes = 10;
  static constexpr bool kSinglePoint = false;

  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    double l[4];
    LinearTetrahedron::values(r, l);
    for (int k = 0; k < 4; ++k) n[k] = l[k] * (2 * l[k] - 1);
    for (int k = 4; k < kNodes; ++k) n[k] = 4 * l[kEdges[k - 4][0]] * l[kEdges[k - 4][1]];
  }
  static void gradients(const Vec3<double>& r, Vec3<double> (&dn)[kNodes]) {
    double l[4];
    Vec3<double> dl[4];
    LinearTetrahedron::values(r, l);
    LinearTetrahedron::gradients(r, dl);
    for (int k = 0; k < 4; ++k) dn[k] = (4 * l[k] - 1) * dl[k];
    for (int k = 4; k < kNodes; ++k) {
      const int i = kEdges[k - 4][0], j = kEdges[k - 4][1];
      dn[k] = 4 * (l[i] * dl[j] + l[j] * dl[i]);
    }
  }

  /// Four points, exact for polynomials of degree two.
  static QuadratureRule full_rule() {
    const double near = (5 + 3 * std::sqrt(5.0)) / 20, far = (5 - std::sqrt(5.0)) / 20;
    QuadratureRule rule{{Vec3<double>::Constant(far), 1.0 / 24}};
    for (int k = 0; k < 3; ++k) {
      rule.push_back({Vec3<double>::Constant(far) + (near - far) * Vec3<double>::Unit(k), 1.0 / 24});
    }
    return rule;
  }
  static QuadratureRule mass_rule() { return LinearTetrahedron::mass_rule(); }

 private:
  static constexpr int kEdges[6][2] = {{0, 1}, {1, 2}, {0, 2}, {0, 3}, {1, 3}, {2, 3}};
};

}  // namespace tensormass::physics
