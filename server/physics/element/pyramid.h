#pragma once

#include "physics/element/quadrature.h"

namespace tensormass::physics {

/// Pyramid with five nodes: the base 0 1 2 3 and the apex 4.
///
/// The reference shape has the base [−1, 1]² at r₂ = 0 and the apex at (0, 0, 1). The rational shape functions of
/// Bedrosian (1992) conform to linear triangles and to the bilinear base. The static interface is that of
/// LinearTetrahedron.
struct Pyramid {
  static constexpr const char* kName = "pyramid";
  static constexpr int kOrder = 1;
  static constexpr int kNodes = 5;
  static constexpr bool kSinglePoint = false;

  /// Not valid at the apex, where the gradients have no limit. No quadrature point lies there.
  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    const double t = 1 - r[2];
    for (int k = 0; k < 4; ++k) {
      const double x = kBase[k][0], y = kBase[k][1];
      n[k] = 0.25 * (t + x * r[0]) * (t + y * r[1]) / t;
    }
    n[4] = r[2];
  }
  static void gradients(const Vec3<double>& r, Vec3<double> (&dn)[kNodes]) {
    const double t = 1 - r[2];
    for (int k = 0; k < 4; ++k) {
      const double x = kBase[k][0], y = kBase[k][1];
      dn[k] = 0.25 * Vec3<double>(x * (t + y * r[1]) / t, y * (t + x * r[0]) / t, x * y * r[0] * r[1] / (t * t) - 1);
    }
    dn[4] = Vec3<double>::Unit(2);
  }

  /// 2×2×2 conical product: Gauss-Legendre over the cross-section, Gauss-Jacobi for the weight t² along the axis.
  static QuadratureRule full_rule() {
    const double offset = std::sqrt(8.0 / 45) / 2;
    const double t[2] = {2.0 / 3 - offset, 2.0 / 3 + offset};
    const double first = (t[1] / 3 - 0.25) / (t[1] - t[0]);  // ∫t² = 1/3 and ∫t³ = 1/4 on [0, 1]
    const double weight[2] = {first, 1.0 / 3 - first};
    QuadratureRule rule;
    for (int i = 0; i < 2; ++i) {
      for (const auto& corner : kBase) {
        const double reach = t[i] / std::sqrt(3.0);
        rule.push_back({{corner[0] * reach, corner[1] * reach, 1 - t[i]}, weight[i]});
      }
    }
    return rule;
  }
  static QuadratureRule mass_rule() {
    return detail::product_rule(detail::kGauss4, [](double a, double b, double t) -> QuadraturePoint {
      return {{(2 * a - 1) * t, (2 * b - 1) * t, 1 - t}, 4 * t * t};
    });
  }

 private:
  static constexpr double kBase[4][2] = {{-1, -1}, {1, -1}, {1, 1}, {-1, 1}};
};

}  // namespace tensormass::physics
