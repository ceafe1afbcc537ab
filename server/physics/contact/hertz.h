#pragma once

#include <cmath>

namespace tensormass::physics {

/// dF/dδ of a rigid sphere pressed into an elastic half-space, at the depth where it carries `force_n` [N/m].
///
/// Hertz: F = 4/3 E* √R δ^(3/2), so dF/dδ = 2 E* √(R δ), with E* = E / (1 − ν²) (Johnson, Contact Mechanics, 1985,
/// section 4.2). For thick soft tissue this is the static stiffness that a hand feels at the tool; a thin or clamped
/// organ is stiffer, and the next step's force corrects for it.
inline double hertz_tangent_stiffness(double force_n, double plane_strain_modulus_pa, double radius_m) {
  if (!(force_n > 0)) return 0;
  const double scale = 4.0 / 3.0 * plane_strain_modulus_pa * std::sqrt(radius_m);
  const double depth_m = std::pow(force_n / scale, 2.0 / 3.0);
  return 2 * plane_strain_modulus_pa * std::sqrt(radius_m * depth_m);
}

}  // namespace tensormass::physics
