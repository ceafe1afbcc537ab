#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include <gtest/gtest.h>

#include "support/scenes.h"
#include "world/world.h"

/// A stiff, slender body that falls: what the coarse level of the solve is for (solver/coarse_level.h).
namespace tensormass::tests {

/// A ligament of 40 × 5 × 4 mm in steps of 10 ms: block-Jacobi needs hundreds of iterations for the tolerance, and has
/// 100.
constexpr Beam ligament(std::uint32_t cells_x = 20, std::uint32_t cells_y = 4, std::uint32_t cells_z = 4) {
  return {.cells_x = cells_x,
          .cells_y = cells_y,
          .cells_z = cells_z,
          .size_x_m = 0.04,
          .size_y_m = 0.005,
          .size_z_m = 0.004,
          .cg_max_iterations = 100,
          .cg_tolerance = 1e-3};
}

/// coarse_level: as Solver.coarse_level; no value: by itself.
inline v1::Scene scene_of(const Beam& beam, std::optional<bool> coarse_level = {}) {
  v1::Scene scene = beam_scene(beam);
  if (coarse_level) scene.mutable_solver()->set_coarse_level(*coarse_level);
  return scene;
}

/// Returns the displacement by node after some steps.
inline std::vector<double> displacement_after(world::World& world, int steps) {
  for (int step = 0; step < steps; ++step) EXPECT_TRUE(world.step(false)) << step;
  return world.save().tissue.displacement;
}

/// Returns ‖a − b‖ / ‖b‖.
inline double relative_difference(const std::vector<double>& a, const std::vector<double>& b) {
  double difference = 0, size = 0;
  for (std::size_t i = 0; i < b.size(); ++i) {
    difference += (a[i] - b[i]) * (a[i] - b[i]);
    size += b[i] * b[i];
  }
  return std::sqrt(difference / size);
}

}  // namespace tensormass::tests
