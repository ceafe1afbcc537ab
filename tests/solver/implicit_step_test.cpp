#include <gtest/gtest.h>

#include "solver/time_scheme.h"
#include "support/dense_system.h"
#include "support/staged_scene.h"

namespace tensormass::solver {
namespace {

using tests::StagedScene;

/// For a linear law one implicit step is exact: M (v₁ − v₀)/dt + C v₁ + K u₁ = f_ext and u₁ = u₀ + dt v₁. The test
/// evaluates these definitions, not the system that was solved.
TEST(ImplicitStep, SatisfiesTheEquationOfMotionAtItsEnd) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .linear = true,
                                       .double_precision = true,
                                       .cg_max_iterations = 2000,
                                       .cg_tolerance = 1e-14});
  scene.mutable_bodies(0)->clear_fixed();
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(0.8);
  scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.02);
  StagedScene<double> staged(scene, 2);
  const Eigen::Index size = 3 * staged.node_count();
  const Eigen::VectorXd u0 = tests::random_field(size, 0.02, 1), v0 = tests::random_field(size, 1, 2);
  staged.put(staged.view.state.displacement, u0);
  staged.put(staged.view.state.velocity, v0);
  staged.step();
  const Eigen::VectorXd u1 = staged.by_node(staged.view.state.displacement),
                        v1 = staged.by_node(staged.view.state.velocity);
  const double dt = staged.model.dt_s;
  EXPECT_LT((u1 - u0 - dt * v1).norm(), 1e-14 * u1.norm());

  const tests::DenseSystem system = tests::dense_system(scene, u1);  // force at the end of the step: −K u₁
  const Eigen::VectorXd inertia = (system.mass.array() * (v1 - v0).array() / dt).matrix();
  const Eigen::VectorXd damping = (0.8 * system.mass.array() * v1.array()).matrix() + 0.02 * system.k * v1;
  const Eigen::VectorXd residual = inertia + damping - system.force - system.gravity;
  EXPECT_LT(residual.norm(), 1e-9 * (inertia.norm() + damping.norm() + system.force.norm()));
}

/// The inversion check reads the current positions of nodes, after a whole increment and after a part of it.
TEST(Advance, StoresPositionsThatMatchTheDisplacement) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2});
  scene.mutable_solver()->set_newton_max_iterations(5);
  StagedScene<float> staged(scene, 2);
  ASSERT_NE(staged.view.guard.relative_position, nullptr);
  const auto expect_same = [&] {
    float most = 0;
    for (std::uint32_t row = 0; row < staged.view.patches.row_count; ++row) {
      const Vec3<float> u = view::load3<float>(staged.view.state.displacement, row);
      const Vec3<float> x = view::relative_rest(staged.view.state, row) + u;
      EXPECT_EQ(view::load3<float>(staged.view.guard.relative_position, row), x) << row;
      most = std::max(most, u.norm());
    }
    return most;
  };
  staged.put(staged.view.newton.increment, tests::random_field(3 * staged.node_count(), 1, 1));
  view::NewtonControl& newton = *staged.inputs.newton;
  newton = {.projects_stiffness = 1, .begins_step = 1, .line_share = 0.25F};
  staged.run_through(step::StageKind::kAdvance);
  EXPECT_GT(expect_same(), 0);
  staged.put(staged.view.newton.increment, tests::random_field(3 * staged.node_count(), 1, 1));
  staged.run(step::StageKind::kBacktrack);
  EXPECT_GT(expect_same(), 1e-3F);
}

TEST(Advance, ReportsTheFastestNodeOfEachPatch) {
  StagedScene<double> staged(tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2}), 3);
  Eigen::VectorXd v = Eigen::VectorXd::Zero(3 * staged.node_count());
  const std::uint32_t node = 20;
  v.segment<3>(3 * node) = Vec3<double>(3, 4, 12);
  staged.put(staged.view.state.velocity, v);
  staged.run(step::StageKind::kAdvance);  // nothing was solved: the velocity stays
  const std::uint32_t owner = staged.model.layout.patch_of_row(staged.row(node));
  for (std::uint32_t patch = 0; patch < 3; ++patch) {
    EXPECT_NEAR(staged.view.guard.patch_reports[patch].max_speed_m_per_s, patch == owner ? 13 : 0, 1e-12);
    EXPECT_EQ(staged.view.guard.patch_reports[patch].finite, 1);
  }
}

/// Infinity and absurd speeds stop a scene as NaN does.
TEST(Advance, ReportsThePatchOfNanInfinityAndAbsurdSpeeds) {
  for (const double value : {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), 1e16}) {
    StagedScene<double> staged(tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2}), 3);
    Eigen::VectorXd v = Eigen::VectorXd::Zero(3 * staged.node_count());
    v[3 * 20 + 2] = value;
    staged.put(staged.view.state.velocity, v);
    staged.run(step::StageKind::kAdvance);
    const std::uint32_t owner = staged.model.layout.patch_of_row(staged.row(20));
    for (std::uint32_t patch = 0; patch < 3; ++patch) {
      EXPECT_EQ(staged.view.guard.patch_reports[patch].finite, patch == owner ? 0 : 1) << value;
    }
  }
}

}  // namespace
}  // namespace tensormass::solver
