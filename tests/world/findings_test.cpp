#include "world/findings.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/laws.h"
#include "support/scenes.h"

namespace tensormass::world {
namespace {

class FindingsOf : public tests::OnBackend {
 protected:
  /// A bar whose end is moved by `turn` in z and `press` in x, at equilibrium, and its findings.
  v1::SceneStatus after(const std::string& law, double turn, double press, std::uint32_t newton_max_iterations = 50) {
    v1::Scene scene = tests::beam_scene({.cells_x = 6,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .size_x_m = 0.6,
                                         .size_y_m = 0.1,
                                         .size_z_m = 0.1,
                                         .double_precision = true,
                                         .cg_max_iterations = 2000,
                                         .cg_tolerance = 1e-8});
    scene.clear_gravity_m_per_s2();
    scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    scene.mutable_solver()->set_newton_tolerance(1e-6);
    scene.mutable_solver()->set_newton_max_iterations(newton_max_iterations);
    scene.mutable_solver()->set_allow_unconverged(true);
    v1::Body& body = *scene.mutable_bodies(0);
    *body.mutable_law() = tests::law(law, 1e5, 0.3);
    v1::PrescribedDisplacement& end = *body.add_prescribed();
    tests::set(*end.mutable_region()->mutable_box()->mutable_min_m(), 0.6 - 1e-6, -1, -1);
    tests::set(*end.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    end.set_x_m(-press);
    end.set_z_m(turn);
    const auto world = start(scene);
    const IterationBudget budget(world->model());
    Findings findings(world->shared_model(), budget);
    EXPECT_TRUE(world->step(false));
    world->diagnose();
    findings.take_step(*world);
    findings.take_diagnostics(*world);
    v1::SceneStatus status;
    findings.add_to(status);
    findings.clear();
    v1::SceneStatus cleared;
    findings.add_to(cleared);
    EXPECT_EQ(cleared.warnings_size(), 0);
    EXPECT_EQ(cleared.min_det_f(), 1);
    EXPECT_EQ(cleared.unconverged_steps(), 0u);
    return status;
  }
  static bool says(const v1::SceneStatus& status, const std::string& part) {
    return std::any_of(status.warnings().begin(), status.warnings().end(),
                       [&](const std::string& line) { return line.find(part) != std::string::npos; });
  }
};

TEST_P(FindingsOf, ALinearLawThatLeftItsRangeGivesAWarning) {
  EXPECT_EQ(after("hooke", 0.005, 0).warnings_size(), 0) << "a small deflection is what it is for";
  const v1::SceneStatus turned = after("hooke", 0.2, 0);
  EXPECT_TRUE(says(turned, "body 'beam': hooke has left its range"));
  EXPECT_TRUE(says(turned, "rotation"));
  EXPECT_EQ(after("corotational", 0.2, 0).warnings_size(), 0) << "rotation is nothing to it";
}

TEST_P(FindingsOf, InvertedElementsGiveAWarning) {
  const v1::SceneStatus crushed = after("hooke", 0, 0.7);
  EXPECT_LT(crushed.min_det_f(), 0);
  EXPECT_TRUE(says(crushed, "elements are inverted"));
  EXPECT_TRUE(says(crushed, "only corotational and stable_neo_hookean recover by themselves"));
}

TEST_P(FindingsOf, SolvesThatEndAboveTheirToleranceAreAFindingWhileTheyDo) {
  for (const std::uint32_t most : {3u, 1000u}) {
    const auto world = start(
        tests::beam_scene({.cells_x = 6, .cells_y = 2, .cells_z = 2, .cg_max_iterations = most, .cg_tolerance = 1e-4}));
    const IterationBudget budget(world->model());
    Findings findings(world->shared_model(), budget);
    EXPECT_TRUE(world->step(false));
    findings.take_step(*world);
    v1::SceneStatus status;
    findings.add_to(status);
    EXPECT_EQ(says(status, "1 of the last 1 solves ended above cg_tolerance = 0.0001, the last one after 3 iterations"),
              most == 3);
  }
}

TEST_P(FindingsOf, ASolveThatEndsAboveItsToleranceSaysHowFarItFellShort) {
  // A ligament in the first step of a fall. It should move by up to 0.98 mm; 20 iterations make a small part.
  v1::Scene scene = tests::beam_scene({.cells_x = 20,
                                       .size_x_m = 0.04,
                                       .size_y_m = 0.005,
                                       .size_z_m = 0.004,
                                       .cg_max_iterations = 20,
                                       .cg_tolerance = 1e-4});
  const auto world = start(scene);
  const IterationBudget budget(world->model());
  Findings findings(world->shared_model(), budget);
  EXPECT_TRUE(world->step(false));
  findings.take_step(*world);
  v1::SceneStatus status;
  findings.add_to(status);
  double error_mm = 0, force_n = 0;
  std::string message;
  for (const v1::Finding& finding : status.findings()) {
    if (finding.code() == v1::FINDING_CODE_SOLVE_ABOVE_TOLERANCE) message = finding.message();
  }
  const std::size_t begin = message.find(", by about ");
  ASSERT_NE(begin, std::string::npos) << message;
  const char* const form = ", by about %lf mm in a step, and forces on bodies are off by up to about %lf N";
  ASSERT_EQ(std::sscanf(message.c_str() + begin, form, &error_mm, &force_n), 2) << message;
  scene.mutable_solver()->set_precision(v1::Solver::PRECISION_DOUBLE);
  scene.mutable_solver()->set_cg_max_iterations(5000);
  scene.mutable_solver()->set_cg_tolerance(1e-10);
  const auto exact = start(scene);
  EXPECT_TRUE(exact->step(false));
  const std::vector<double> found = world->save().tissue.displacement, expected = exact->save().tissue.displacement;
  double worst_mm = 0;
  for (std::size_t i = 0; i < found.size(); ++i) worst_mm = std::max(worst_mm, 1e3 * std::abs(found[i] - expected[i]));
  EXPECT_GT(worst_mm, 0.3);
  EXPECT_GT(error_mm, worst_mm / 4);
  EXPECT_LT(error_mm, worst_mm * 4);
  EXPECT_GT(force_n, 0);
  EXPECT_LT(force_n, 10 * 0.0008 * 9.81) << "ten times its weight";
  EXPECT_NEAR(1e3 * status.solve_displacement_error_m(), error_mm, 0.35 * error_mm) << "the message rounds";
  EXPECT_NEAR(status.solve_force_error_n(), force_n, 0.35 * force_n);
  // A solve that reached its tolerance, and one without a tolerance.
  Findings of_exact(exact->shared_model(), budget);
  of_exact.take_step(*exact);
  v1::SceneStatus good;
  of_exact.add_to(good);
  EXPECT_TRUE(good.has_solve_displacement_error_m());
  EXPECT_EQ(good.solve_displacement_error_m(), 0);
  EXPECT_EQ(good.solve_force_error_n(), 0);
  scene.mutable_solver()->set_cg_tolerance(0);
  const auto without = start(scene);
  Findings of_without(without->shared_model(), budget);
  EXPECT_TRUE(without->step(false));
  of_without.take_step(*without);
  v1::SceneStatus unknown;
  of_without.add_to(unknown);
  EXPECT_FALSE(unknown.has_solve_displacement_error_m());
}

TEST_P(FindingsOf, HalfOfTheSolvesMayEndAboveTheirTolerance) {
  const auto world = start(
      tests::beam_scene({.cells_x = 6, .cells_y = 2, .cells_z = 2, .cg_max_iterations = 1000, .cg_tolerance = 1e-4}));
  const IterationBudget budget(world->model());
  Findings findings(world->shared_model(), budget);
  const auto found = [&](std::uint32_t limit) {
    world->set_cg_limit(limit);
    EXPECT_TRUE(world->step(false));
    findings.take_step(*world);
    v1::SceneStatus status;
    findings.add_to(status);
    return std::any_of(status.findings().begin(), status.findings().end(), [](const v1::Finding& finding) {
      return finding.code() == v1::FINDING_CODE_SOLVE_ABOVE_TOLERANCE;
    });
  };
  for (int i = 0; i < 2; ++i) EXPECT_FALSE(found(1000));
  for (int i = 0; i < 2; ++i) EXPECT_FALSE(found(1)) << "two of four at most";
  EXPECT_TRUE(found(1));
  EXPECT_FALSE(found(1000)) << "three of six";
}

TEST_P(FindingsOf, AcceptedByTheSceneAreMarkedAndGiveNoWarning) {
  v1::Scene scene =
      tests::beam_scene({.cells_x = 6, .cells_y = 2, .cells_z = 2, .cg_max_iterations = 3, .cg_tolerance = 1e-4});
  v1::AcceptedFinding& accepted = *scene.add_accepted_findings();
  accepted.set_code(v1::FINDING_CODE_SOLVE_ABOVE_TOLERANCE);
  accepted.set_reason("a test");
  const auto world = start(scene);
  const IterationBudget budget(world->model());
  Findings findings(world->shared_model(), budget);
  EXPECT_TRUE(world->step(false));
  findings.take_step(*world);
  v1::SceneStatus status;
  findings.add_to(status);
  ASSERT_EQ(status.findings_size(), 2) << "the beam is 8 m long";
  EXPECT_EQ(status.findings(0).code(), v1::FINDING_CODE_MESH_UNIT);
  EXPECT_EQ(status.findings(0).accepted(), "");
  EXPECT_EQ(status.findings(1).accepted(), "a test");
  EXPECT_EQ(status.warnings_size(), 0) << "that of the load is in the report";
}

TEST_P(FindingsOf, StepsThatAreAlwaysRepeatedGiveAWarning) {
  v1::Scene scene =
      tests::beam_scene({.cells_x = 6, .cells_y = 2, .cells_z = 2, .cg_max_iterations = 1000, .cg_tolerance = 1e-4});
  scene.mutable_solver()->set_floor_tolerance(1e-2);
  for (const std::uint32_t limit : {1u, 1000u}) {
    const auto world = start(scene);
    const IterationBudget budget(world->model());
    Findings findings(world->shared_model(), budget);
    world->set_cg_limit(limit);
    for (int i = 0; i < 64; ++i) {
      ASSERT_TRUE(world->step(false));
      findings.take_step(*world);
    }
    v1::SceneStatus status;
    findings.add_to(status);
    EXPECT_EQ(says(status, "64 of 64 steps left their bounds (the linear solve ended at a residual of"), limit == 1);
    EXPECT_EQ(status.warnings_size(), limit == 1 ? 1 : 0);
  }
}

TEST_P(FindingsOf, AStepThatDidNotConvergeGivesAWarningAndIsCounted) {
  const v1::SceneStatus status = after("st_venant_kirchhoff", 0.1, 0, 2);
  EXPECT_EQ(status.unconverged_steps(), 1u);
  EXPECT_GT(status.newton_residual(), 0);
  EXPECT_TRUE(says(status, "newton_max_iterations"));
  EXPECT_EQ(after("st_venant_kirchhoff", 0.1, 0).unconverged_steps(), 0u);
}

TM_ON_EACH_BACKEND(FindingsOf);

}  // namespace
}  // namespace tensormass::world
