#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "core/scalar.h"

/// Where a shape's integrals are evaluated. Host only: a compiled scene holds gradients and weights, not rules.
namespace tensormass::physics {

/// How many points an element's energy is summed over (v1::Quadrature).
enum class Quadrature : std::uint8_t {
  kFull,       ///< enough points that no deformation is free of energy
  kReduced,    ///< one point with the mean gradients: cheapest, and blind to bending modes ("hourglasses")
  kSelective,  ///< full for the change of shape, one point for the change of volume (Malkus, Hughes 1978; the mean
               ///< gradients of Flanagan, Belytschko 1981 keep the patch test): does not lock near ν = 0.5
};

/// A point of a reference shape; the weights of a rule add up to the reference volume.
struct QuadraturePoint {
  Vec3<double> at;
  double weight;
};
using QuadratureRule = std::vector<QuadraturePoint>;

namespace detail {

/// Gauss-Legendre on [0, 1].
inline constexpr std::array<std::array<double, 2>, 2> kGauss2{{{0.21132486540518713, 0.5}, {0.78867513459481287, 0.5}}};
inline constexpr std::array<std::array<double, 2>, 4> kGauss4{{{0.06943184420297371, 0.17392742256872692},
                                                               {0.33000947820757187, 0.32607257743127307},
                                                               {0.66999052179242813, 0.32607257743127307},
                                                               {0.93056815579702629, 0.17392742256872692}}};

/// The product of a rule on [0, 1] with itself, each point (a, b, c) of the cube mapped by `map` to the point and the
/// density of a shape.
template <class Line, class Map>
QuadratureRule product_rule(const Line& line, Map&& map) {
  QuadratureRule rule;
  for (const auto& [a, weight_a] : line) {
    for (const auto& [b, weight_b] : line) {
      for (const auto& [c, weight_c] : line) {
        QuadraturePoint point = map(a, b, c);
        point.weight *= weight_a * weight_b * weight_c;
        rule.push_back(point);
      }
    }
  }
  return rule;
}

}  // namespace detail

}  // namespace tensormass::physics
