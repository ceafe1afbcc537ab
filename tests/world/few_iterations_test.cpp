#include <cmath>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"
#include "world/world.h"

/// Scenes whose linear solves end long before they converge, as those of fine meshes do at a fixed number of
/// iterations.
namespace tensormass::world {
namespace {

class FewIterations : public tests::OnBackend {
 protected:
  /// Positions do not need double precision here, but it lets conjugate gradients converge in the reference.
  static constexpr tests::Beam kBeam{.cells_x = 40, .cells_y = 5, .cells_z = 4, .double_precision = true};

  std::vector<double> after_fall(std::uint32_t iterations) {
    tests::Beam beam = kBeam;
    beam.cg_max_iterations = iterations;
    beam.cg_tolerance = 1e-8;
    const auto world = start(tests::beam_scene(beam));
    for (int step = 0; step < 40; ++step) EXPECT_TRUE(world->step(false));
    return world->state().displacement;
  }
};

/// Each solve starts along the last step's solution. Started at zero, eight iterations a step are 13 % off.
TEST_P(FewIterations, FollowTheConvergedMotion) {
  const std::vector<double> few = after_fall(8), converged = after_fall(2000);
  double difference = 0, size = 0;
  for (std::size_t i = 0; i < few.size(); ++i) {
    difference += (few[i] - converged[i]) * (few[i] - converged[i]);
    size += converged[i] * converged[i];
  }
  EXPECT_LT(std::sqrt(difference / size), 0.01);
}

/// A solve that started *at* the last step's solution instead of searching along it would let this bar explode.
TEST_P(FewIterations, OfAStiffBarAddNoEnergy) {
  tests::Beam beam = kBeam;
  beam.linear = true;
  beam.young_modulus_pa = 1e9;
  beam.poisson_ratio = 0.49;
  beam.cg_max_iterations = 20;
  const auto world = start(tests::beam_scene(beam));
  for (int step = 0; step < 150; ++step) ASSERT_TRUE(world->step(false)) << "step " << step;
  world->diagnose();
  ASSERT_TRUE(world->energy().dissipated_j().has_value());
  EXPECT_GE(*world->energy().dissipated_j(), 0);
}

TM_ON_EACH_BACKEND(FewIterations);

}  // namespace
}  // namespace tensormass::world
