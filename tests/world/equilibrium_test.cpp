#include <string>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/laws.h"
#include "support/scenes.h"
#include "world/world.h"

/// Quasi-static steps: loads that Newton's method reaches only in parts, and loads that have no equilibrium.
namespace tensormass::world {
namespace {

class Equilibrium : public tests::OnBackend {
 protected:
  /// A slender bar that is clamped at one end and bends under its weight.
  static v1::Scene bent_bar(double gravity_m_per_s2, const std::string& law = "neo_hookean") {
    v1::Scene scene = tests::beam_scene({.cells_x = 16,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 1,
                                         .size_y_m = 0.05,
                                         .size_z_m = 0.05,
                                         .double_precision = true});
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -gravity_m_per_s2, 0);
    *scene.mutable_bodies(0)->mutable_law() = tests::law(law, 1e5, 0.3);
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->clear_cg_max_iterations();
    scene.mutable_solver()->clear_cg_tolerance();
    return scene;
  }
  static double lowest(World& world) {
    double least = 0;
    const backend::RowState state = world.state();
    for (std::size_t row = 0; row < state.displacement.size(); row += 4) {
      least = std::min(least, state.displacement[row + 1]);
    }
    return least;
  }
};

TEST_P(Equilibrium, ALoadThatFailsAtOnceIsReachedInParts) {
  const auto at_once = start(bent_bar(60));
  ASSERT_TRUE(at_once->step(false)) << to_text(*at_once->guard_event(), at_once->model());
  ASSERT_NE(at_once->guard_event(), nullptr) << "the load is too much for one part; make it larger";
  EXPECT_GT(at_once->guard_event()->steps, 1u);
  EXPECT_TRUE(at_once->last().converged);
  const double reached = lowest(*at_once);
  ASSERT_TRUE(at_once->step(false));
  EXPECT_EQ(at_once->guard_event(), nullptr) << "the whole load acts in the next step";
  EXPECT_NEAR(lowest(*at_once), reached, 1e-4);
}

/// A phase of a step without a stage, as the end of one without tools, must not leave a thread behind: it would take
/// the next command for this one. More threads than cores make that likely.
TEST_P(Equilibrium, EndsWithAllItsThreads) {
  v1::Scene scene = bent_bar(1, "hooke");
  scene.mutable_solver()->set_cpu_threads(8);
  for (int i = 0; i < 40; ++i) {
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    ASSERT_TRUE(world->step(false));
  }
}

TEST_P(Equilibrium, AfterAResetTheLoadGrowsAgain) {
  const auto world = start(bent_bar(60));
  ASSERT_TRUE(world->step(false));
  const double first = lowest(*world);
  world->reset();
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(lowest(*world), first);
}

/// Saint-Venant-Kirchhoff's law has no equilibrium beyond the peak of its stress in compression.
TEST_P(Equilibrium, ALoadWithoutEquilibriumStopsTheScene) {
  v1::Scene scene = bent_bar(0, "st_venant_kirchhoff");
  scene.clear_gravity_m_per_s2();
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 1 - 1e-6, -1, -1);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 2, 1, 1);
  tests::set(*load.mutable_force_n(), -400, 0, 0);
  const auto world = start(scene);
  ASSERT_FALSE(world->step(false));
  ASSERT_NE(world->guard_event(), nullptr);
  EXPECT_EQ(world->step_count(), 0u);
  EXPECT_LT(world->guard_event()->reached, 1);
  EXPECT_EQ(lowest(*world), 0) << "the state before the step";
  const std::string text = to_text(*world->guard_event(), world->model());
  EXPECT_NE(text.find("of the load"), std::string::npos) << text;
  EXPECT_EQ(text.find("dt_s"), std::string::npos) << "an equilibrium knows no time: " << text;
}

TEST_P(Equilibrium, AStepThatMayStayUnconvergedIsKept) {
  v1::Scene scene = bent_bar(0.05, "stable_neo_hookean");
  scene.mutable_solver()->set_newton_max_iterations(2);
  scene.mutable_solver()->set_newton_tolerance(1e-15);
  EXPECT_FALSE(start(scene)->step(false));
  scene.mutable_solver()->set_allow_unconverged(true);
  const auto world = start(scene);
  EXPECT_TRUE(world->step(false));
  EXPECT_FALSE(world->last().converged);
}

/// Pulled to three times its length, the bar's end moves farther than the bar is long.
TEST_P(Equilibrium, AnEquilibriumMayBeFarAway) {
  v1::Scene scene = bent_bar(0, "hooke");
  scene.clear_gravity_m_per_s2();
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  tests::set(*load.mutable_region()->mutable_box()->mutable_min_m(), 1 - 1e-6, -1, -1);
  tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 2, 1, 1);
  tests::set(*load.mutable_force_n(), 500, 0, 0);
  const auto world = start(scene);
  ASSERT_TRUE(world->step(false));
  EXPECT_EQ(world->guard_event(), nullptr);
  EXPECT_GT(world->last().max_move_m, 1.5);
}

/// The default tolerances leave less than a thousandth of a linear body's deflection. In float, rounding of a slender
/// bar's forces leaves more.
TEST_P(Equilibrium, DefaultTolerancesAreAsAccurateAsTightOnes) {
  for (const bool double_precision : {false, true}) {
    double stretch[2];
    for (const bool tight : {false, true}) {
      v1::Scene scene = bent_bar(0.5, "hooke");
      if (tight || double_precision) scene.mutable_solver()->set_precision(v1::Solver::PRECISION_DOUBLE);
      if (!tight && !double_precision) scene.mutable_solver()->set_precision(v1::Solver::PRECISION_FLOAT);
      if (tight) {
        scene.mutable_solver()->set_cg_tolerance(1e-12);
        scene.mutable_solver()->set_newton_tolerance(1e-12);
      }
      const auto world = start(scene);
      ASSERT_TRUE(world->step(false));
      stretch[tight ? 1 : 0] = lowest(*world);
    }
    EXPECT_NEAR(stretch[0] / stretch[1], 1, double_precision ? 1e-5 : 5e-3);
  }
}

TM_ON_EACH_BACKEND(Equilibrium);

}  // namespace
}  // namespace tensormass::world
