#pragma once

#include <cmath>

namespace tensormass::physics {

/// Tangent stiffness dF/dδ of a rigid sphere pressed into an elastic half-space [N/m], at the depth where it carries
/// `force_n`.
///
///   F, δ, R   force, depth, radius of the sphere
///   E*        plane-strain modulus E / (1 − ν²)
///
/// Hertz: F = 4/3 E* √R δ^(3/2), so dF/dδ = 2 E* √(R δ) (Johnson, Contact Mechanics, 1985, section 4.2).
///
/// In thick soft tissue this is the static stiffness that a hand feels at the tool. A thin or clamped organ is stiffer;
/// the next step's force corrects for that.
inline double hertz_tangent_stiffness(double force_n, double plane_strain_modulus_pa, double radius_m) {
  if (!(force_n > 0)) return 0;
  const double scale = 4.0 / 3.0 * plane_strain_modulus_pa * std::sqrt(radius_m);
  const double depth_m = std::pow(force_n / scale, 2.0 / 3.0);
  return 2 * plane_strain_modulus_pa * std::sqrt(radius_m * depth_m);
}

}  // namespace tensormass::physics
