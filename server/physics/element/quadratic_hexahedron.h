#pragma once

#include "physics/element/quadrature.h"

namespace tensormass::physics {

/// Hexahedron with twenty nodes on the cube [0, 1]³: the corners of Hexahedron, then the middles of its edges 01 12 23
/// 30 45 56 67 74 04 15 26 37 (VTK). It bends without locking and follows curved deformations.
///
/// Shape functions are those of the serendipity family (Zienkiewicz, Taylor, The Finite Element Method):
///
///   ξ = 2 r − 1          coordinates from −1 to 1
///   σ                    place of the node: −1, 0 or 1 in each direction
///   corner               N = ⅛ (1 + σ₀ ξ₀)(1 + σ₁ ξ₁)(1 + σ₂ ξ₂)(σ · ξ − 2)
///   middle, with σ_a = 0 N = ¼ (1 − ξ_a²) Π_{c ≠ a} (1 + σ_c ξ_c)
///
/// The 2×2×2 Gauss points alone are exact enough, but see no energy in six modes of an element. Some of these pass
/// through a row of single elements, also if one end is clamped. The full rule therefore has six more points, the
/// centres of the faces, which keep it exact to degree three with any weight. All 14 have the same weight. Constant
/// stress in a distorted element needs a higher degree than three, which products of Gauss points have but the six do
/// not; rest.h moves their gradients so that they agree with the others (`balance`).
///
/// Selective quadrature integrates the volumetric energy at the Gauss points alone, which avoids locking near ν = 0.5
/// and needs no further points. One point with mean gradients would be too few: a plate of one layer would then bend
/// into a sphere at no cost.
///
/// The static interface is that of LinearTetrahedron.
struct QuadraticHexahedron {
  static constexpr const char* kName = "quadratic_hexahedron";
  static constexpr int kOrder = 2;
  static constexpr int kNodes = 20;
  static constexpr bool kSinglePoint = false;

  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    for (int k = 0; k < kNodes; ++k) n[k] = factor(k, 0, r) * factor(k, 1, r) * factor(k, 2, r) * last(k, r);
  }
  static void gradients(const Vec3<double>& r, Vec3<double> (&dn)[kNodes]) {
    for (int k = 0; k < kNodes; ++k) {
      for (int c = 0; c < 3; ++c) {
        const double others = factor(k, (c + 1) % 3, r) * factor(k, (c + 2) % 3, r);
        const double slope = kPlaces[k][c] == 0 ? -2 * at(c, r) : kPlaces[k][c];
        const double of_last = k < 8 ? 0.125 * kPlaces[k][c] : 0;
        dn[k][c] = 2 * others * (slope * last(k, r) + factor(k, c, r) * of_last);  // dξ/dr = 2
      }
    }
  }

  static QuadratureRule full_rule() {
    QuadratureRule rule = reduced_rule();
    for (int c = 0; c < 3; ++c) {
      for (const double side : {-0.5, 0.5})
        rule.push_back({Vec3<double>::Constant(0.5) + side * Vec3<double>::Unit(c), 0});
    }
    for (QuadraturePoint& point : rule) point.weight = 1.0 / static_cast<double>(rule.size());
    return rule;
  }
  static QuadratureRule reduced_rule() { return detail::product_rule(detail::kGauss2, of_cube); }
  static QuadratureRule mass_rule() { return detail::product_rule(detail::kGauss4, of_cube); }

 private:
  static constexpr int kPlaces[kNodes][3] = {{-1, -1, -1}, {1, -1, -1}, {1, 1, -1}, {-1, 1, -1}, {-1, -1, 1},
                                             {1, -1, 1},   {1, 1, 1},   {-1, 1, 1}, {0, -1, -1}, {1, 0, -1},
                                             {0, 1, -1},   {-1, 0, -1}, {0, -1, 1}, {1, 0, 1},   {0, 1, 1},
                                             {-1, 0, 1},   {-1, -1, 0}, {1, -1, 0}, {1, 1, 0},   {-1, 1, 0}};
  static double at(int c, const Vec3<double>& r) { return 2 * r[c] - 1; }
  static double factor(int k, int c, const Vec3<double>& r) {
    const double x = at(c, r);
    return kPlaces[k][c] == 0 ? 1 - x * x : 1 + kPlaces[k][c] * x;
  }
  /// The factor of N that mixes the directions, with the constant in front.
  static double last(int k, const Vec3<double>& r) {
    if (k >= 8) return 0.25;
    return 0.125 * (kPlaces[k][0] * at(0, r) + kPlaces[k][1] * at(1, r) + kPlaces[k][2] * at(2, r) - 2);
  }
  static QuadraturePoint of_cube(double a, double b, double c) { return {{a, b, c}, 1}; }
};

}  // namespace tensormass::physics
