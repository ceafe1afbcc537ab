#include "solver/conjugate_gradients.h"

#include <limits>

#include <gtest/gtest.h>

#include "support/dense_system.h"
#include "support/staged_scene.h"

/// Conjugate gradients by CPU teams against a dense factorization of the very same system.
namespace tensormass::solver {
namespace {

using step::StageKind;
using tests::StagedScene;

constexpr tests::Beam kBeam{.cells_x = 6,
                            .cells_y = 3,
                            .cells_z = 3,
                            .double_precision = true,
                            .cg_max_iterations = 2000,
                            .cg_tolerance = 1e-13};

/// The number of patches, and the storage of the matrix.
struct Cut {
  std::uint32_t patches;
  matrix::Storage storage = matrix::Storage::kEdges;
};

/// A beam in motion, ready to be solved.
template <class Real>
StagedScene<Real> assembled(Cut cut, tests::Beam beam = kBeam) {
  StagedScene<Real> staged(tests::beam_scene(beam), cut.patches, cut.storage);
  Eigen::VectorXd u = tests::random_field(3 * staged.node_count(), 0.02, 1);
  Eigen::VectorXd v = tests::random_field(3 * staged.node_count(), 0.3, 2);
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (!staged.is_fixed(node)) continue;
    u.segment<3>(3 * node).setZero();
    v.segment<3>(3 * node).setZero();
  }
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  staged.run_through(StageKind::kExternalForces);
  return staged;
}

/// Δv of free nodes from a dense factorization; zero for fixed ones.
template <class Real>
Eigen::VectorXd dense_solution(const StagedScene<Real>& staged) {
  Eigen::MatrixXd a = staged.matrix();
  Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs);
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (!staged.is_fixed(node)) continue;
    a.middleRows<3>(3 * node).setZero();
    a.middleCols<3>(3 * node).setZero();
    a.block<3, 3>(3 * node, 3 * node).setIdentity();
    b.segment<3>(3 * node).setZero();
  }
  return a.ldlt().solve(b);
}

/// Runs the rest of the step and gives Δv.
template <class Real>
Eigen::VectorXd solve(StagedScene<Real>& staged) {
  const Eigen::VectorXd before = staged.by_node(staged.view.state.velocity);
  for (const StageKind kind : {StageKind::kFactorize, StageKind::kScaleEdges, StageKind::kSolve, StageKind::kAdvance}) {
    staged.run(kind);
  }
  return staged.by_node(staged.view.state.velocity) - before;
}

class Patches : public testing::TestWithParam<Cut> {};

TEST_P(Patches, SolveTheSystemThatADenseFactorizationSolves) {
  StagedScene<double> staged = assembled<double>(GetParam());
  const Eigen::VectorXd expected = dense_solution(staged);
  const Eigen::VectorXd change = solve(staged);
  EXPECT_LT((change - expected).norm(), 1e-11 * expected.norm());
  EXPECT_LE(staged.view.solve.report->relative_residual, kBeam.cg_tolerance);
  EXPECT_GT(staged.view.solve.report->iterations, 20u);
  EXPECT_EQ(staged.view.solve.report->negative_curvature, 0u);
}

TEST_P(Patches, SolveInFloatToFloatsOwnPrecision) {
  tests::Beam beam = kBeam;
  beam.cg_tolerance = 1e-6;
  StagedScene<float> staged = assembled<float>(GetParam(), beam);
  const Eigen::VectorXd expected = dense_solution(staged);
  EXPECT_LT((solve(staged) - expected).norm(), 2e-4 * expected.norm());
}

TEST_P(Patches, KeepFixedNodesWhereTheyAre) {
  StagedScene<double> staged = assembled<double>(GetParam());
  const Eigen::VectorXd change = solve(staged), u = staged.by_node(staged.view.state.displacement);
  std::uint32_t fixed = 0;
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (!staged.is_fixed(node)) {
      EXPECT_GT(change.segment<3>(3 * node).norm(), 0);
      continue;
    }
    ++fixed;
    EXPECT_EQ(change.segment<3>(3 * node).norm(), 0);
    EXPECT_EQ(u.segment<3>(3 * node).norm(), 0);
  }
  EXPECT_EQ(fixed, 16u);
}

TEST_P(Patches, RepeatBitwise) {
  StagedScene<float> first = assembled<float>(GetParam());
  const Eigen::VectorXd expected = solve(first);
  for (int round = 0; round < 3; ++round) {
    StagedScene<float> again = assembled<float>(GetParam());
    EXPECT_EQ(solve(again), expected);
    EXPECT_EQ(again.view.solve.report->iterations, first.view.solve.report->iterations);
  }
}

/// The heavy body alone would be solved in a few iterations; the light one counts as much.
TEST_P(Patches, SolveALightBodyBesideAHeavyOne) {
  tests::Beam beam = kBeam;
  beam.young_modulus_pa = 1e5;
  beam.cg_tolerance = 1e-3;
  v1::Scene scene = tests::beam_scene(beam);
  v1::Body& heavy = *scene.add_bodies() = scene.bodies(0);
  heavy.set_name("heavy");
  scene.mutable_bodies(0)->set_density_kg_per_m3(10);
  heavy.set_density_kg_per_m3(1e6);
  StagedScene<double> staged(scene, GetParam().patches, GetParam().storage);
  staged.run_through(StageKind::kExternalForces);
  const Eigen::VectorXd expected = dense_solution(staged), change = solve(staged);
  const Eigen::Index half = expected.size() / 2;
  EXPECT_LT((change - expected).head(half).norm(), 1e-2 * expected.head(half).norm());
  EXPECT_LT((change - expected).tail(half).norm(), 1e-2 * expected.tail(half).norm());
}

TEST_P(Patches, ReportTheResidualThatIsLeft) {
  tests::Beam beam = kBeam;
  beam.cg_max_iterations = 12;
  beam.cg_tolerance = 0;
  StagedScene<double> staged = assembled<double>(GetParam(), beam);
  staged.run(StageKind::kFactorize);
  staged.run(StageKind::kScaleEdges);
  staged.run(StageKind::kSolve);
  EXPECT_EQ(staged.view.solve.report->iterations, 12u);

  const Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs), x = staged.by_node(staged.view.solve.solution);
  Eigen::MatrixXd scaled = staged.matrix(false);
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (!staged.is_fixed(node)) scaled.block<3, 3>(3 * node, 3 * node).setIdentity();
  }
  const double left = (b - scaled * x).norm() / b.norm();
  EXPECT_GT(left, 1e-6) << "twelve iterations do not finish";
  EXPECT_NEAR(staged.view.solve.report->relative_residual, left, 1e-6 * left);
}

TEST_P(Patches, StopAtTheToleranceAndNotLater) {
  std::uint32_t before = 0;
  for (const double tolerance : {1e-2, 1e-4, 1e-8}) {
    tests::Beam beam = kBeam;
    beam.cg_tolerance = tolerance;
    StagedScene<double> staged = assembled<double>(GetParam(), beam);
    solve(staged);
    EXPECT_LE(staged.view.solve.report->relative_residual, tolerance);
    EXPECT_GT(staged.view.solve.report->relative_residual, 1e-3 * tolerance);
    EXPECT_GT(staged.view.solve.report->iterations, before);
    before = staged.view.solve.report->iterations;
  }
}

TEST_P(Patches, ReportAnIndefiniteMatrix) {
  StagedScene<double> staged = assembled<double>(GetParam());
  staged.run(StageKind::kFactorize);
  staged.run(StageKind::kScaleEdges);
  // Off-diagonal blocks that outweigh the unit diagonal: eigenvalues of both signs.
  const std::uint32_t a = staged.row(staged.node_count() - 1), b = staged.row(staged.node_count() - 2);
  const Mat3<double> strong = 100 * Mat3<double>::Identity();
  staged.put_scaled_block(a, b, strong);
  staged.run(StageKind::kSolve);
  EXPECT_EQ(staged.view.solve.report->negative_curvature, 1u);
  EXPECT_TRUE(staged.by_node(staged.view.solve.solution).allFinite());
  EXPECT_LT(staged.view.solve.report->iterations, 100u);
}

TEST_P(Patches, AnswerZeroForNothingToDo) {
  StagedScene<double> staged = assembled<double>(GetParam());
  staged.put(staged.view.matrix.rhs, Eigen::VectorXd::Zero(3 * staged.node_count()));
  EXPECT_EQ(solve(staged).norm(), 0);
  EXPECT_EQ(staged.view.solve.report->iterations, 0u);
  EXPECT_EQ(staged.view.solve.report->relative_residual, 0);
}

/// A NaN in any patch must not look like success in the report.
TEST_P(Patches, ReportNan) {
  for (const std::uint32_t node : {5u, 60u, 111u}) {
    StagedScene<double> staged = assembled<double>(GetParam());
    Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs);
    b[3 * node + 1] = std::numeric_limits<double>::quiet_NaN();
    staged.put(staged.view.matrix.rhs, b);
    solve(staged);
    EXPECT_FALSE(solver::read_step<double>(*staged.view.solve.report, staged.model.cg_max_iterations,
                                           {staged.view.guard.patch_reports, staged.view.patches.patch_count})
                     .finite);
  }
}

/// Lets the next solve start from what `last` holds, a field of Δv before it is scaled.
template <class Real>
void start_from(StagedScene<Real>& staged, const Eigen::VectorXd& last) {
  staged.put(staged.view.solve.kept, last);
  staged.inputs.control->starts_from_last = 1;
}

TEST_P(Patches, NeedNoIterationMoreIfTheLastSolutionIsRight) {
  StagedScene<double> first = assembled<double>(GetParam());
  const Eigen::VectorXd expected = solve(first);
  for (const double length : {1.0, -0.3}) {  // the search along it finds the length
    StagedScene<double> staged = assembled<double>(GetParam());
    start_from(staged, length * first.by_node(first.view.solve.solution));
    EXPECT_LT((solve(staged) - expected).norm(), 1e-12 * expected.norm());
    EXPECT_LE(staged.view.solve.report->iterations, 3u);
  }
}

TEST_P(Patches, SolveTheSameSystemWhereverTheyStart) {
  StagedScene<double> cold = assembled<double>(GetParam());
  const Eigen::VectorXd expected = solve(cold);
  const Eigen::Index size = expected.size();
  for (const Eigen::VectorXd& last :
       {Eigen::VectorXd(tests::random_field(size, 1e3, 7)), Eigen::VectorXd(Eigen::VectorXd::Zero(size))}) {
    StagedScene<double> staged = assembled<double>(GetParam());
    start_from(staged, last);
    EXPECT_LT((solve(staged) - expected).norm(), 1e-10 * expected.norm());
    EXPECT_LE(staged.view.solve.report->relative_residual, kBeam.cg_tolerance);
  }
}

/// Each iterate has less energy ½ x·Â x − b̂·x than x = 0 has, however bad the start and however few the iterations. So
/// a solve that ends early adds no energy to a scene.
TEST_P(Patches, NeverAddEnergyByTheirStart) {
  for (const std::uint32_t iterations : {2u, 3u, 8u}) {
    tests::Beam beam = kBeam;
    beam.cg_max_iterations = iterations;
    beam.cg_tolerance = 0;
    StagedScene<double> staged = assembled<double>(GetParam(), beam);
    start_from(staged, tests::random_field(3 * staged.node_count(), 10, 7));
    staged.run(StageKind::kFactorize);
    staged.run(StageKind::kScaleEdges);
    staged.run(StageKind::kSolve);
    EXPECT_EQ(staged.view.solve.report->iterations, iterations);
    Eigen::MatrixXd scaled = staged.matrix(false);
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      if (!staged.is_fixed(node)) scaled.block<3, 3>(3 * node, 3 * node).setIdentity();
    }
    const Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs), x = staged.by_node(staged.view.solve.solution);
    EXPECT_LT(0.5 * x.dot(scaled * x) - b.dot(x), 0) << iterations << " iterations";
  }
}

TEST_P(Patches, AnswerZeroForNothingToDoWhereverTheyStart) {
  StagedScene<double> staged = assembled<double>(GetParam());
  start_from(staged, tests::random_field(3 * staged.node_count(), 1, 7));
  staged.put(staged.view.matrix.rhs, Eigen::VectorXd::Zero(3 * staged.node_count()));
  EXPECT_EQ(solve(staged).norm(), 0);
  EXPECT_EQ(staged.view.solve.report->iterations, 0u);
}

using matrix::Storage;
INSTANTIATE_TEST_SUITE_P(
    Counts, Patches, testing::Values(Cut{1}, Cut{2}, Cut{3}, Cut{8}, Cut{1, Storage::kRows}, Cut{3, Storage::kRows}),
    [](const auto& one) {
      return std::to_string(one.param.patches) + (one.param.storage == Storage::kRows ? "_rows" : "_edges");
    });

TEST(PatchCounts, AgreeToRounding) {
  StagedScene<double> one = assembled<double>({1});
  const Eigen::VectorXd expected = solve(one);
  for (const std::uint32_t patches : {2u, 4u, 9u}) {
    StagedScene<double> several = assembled<double>({patches});
    EXPECT_LT((solve(several) - expected).norm(), 1e-11 * expected.norm()) << patches << " patches";
  }
}

}  // namespace
}  // namespace tensormass::solver
