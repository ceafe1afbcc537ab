#pragma once

#include "core/scalar.h"

namespace tensormass::physics {

/// Lamé parameters [Pa] of an isotropic solid.
struct Lame {
  double lambda_pa;
  double mu_pa;
};

/// λ = E ν / ((1+ν)(1−2ν)), μ = E / (2(1+ν)).
constexpr Lame lame_from_young(double young_modulus_pa, double poisson_ratio) {
  return {young_modulus_pa * poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio)),
          young_modulus_pa / (2 * (1 + poisson_ratio))};
}

/// What every isotropic law stores for an element: λ, μ [Pa].
inline constexpr int kIsotropicParameters = 2;

}  // namespace tensormass::physics
