#pragma once

#include "physics/element/quadrature.h"

namespace tensormass::physics {

/// Wedge with six nodes: a triangle 0 1 2 and its copy 3 4 5. Seen from the copy, 0 1 2 runs counter-clockwise.
///
/// Shape functions are linear in the triangle (r₀, r₁) and linear along r₂ in [0, 1]. The static interface is that of
/// LinearTetrahedron.
struct Wedge {
  static constexpr const char* kName = "wedge";
  static constexpr int kOrder = 1;
  static constexpr int kNodes = 6;
  static constexpr bool kSinglePoint = false;

  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    const double l[3] = {1 - r[0] - r[1], r[0], r[1]};
    for (int k = 0; k < 3; ++k) {
      n[k] = l[k] * (1 - r[2]);
      n[k + 3] = l[k] * r[2];
    }
  }
  static void gradients(const Vec3<double>& r, Vec3<double> (&dn)[kNodes]) {
    const double l[3] = {1 - r[0] - r[1], r[0], r[1]};
    constexpr double kSlope[3][2] = {{-1, -1}, {1, 0}, {0, 1}};
    for (int k = 0; k < 3; ++k) {
      dn[k] = {kSlope[k][0] * (1 - r[2]), kSlope[k][1] * (1 - r[2]), -l[k]};
      dn[k + 3] = {kSlope[k][0] * r[2], kSlope[k][1] * r[2], l[k]};
    }
  }

  /// Three points in the triangle times two along the axis.
  static QuadratureRule full_rule() {
    QuadratureRule rule;
    for (const auto& [height, weight] : detail::kGauss2) {
      for (const auto& [a, b] :
           {std::array{1.0 / 6, 1.0 / 6}, std::array{2.0 / 3, 1.0 / 6}, std::array{1.0 / 6, 2.0 / 3}}) {
        rule.push_back({{a, b, height}, weight / 6});
      }
    }
    return rule;
  }
  static QuadratureRule mass_rule() {
    return detail::product_rule(detail::kGauss4, [](double a, double b, double c) -> QuadraturePoint {
      return {{a, b * (1 - a), c}, 1 - a};
    });
  }
};

}  // namespace tensormass::physics
