#pragma once

#include "physics/element/quadrature.h"

namespace tensormass::physics {

/// Hexahedron with eight nodes, trilinear, on the cube [0, 1]³.
///
/// Nodes in VTK order: base (r₂ = 0) 0 1 2 3, then 4 5 6 7 above it. The static interface is that of LinearTetrahedron.
struct Hexahedron {
  static constexpr const char* kName = "hexahedron";
  static constexpr int kOrder = 1;
  static constexpr int kNodes = 8;
  static constexpr bool kSinglePoint = false;

  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    for (int k = 0; k < kNodes; ++k) n[k] = factor(k, 0, r) * factor(k, 1, r) * factor(k, 2, r);
  }
  static void gradients(const Vec3<double>& r, Vec3<double> (&dn)[kNodes]) {
    for (int k = 0; k < kNodes; ++k) {
      for (int c = 0; c < 3; ++c) {
        dn[k][c] = (kCorners[k][c] ? 1 : -1) * factor(k, (c + 1) % 3, r) * factor(k, (c + 2) % 3, r);
      }
    }
  }

  static QuadratureRule full_rule() { return detail::product_rule(detail::kGauss2, at); }
  static QuadratureRule mass_rule() { return detail::product_rule(detail::kGauss4, at); }

 private:
  static constexpr bool kCorners[kNodes][3] = {{false, false, false}, {true, false, false}, {true, true, false},
                                               {false, true, false},  {false, false, true}, {true, false, true},
                                               {true, true, true},    {false, true, true}};
  static double factor(int k, int c, const Vec3<double>& r) { return kCorners[k][c] ? r[c] : 1 - r[c]; }
  static QuadraturePoint at(double a, double b, double c) { return {{a, b, c}, 1}; }
};

}  // namespace tensormass::physics
