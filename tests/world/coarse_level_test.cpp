#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include <gtest/gtest.h>

#include "backend/coarse_switch.h"
#include "support/backends.h"
#include "support/cutting.h"
#include "support/ligament.h"
#include "world/world.h"

/// When a scene's solves get a coarse level, and what it makes of a stiff, slender body.
namespace tensormass::world {
namespace {

using tests::displacement_after;
using tests::ligament;
using tests::relative_difference;
using tests::scene_of;

std::unique_ptr<World> start(const v1::Scene& scene, std::uint32_t threads = 1) {
  static const std::unique_ptr<backend::Backend> cpu = backend::make_cpu_backend(1);
  auto model = model::compile(scene, {threads, 1, matrix::Storage::kEdges});
  if (!model) throw std::runtime_error(model.error().message);
  auto world = World::create(std::make_unique<const model::Model>(std::move(*model)), *cpu);
  if (!world) throw std::runtime_error(world.error().message);
  return std::move(*world);
}

/// Reference: the same mesh and law, solved to 1e-10 in double precision without a coarse level.
std::vector<double> converged(tests::Beam beam, int steps) {
  beam.double_precision = true;
  beam.cg_max_iterations = 5000;
  beam.cg_tolerance = 1e-10;
  return displacement_after(*start(scene_of(beam, false)), steps);
}

TEST(CoarseLevel, MakesALigamentRightByDefaultFromTheFirstStep) {
  for (const int steps : {1, 10, 40}) {
    const std::vector<double> expected = converged(ligament(), steps);
    const auto world = start(scene_of(ligament())), plain = start(scene_of(ligament(), false));
    EXPECT_LT(relative_difference(displacement_after(*world, steps), expected), 0.01) << steps;
    EXPECT_LT(world->last().cg_iterations, 40u);
    EXPECT_LE(world->last().cg_relative_residual, ligament().cg_tolerance);
    if (steps > 1) continue;
    EXPECT_GT(relative_difference(displacement_after(*plain, steps), expected), 0.5);
    EXPECT_EQ(plain->last().cg_iterations, ligament().cg_max_iterations);
  }
}

TEST(CoarseLevel, LeavesTheBitsOfScenesWithShortSolves) {
  tests::Beam beam = ligament();
  beam.young_modulus_pa = 1e3;
  beam.dt_s = 1e-3;
  const auto automatic = start(scene_of(beam), 2), off = start(scene_of(beam, false), 2);
  EXPECT_EQ(displacement_after(*automatic, 30), displacement_after(*off, 30));
  EXPECT_LT(off->last().cg_iterations, model::kCoarseFromIterations);
  EXPECT_GT(off->last().cg_iterations, 2u);
}

TEST(CoarseLevel, RepeatsToTheBitAndGoesOnFromASavedState) {
  for (const std::uint32_t threads : {1u, 2u}) {
    const auto world = start(scene_of(ligament()), threads), again = start(scene_of(ligament()), threads),
               later = start(scene_of(ligament()), threads);
    EXPECT_EQ(displacement_after(*world, 5), displacement_after(*again, 5));
    const World::Saved saved = world->save();
    EXPECT_GT(saved.tissue.coarse_solves, 0u);
    later->restore(saved);
    EXPECT_EQ(displacement_after(*world, 10), displacement_after(*later, 10));
  }
}

TEST(CoarseLevel, HelpsNewtonsMethodAndEquilibria) {
  for (const bool quasi_static : {false, true}) {
    std::uint32_t iterations[2];
    std::vector<double> found[2];
    for (const bool off : {false, true}) {
      tests::Beam beam = ligament();
      beam.double_precision = true;
      beam.cg_max_iterations = 5000;
      beam.cg_tolerance = 1e-6;
      v1::Scene scene = scene_of(beam, off ? std::optional(false) : std::nullopt);
      scene.mutable_solver()->set_newton_max_iterations(30);
      if (quasi_static) scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
      const auto world = start(scene);
      found[off] = displacement_after(*world, 2);
      iterations[off] = world->last().cg_iterations;
    }
    EXPECT_LT(relative_difference(found[0], found[1]), 1e-4);
    EXPECT_LT(3 * iterations[0], iterations[1]);
  }
}

/// A cut right through the ligament makes two bodies, whose rigid motion the coarse level must not tie together.
TEST(CoarseLevel, ServesALigamentThatIsCutThrough) {
  const auto cut_in_two = [](const v1::Scene& scene) {
    tests::CutBody body(scene);
    body.move({{0.021, -0.001, -0.001}, {0.021, -0.001, 0.006}}, {{0.021, 0.006, -0.001}, {0.021, 0.006, 0.006}});
    static const std::unique_ptr<backend::Backend> cpu = backend::make_cpu_backend(1);
    auto model = model::compile(scene, {2, 1, matrix::Storage::kEdges}, {}, body.cuts());
    if (!model) throw std::runtime_error(model.error().message);
    auto world = World::create(std::make_unique<const model::Model>(std::move(*model)), *cpu);
    if (!world) throw std::runtime_error(world.error().message);
    return std::move(*world);
  };
  tests::Beam exact = ligament();
  exact.double_precision = true;
  exact.cg_max_iterations = 5000;
  exact.cg_tolerance = 1e-10;
  const auto reference = cut_in_two(scene_of(exact, false)), world = cut_in_two(scene_of(ligament()));
  const std::vector<double> expected = displacement_after(*reference, 10), found = displacement_after(*world, 10);
  EXPECT_LT(relative_difference(found, expected), 0.01);
  EXPECT_LT(world->last().cg_iterations, 60u);
  double lowest_m = 0;
  for (std::size_t i = 1; i < found.size(); i += 3) lowest_m = std::min(lowest_m, found[i]);
  EXPECT_LT(lowest_m, -0.04) << "the outer piece falls freely: 10 steps of 10 ms are 54 mm";
}

/// A body that always needs the coarse level, and then never: solves without it are ever fewer, until one is short.
TEST(CoarseSwitch, TriesEverLessOftenWhetherItIsNeeded) {
  model::Settings settings;
  backend::CoarseSwitch one;
  EXPECT_FALSE(one.is_on(settings));
  one.take_solve(model::kCoarseFromIterations, 0, backend::kCoarseByStages);
  EXPECT_FALSE(one.is_on(settings)) << "not more than the bound";
  const auto solves_until_next_trial = [&] {
    one.take_solve(model::kCoarseFromIterations + 1, 0, backend::kCoarseByStages);
    int solves = 0;
    for (; one.is_on(settings); ++solves) one.take_solve(20, 0, backend::kCoarseByStages);
    return solves;
  };
  for (const int expected : {64, 128, 256, 512, 1024, 2048, 4096, 4096}) EXPECT_EQ(solves_until_next_trial(), expected);
  backend::CoarseSwitch same(one.state());
  same.take_solve(model::kCoarseFromIterations + 1, 0, backend::kCoarseByStages);
  EXPECT_TRUE(same.is_on(settings));
  EXPECT_EQ(backend::CoarseSwitch(same.state()).state(), same.state());
  one.take_solve(40, 0, backend::kCoarseByStages);
  EXPECT_FALSE(one.is_on(settings));
  EXPECT_EQ(solves_until_next_trial(), 64) << "a short trial forgets the long ones";
  EXPECT_LE(backend::CoarseSwitch(0xFFFFFFFF).state() & 0xFFFF, 4096u) << "a saved state may say anything";
}

/// Iterations that are long by stages may be short for a fused solve.
TEST(CoarseSwitch, WeighsASolveByWhatTheLevelCosts) {
  const model::Settings settings;
  const auto turns_on = [&](std::uint32_t iterations, double error, const backend::CoarsePrice& price) {
    backend::CoarseSwitch one;
    one.take_solve(iterations, error, price);
    return one.is_on(settings);
  };
  EXPECT_TRUE(turns_on(100, 0, backend::kCoarseByStages));
  EXPECT_FALSE(turns_on(100, 0, backend::kCoarseBesideFused)) << "it reached its tolerance";
  EXPECT_FALSE(turns_on(100, 0.06, backend::kCoarseBesideFused)) << "a soft block of 43,200 tetrahedra";
  EXPECT_TRUE(turns_on(100, 0.9, backend::kCoarseBesideFused)) << "a ligament";
  EXPECT_TRUE(turns_on(600, 0, backend::kCoarseBesideFused));
  EXPECT_FALSE(turns_on(model::kCoarseFromIterations, 0.9, backend::kCoarseBesideFused))
      << "the scene asks for no more";
}

TEST(CoarseSwitch, TurnsOffAfterASolveThatFailed) {
  model::Settings settings;
  settings.cg_tolerance = 1e-2;
  const auto ends = [](double residual, bool finite, bool negative_curvature) {
    solver::StepResult result;
    result.cg_relative_residual = residual;
    result.finite = finite;
    result.negative_curvature = negative_curvature;
    return result;
  };
  const auto is_failure = [&](const solver::StepResult& result) {
    backend::CoarseSwitch one(64);
    if (!one.repeats(settings, result, true)) return false;
    int solves = 0;
    for (; !one.is_on(settings) && solves < 1000; ++solves) one.take_solve(1000, 0, backend::kCoarseByStages);
    EXPECT_EQ(solves, 257) << "off for 256 solves, and on after the next long one";
    return true;
  };
  EXPECT_FALSE(is_failure(ends(1e-3, true, false)));
  EXPECT_FALSE(is_failure(ends(0.5, true, false))) << "it ran out of iterations";
  EXPECT_TRUE(is_failure(ends(1e-3, false, false)));
  EXPECT_TRUE(is_failure(ends(1.5, true, false)));
  EXPECT_TRUE(is_failure(ends(0.5, true, true)));
  EXPECT_FALSE(is_failure(ends(1e-3, true, true)));
  backend::CoarseSwitch on(64), off;
  EXPECT_TRUE(on.repeats(settings, ends(0.5, true, false), false)) << "unsolved, and now there is a coarse level";
  EXPECT_FALSE(off.repeats(settings, ends(0.5, true, false), false));
  settings.coarse_use = model::CoarseUse::kAlways;
  EXPECT_FALSE(on.repeats(settings, ends(0.5, false, false), true)) << "the scene asks for it";
}

TEST(CoarseSwitch, DoesWhatTheSceneSays) {
  model::Settings settings;
  backend::CoarseSwitch one;
  settings.coarse_use = model::CoarseUse::kAlways;
  EXPECT_TRUE(one.is_on(settings));
  settings.coarse_use = model::CoarseUse::kNever;
  one.take_solve(1000, 0, backend::kCoarseByStages);
  EXPECT_FALSE(one.is_on(settings));
}

}  // namespace
}  // namespace tensormass::world
