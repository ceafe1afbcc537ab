#include "world/iteration_budget.h"

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/scenes.h"

namespace tensormass::world {
namespace {

/// At most 100 iterations, at least 20; a budget of 10 ms.
model::Model model_with(double floor_tolerance = 0) {
  v1::Scene scene = tests::block_with_probe(false, 2);
  scene.mutable_solver()->set_cg_max_iterations(100);
  scene.mutable_solver()->set_cg_tolerance(1e-4);
  scene.mutable_solver()->set_budget_s(0.01);
  scene.mutable_solver()->set_floor_cg_iterations(20);
  if (floor_tolerance > 0) scene.mutable_solver()->set_floor_tolerance(floor_tolerance);
  return std::move(model::compile(scene, {1, 1}).value());
}

/// Steps of a machine that takes `fixed_s` plus `iteration_s` for each iteration within the limit.
void run(IterationBudget& budget, int steps, double fixed_s, double iteration_s, double residual = 0,
         std::uint32_t needed = 1000) {
  for (int i = 0; i < steps; ++i) {
    const std::uint32_t used = std::min(budget.limit(), needed);
    budget.take_step(fixed_s + used * iteration_s, {.cg_iterations = used, .cg_relative_residual = residual});
  }
}

TEST(IterationBudget, KeepsTheLimitIfStepsAreShort) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  EXPECT_EQ(budget.limit(), 100u);
  run(budget, 200, 1e-3, 5e-5);
  EXPECT_EQ(budget.limit(), 100u);
}

TEST(IterationBudget, LowersTheLimitUntilStepsMeetTheBudgetAndRaisesItAgain) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  run(budget, 400, 2e-3, 2e-4);  // 40 iterations are 10 ms
  EXPECT_LE(budget.limit(), 40u);
  EXPECT_GE(budget.limit(), 30u) << "and no lower than it must";
  EXPECT_LE(budget.step_s(), 0.01);
  const std::uint32_t settled = budget.limit();
  run(budget, 100, 2e-3, 2e-4);
  EXPECT_EQ(budget.limit(), settled) << "it rests between room and budget";
  run(budget, 400, 1e-3, 2e-5);
  EXPECT_EQ(budget.limit(), 100u);
}

TEST(IterationBudget, NeverLeavesTheFloor) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  run(budget, 2000, 1, 1);
  EXPECT_EQ(budget.limit(), 20u);
  EXPECT_GT(budget.step_s(), 0.01) << "which the status then says";
}

TEST(IterationBudget, GivesUpNoAccuracyThatTheFloorNeeds) {
  const model::Model model = model_with(1e-3);
  IterationBudget budget(model);
  run(budget, 400, 1, 1, 9e-4);
  EXPECT_EQ(budget.limit(), 100u);
  run(budget, 400, 1, 1, 1e-4);
  EXPECT_EQ(budget.limit(), 20u);
  run(budget, 400, 1, 1, 9e-4);
  EXPECT_EQ(budget.limit(), 100u) << "whatever it takes";
}

TEST(IterationBudget, LowersFromTheIterationsThatASolveReallyUses) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  run(budget, 8, 0.02, 0, 0, 50);
  EXPECT_EQ(budget.limit(), 45u) << "90 of 100 would change nothing";
}

TEST(IterationBudget, ASingleLateStepChangesNothing) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  for (int i = 0; i < 50; ++i) {
    run(budget, 7, 1e-3, 0);
    run(budget, 1, 5, 0);
  }
  EXPECT_EQ(budget.limit(), 100u);
}

TEST(IterationBudget, RisesAtOnceIfAStepWasRepeatedForItsResidual) {
  const model::Model model = model_with(1e-3);
  IterationBudget budget(model);
  run(budget, 400, 1, 1, 1e-4);
  ASSERT_EQ(budget.limit(), 20u);
  // The repeated step takes all iterations: a small residual, but slow.
  const solver::StepResult again{.cg_iterations = 100, .cg_relative_residual = 1e-5};
  GuardEvent event;
  event.first.breach = Breach::kLinearResidual;
  budget.take_step(2, again, &event);
  EXPECT_EQ(budget.limit(), 30u);
  for (int i = 0; i < 10; ++i) budget.take_step(2, again, &event);
  EXPECT_EQ(budget.limit(), 100u);
  event.first.breach = Breach::kMove;
  for (int i = 0; i < 100; ++i) budget.take_step(2, again, &event);
  EXPECT_EQ(budget.limit(), 100u) << "neither fewer nor more iterations would have helped";
}

TEST(IterationBudget, StartsAgainAfterAReset) {
  const model::Model model = model_with();
  IterationBudget budget(model);
  run(budget, 100, 1, 1);
  budget.clear();
  EXPECT_EQ(budget.limit(), 100u);
  EXPECT_EQ(budget.step_s(), 0);
}

}  // namespace
}  // namespace tensormass::world
