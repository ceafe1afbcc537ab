#pragma once

#include "core/scalar.h"

namespace tensormass::physics {

/// Four nodes, one quadrature point: F is constant in the element.
struct LinearTetrahedron {
  static constexpr const char* kName = "tetrahedron";
  static constexpr int kNodes = 4;
  static constexpr int kQuadraturePoints = 1;
  /// Of one quadrature point at rest: gradients of nodes 1 to 3 (node 0 has minus their sum) and the weight.
  static constexpr int kRestReals = 10;

  /// The shape gradients a_k = ∇N_k [1/m] and the weight [m³] from what was stored.
  template <class T>
  TM_HOST_DEVICE static void gradients(const T (&rest)[kRestReals], Vec3<T> (&a)[kNodes], T& weight) {
    for (int k = 0; k < 3; ++k) a[k + 1] = Vec3<T>(rest[3 * k], rest[3 * k + 1], rest[3 * k + 2]);
    a[0] = -(a[1] + a[2] + a[3]);
    weight = rest[9];
  }

  /// Host: from the nodes at rest [m]. Positive volume is the caller's to check.
  static void rest(const Vec3<double> (&x)[kNodes], int /*point*/, double (&out)[kRestReals]) {
    const Vec3<double> e1 = x[1] - x[0], e2 = x[2] - x[0], e3 = x[3] - x[0];
    const double six_volumes = e1.dot(cross(e2, e3));
    const Vec3<double> a[3] = {cross(e2, e3) / six_volumes, cross(e3, e1) / six_volumes, cross(e1, e2) / six_volumes};
    for (int k = 0; k < 3; ++k) {
      for (int c = 0; c < 3; ++c) out[3 * k + c] = a[k][c];
    }
    out[9] = six_volumes / 6;
  }

  /// Share of each node in the element's mass, by row sums.
  static constexpr double mass_share(int /*node*/) { return 0.25; }

 private:
  static Vec3<double> cross(const Vec3<double>& a, const Vec3<double>& b) {
    return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
  }
};

}  // namespace tensormass::physics
