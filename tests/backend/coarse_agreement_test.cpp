#include <chrono>
#include <cmath>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/cutting.h"
#include "support/ligament.h"
#include "support/ridges.h"
#include "world/world.h"

/// The coarse level on a GPU: a stiff, slender body is right by default, and everything else is as without it.
namespace tensormass {
namespace {

using tests::displacement_after;
using tests::ligament;
using tests::relative_difference;
using tests::scene_of;

std::unique_ptr<world::World> start(const backend::Backend& backend, const v1::Scene& scene,
                                    const model::SceneCuts& cuts = {}) {
  auto model = model::compile(scene, backend.patch_policy(model::requested_cpu_threads(scene)), {}, cuts);
  if (!model) throw std::runtime_error(model.error().message);
  auto world = world::World::create(std::make_unique<const model::Model>(std::move(*model)), backend);
  if (!world) throw std::runtime_error(world.error().message);
  return std::move(*world);
}

class CudaCoarseLevel : public testing::Test {
 protected:
  void SetUp() override {
    auto made = backend::make_cuda_backend();
    if (!made) GTEST_SKIP() << "no GPU here: " << made.error().message;
    cuda_ = std::move(*made);
  }
  std::unique_ptr<backend::Backend> cuda_;
  std::unique_ptr<backend::Backend> cpu_ = backend::make_cpu_backend(2);
};

/// Reference: the same mesh and law, solved to 1e-10 in double precision without a coarse level.
TEST_F(CudaCoarseLevel, MakesLigamentsRightByDefaultFromTheFirstStep) {
  for (const tests::Beam& beam : {ligament(), ligament(40, 8, 8), ligament(60, 12, 10)}) {
    const std::uint32_t tetrahedra = 6 * beam.cells_x * beam.cells_y * beam.cells_z;
    tests::Beam exact = beam;
    exact.double_precision = true;
    exact.cg_max_iterations = 20000;
    exact.cg_tolerance = 1e-10;
    const auto reference = start(*cuda_, scene_of(exact, false)), world = start(*cuda_, scene_of(beam)),
               plain = start(*cuda_, scene_of(beam, false));
    for (const int steps : {1, 9, 30}) {
      const std::vector<double> expected = displacement_after(*reference, steps);
      const double difference = relative_difference(displacement_after(*world, steps), expected);
      const double without = relative_difference(displacement_after(*plain, steps), expected);
      const std::string name = std::to_string(tetrahedra) + "_after_" + std::to_string(world->step_count());
      RecordProperty(name, std::to_string(difference) + ", without " + std::to_string(without) + ", iterations " +
                               std::to_string(world->last().cg_iterations));
      EXPECT_LT(difference, 0.01) << name;
      EXPECT_LT(world->last().cg_iterations, 60u) << name;
      EXPECT_LE(world->last().cg_relative_residual, beam.cg_tolerance) << name;
      if (world->step_count() == 1) {
        EXPECT_GT(without, 0.2) << name;
      }
    }
    using Clock = std::chrono::steady_clock;
    constexpr int kSteps = 100;
    const Clock::time_point begin = Clock::now();
    for (int step = 0; step < kSteps; ++step) ASSERT_TRUE(world->step(false));
    const std::chrono::duration<double, std::milli> elapsed = Clock::now() - begin;
    RecordProperty(std::to_string(tetrahedra) + "_ms_a_step", std::to_string(elapsed.count() / kSteps));
  }
}

TEST_F(CudaCoarseLevel, AgreesWithTheCpu) {
  for (const bool in_double : {false, true}) {
    tests::Beam beam = ligament();
    beam.double_precision = in_double;
    beam.cg_tolerance = in_double ? 1e-10 : 1e-4;
    const auto cuda = start(*cuda_, scene_of(beam, true)), cpu = start(*cpu_, scene_of(beam, true));
    EXPECT_LT(relative_difference(displacement_after(*cuda, 20), displacement_after(*cpu, 20)),
              in_double ? 1e-7 : 2e-3);
    EXPECT_NEAR(cuda->last().cg_iterations, cpu->last().cg_iterations, cpu->last().cg_iterations);
  }
}

TEST_F(CudaCoarseLevel, LeavesTheBitsOfScenesWithShortSolves) {
  tests::Beam beam = ligament();
  beam.young_modulus_pa = 1e3;
  beam.dt_s = 1e-3;
  const auto automatic = start(*cuda_, scene_of(beam)), off = start(*cuda_, scene_of(beam, false));
  EXPECT_EQ(displacement_after(*automatic, 30), displacement_after(*off, 30));
  EXPECT_LT(off->last().cg_iterations, model::kCoarseFromIterations);
  EXPECT_GT(off->last().cg_iterations, 2u);
}

TEST_F(CudaCoarseLevel, RepeatsToTheBitAndGoesOnFromASavedState) {
  for (const bool in_double : {false, true}) {
    tests::Beam beam = ligament(40, 8, 8);
    beam.double_precision = in_double;
    const auto world = start(*cuda_, scene_of(beam)), again = start(*cuda_, scene_of(beam)),
               later = start(*cuda_, scene_of(beam));
    EXPECT_EQ(displacement_after(*world, 5), displacement_after(*again, 5));
    const world::World::Saved saved = world->save();
    EXPECT_GT(saved.tissue.coarse_solves, 0u);
    later->restore(saved);
    EXPECT_EQ(displacement_after(*world, 10), displacement_after(*later, 10));
  }
}

TEST_F(CudaCoarseLevel, HelpsNewtonsMethodAndEquilibria) {
  for (const bool in_double : {false, true}) {
    for (const bool quasi_static : {false, true}) {
      std::uint32_t iterations[2];
      std::vector<double> found[2];
      for (const bool off : {false, true}) {
        tests::Beam beam = ligament();
        beam.double_precision = in_double;
        beam.cg_max_iterations = 5000;
        beam.cg_tolerance = in_double ? 1e-6 : 1e-4;
        v1::Scene scene = scene_of(beam, off ? std::optional(false) : std::nullopt);
        scene.mutable_solver()->set_newton_max_iterations(30);
        if (quasi_static) scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
        if (off && !in_double) scene.mutable_solver()->set_precision(v1::Solver::PRECISION_DOUBLE);
        const auto world = start(*cuda_, scene);
        found[off] = displacement_after(*world, 2);
        iterations[off] = world->last().cg_iterations;
      }
      EXPECT_LT(relative_difference(found[0], found[1]), in_double ? 1e-4 : 2e-2) << quasi_static;
      if (in_double) {
        EXPECT_LT(2 * iterations[0], iterations[1]) << quasi_static;
      }
    }
  }
}

/// The stages check volumes as the fused solve does, also after a change from one to the other.
TEST_F(CudaCoarseLevel, DetectsInvertedElements) {
  for (const bool coarse : {false, true}) {
    tests::Beam beam = ligament();
    beam.young_modulus_pa = 1e3;  // soft, and in short steps, so that neighbours stay where they are
    beam.dt_s = 1e-3;
    v1::Scene scene = scene_of(beam, coarse);
    v1::PrescribedDisplacement& pushed = *scene.mutable_bodies(0)->add_prescribed();
    tests::set(*pushed.mutable_region()->mutable_box()->mutable_min_m(), 0.0199, 0.0024, 0.0019);
    tests::set(*pushed.mutable_region()->mutable_box()->mutable_max_m(), 0.0201, 0.0026, 0.0021);
    pushed.set_x_m(0.006);
    pushed.set_y_m(0);
    pushed.set_z_m(0);
    const auto world = start(*cuda_, scene);
    EXPECT_FALSE(world->step(false));
    ASSERT_NE(world->guard_event(), nullptr);
    EXPECT_EQ(world->guard_event()->first.breach, world::Breach::kVolume);
    EXPECT_LT(world->guard_event()->first.value, -0.1);
  }
}

/// Bodies that touch: their links are outside of the coarse matrix.
TEST_F(CudaCoarseLevel, ServesBodiesThatTouch) {
  tests::Ridges ridges;
  ridges.gap_m = 0.002;
  ridges.yaw = 1.1;
  ridges.friction = 0.3;
  ridges.dt_s = 0.005;
  v1::Scene scene = tests::crossed_ridges(ridges);
  scene.mutable_solver()->set_cg_tolerance(1e-5);
  scene.mutable_solver()->set_cg_max_iterations(400);
  scene.mutable_solver()->set_coarse_level(true);
  const auto cuda = start(*cuda_, scene), again = start(*cuda_, scene), cpu = start(*cpu_, scene);
  const std::vector<double> found = displacement_after(*cuda, 60);
  EXPECT_EQ(found, displacement_after(*again, 60)) << "it repeats bitwise";
  EXPECT_LT(relative_difference(found, displacement_after(*cpu, 60)), 1e-3);
}

/// A cut right through the ligament makes two bodies. Patches then have rows of both.
TEST_F(CudaCoarseLevel, ServesALigamentThatIsCutThrough) {
  tests::Beam exact = ligament();
  exact.double_precision = true;
  exact.cg_max_iterations = 20000;
  exact.cg_tolerance = 1e-10;
  tests::CutBody body(scene_of(ligament()));
  body.move({{0.021, -0.001, -0.001}, {0.021, -0.001, 0.006}}, {{0.021, 0.006, -0.001}, {0.021, 0.006, 0.006}});
  const auto reference = start(*cuda_, scene_of(exact, false), body.cuts()),
             world = start(*cuda_, scene_of(ligament()), body.cuts());
  EXPECT_LT(relative_difference(displacement_after(*world, 10), displacement_after(*reference, 10)), 0.01);
  EXPECT_LT(world->last().cg_iterations, 60u);
}

/// Each shape, and a law with constant tensors.
TEST_F(CudaCoarseLevel, ServesAllShapes) {
  for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON, v1::SHAPE_QUADRATIC_TETRAHEDRON}) {
    for (const bool linear : {false, true}) {
      tests::Beam beam = ligament();
      beam.linear = linear;
      v1::Scene scene = scene_of(beam), exact = scene_of(beam, false);
      exact.mutable_solver()->set_precision(v1::Solver::PRECISION_DOUBLE);
      exact.mutable_solver()->set_cg_max_iterations(20000);
      exact.mutable_solver()->set_cg_tolerance(1e-10);
      for (v1::Scene* const one : {&scene, &exact}) {
        one->mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(shape);
      }
      const auto world = start(*cuda_, scene), reference = start(*cuda_, exact);
      EXPECT_LT(relative_difference(displacement_after(*world, 5), displacement_after(*reference, 5)), 0.01)
          << v1::Shape_Name(shape) << (linear ? ", linear" : "");
    }
  }
}

}  // namespace
}  // namespace tensormass
