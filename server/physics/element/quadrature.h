#pragma once

#include <array>
#include <cmath>
#include <vector>

#include "core/scalar.h"

/// Quadrature rules: the points where a shape's integrals are evaluated. Host only: a compiled scene holds gradients
/// and weights, not rules.
namespace tensormass::physics {

/// How an element's energy is integrated (v1::Quadrature).
enum class Quadrature : std::uint8_t {
  kFull,       ///< enough points that every deformation costs energy
  kReduced,    ///< one point with the mean gradients: cheapest, but bending modes cost no energy ("hourglasses"). Of
               ///< quadratic hexahedra 2×2×2 points: only modes of a row of single elements cost none
  kSelective,  ///< full for the deviatoric energy, reduced for the volumetric (Malkus, Hughes 1978): does not lock
               ///< near ν = 0.5. Mean gradients (Flanagan, Belytschko 1981) keep the patch test
};

/// A point of a reference shape and its weight. The weights of a rule add up to the reference volume.
struct QuadraturePoint {
  Vec3<double> at;
  double weight;
};
using QuadratureRule = std::vector<QuadraturePoint>;

namespace detail {

/// Gauss-Legendre rules on [0, 1]: {point, weight}.
inline constexpr std::array<std::array<double, 2>, 2> kGauss2{{{0.21132486540518713, 0.5}, {0.78867513459481287, 0.5}}};
inline constexpr std::array<std::array<double, 2>, 4> kGauss4{{{0.06943184420297371, 0.17392742256872692},
                                                               {0.33000947820757187, 0.32607257743127307},
                                                               {0.66999052179242813, 0.32607257743127307},
                                                               {0.93056815579702629, 0.17392742256872692}}};

/// Returns the product of a rule on [0, 1] with itself, mapped from the cube to a shape.
///
///   map(a, b, c)   returns the shape's point for a point of the cube, and as weight the density of the map
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
