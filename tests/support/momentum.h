#pragma once

#include <cstddef>
#include <vector>

#include "world/world.h"

namespace tensormass::tests {

/// Returns the momentum of all bodies [kg m/s].
inline Vec3<double> momentum_of(world::World& world) {
  const model::Model& m = world.model();
  const std::vector<double> v = world.state().velocity;
  Vec3<double> sum = Vec3<double>::Zero();
  for (std::size_t row = 0; row < m.layout.row_count; ++row) {
    sum += m.row_mass[row] * Vec3<double>(v[4 * row], v[4 * row + 1], v[4 * row + 2]);
  }
  return sum;
}

}  // namespace tensormass::tests
