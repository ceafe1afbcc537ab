#pragma once

#include <array>

#include "physics/lists.h"

/// Parameters to test the laws of physics/lists.h with.
namespace tensormass::physics::testing {

inline constexpr double kYoungModulusPa = 4e3, kPoissonRatio = 0.4;

/// What a law stores, of the moduli above where it is given by these. A law with numbers of its own needs a line here.
template <class Law>
std::array<double, Law::kParameterCount> parameters() {
  return Law::parameters(kYoungModulusPa, kPoissonRatio);
}

}  // namespace tensormass::physics::testing
