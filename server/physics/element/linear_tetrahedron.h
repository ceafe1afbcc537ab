#pragma once

#include "physics/element/quadrature.h"

namespace tensormass::physics {

/// Tetrahedron with four nodes. F is constant, so one quadrature point is exact. It locks as ν approaches 0.5;
/// QuadraticTetrahedron does not.
///
/// Every shape has this interface:
///
///   kName, kOrder, kNodes      name, polynomial order of its edges, number of nodes
///   kSinglePoint               true if every quadrature has one point
///   values(r, n)               writes the shape functions N_k at a point r of the reference shape
///   gradients(r, dn)           writes ∂N_k/∂r there
///   full_rule(), mass_rule()   quadrature rules for energies, and for products of two shape functions
///   reduced_rule()             optional: the rule of reduced quadrature, if one point is too few (rest.h). Its points
///   are
///                              the first ones of the full rule
struct LinearTetrahedron {
  static constexpr const char* kName = "tetrahedron";
  static constexpr int kOrder = 1;
  static constexpr int kNodes = 4;
  /// True: there is one quadrature point for every Quadrature, so the element pass needs no loop.
  static constexpr bool kSinglePoint = true;

  /// The reference shape is the tetrahedron 0, e_x, e_y, e_z.
  static void values(const Vec3<double>& r, double (&n)[kNodes]) {
    n[0] = 1 - r[0] - r[1] - r[2];
    for (int k = 0; k < 3; ++k) n[k + 1] = r[k];
  }
  static void gradients(const Vec3<double>& /*r*/, Vec3<double> (&dn)[kNodes]) {
    dn[0] = Vec3<double>::Constant(-1);
    for (int k = 0; k < 3; ++k) dn[k + 1] = Vec3<double>::Unit(k);
  }

  static QuadratureRule full_rule() { return {{Vec3<double>::Constant(0.25), 1.0 / 6}}; }
  /// Exact for products of two shape functions on straight-sided elements of up to second order.
  static QuadratureRule mass_rule() {
    return detail::product_rule(detail::kGauss4, [](double a, double b, double c) -> QuadraturePoint {
      return {{a, b * (1 - a), c * (1 - a) * (1 - b)}, (1 - a) * (1 - a) * (1 - b)};
    });
  }
};

}  // namespace tensormass::physics
