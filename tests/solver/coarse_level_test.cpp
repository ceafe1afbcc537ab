#include "solver/coarse_level.h"

#include <optional>
#include <set>
#include <tuple>

#include <gtest/gtest.h>

#include "support/dense_system.h"
#include "support/staged_scene.h"

/// The coarse level against dense matrices of the very same system, formed by Eigen.
namespace tensormass::solver {
namespace {

using step::StageKind;
using tests::StagedScene;

/// A ligament in steps of 10 ms: block-Jacobi needs hundreds of iterations.
constexpr tests::Beam kSlender{.cells_x = 16,
                               .cells_y = 3,
                               .cells_z = 3,
                               .size_x_m = 0.04,
                               .size_y_m = 0.005,
                               .size_z_m = 0.004,
                               .double_precision = true,
                               .young_modulus_pa = 1e6,
                               .cg_max_iterations = 3000,
                               .cg_tolerance = 1e-12};

v1::Scene scene_of(const tests::Beam& beam, std::optional<bool> coarse_level = true) {
  v1::Scene scene = tests::beam_scene(beam);
  if (coarse_level) scene.mutable_solver()->set_coarse_level(*coarse_level);
  return scene;
}

enum class Start { kAtRest, kMoving };

/// Assembles the system of a scene at rest, which starts to fall, or of one in motion.
template <class Real>
void assemble(StagedScene<Real>& staged, Start start = Start::kMoving, bool coarse = true) {
  const bool moves = start == Start::kMoving;
  Eigen::VectorXd u = tests::random_field(3 * staged.node_count(), moves ? 2e-5 : 0, 1);
  Eigen::VectorXd v = tests::random_field(3 * staged.node_count(), moves ? 0.05 : 0, 2);
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (!staged.is_fixed(node)) continue;
    u.segment<3>(3 * node).setZero();
    v.segment<3>(3 * node).setZero();
  }
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  if (coarse) staged.use_coarse_level();
  staged.run_through(StageKind::kExternalForces);
}

/// The bits of a node's free directions.
template <class Real>
std::uint32_t free_bits(const StagedScene<Real>& staged, std::uint32_t node) {
  return static_cast<std::uint32_t>(staged.model.rest[4 * std::size_t{staged.row(node)} + 3]);
}

/// Returns the matrix without fixed directions, whose diagonal is one.
template <class Real>
Eigen::MatrixXd free_matrix(const StagedScene<Real>& staged) {
  Eigen::MatrixXd a = staged.matrix();
  for (Eigen::Index i = 0; i < a.rows(); ++i) {
    if ((free_bits(staged, static_cast<std::uint32_t>(i / 3)) >> (i % 3) & 1) != 0) continue;
    a.row(i).setZero();
    a.col(i).setZero();
    a(i, i) = 1;
  }
  return a;
}

/// Returns Z by its definition: u = t + ω × x at each node of an aggregate, zero in fixed directions.
template <class Real>
Eigen::MatrixXd modes(const StagedScene<Real>& staged) {
  const model::Aggregates& aggregates = staged.model.aggregates;
  Eigen::MatrixXd z = Eigen::MatrixXd::Zero(3 * staged.node_count(), 6 * aggregates.count());
  const auto position = [&](std::uint32_t row) -> Eigen::Vector3d {
    return view::position(staged.view.state, row).template cast<double>();
  };
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    const std::uint32_t aggregate = aggregates.row_aggregate[staged.row(node)];
    const Eigen::Vector3d x = (position(staged.row(node)) - position(aggregates.center_rows[aggregate])) *
                              aggregates.inverse_sizes[aggregate];
    for (int i = 0; i < 3; ++i) {
      z.block<3, 1>(3 * node, 6 * aggregate + i) = Eigen::Vector3d::Unit(i);
      z.block<3, 1>(3 * node, 6 * aggregate + 3 + i) = Eigen::Vector3d::Unit(i).cross(x);
    }
    for (int i = 0; i < 3; ++i) {
      if ((free_bits(staged, node) >> i & 1) == 0) z.row(3 * node + i).setZero();
    }
  }
  return z;
}

/// Runs the rest of the step and returns Δv.
template <class Real>
Eigen::VectorXd solve(StagedScene<Real>& staged) {
  const Eigen::VectorXd before = staged.by_node(staged.view.state.velocity);
  for (const StageKind kind : {StageKind::kCoarseLevel, StageKind::kFactorize, StageKind::kScaleEdges,
                               StageKind::kSolve, StageKind::kAdvance}) {
    staged.run(kind);
  }
  return staged.by_node(staged.view.state.velocity) - before;
}

template <class Real>
Eigen::VectorXd dense_solution(const StagedScene<Real>& staged) {
  Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs);
  for (Eigen::Index i = 0; i < b.size(); ++i) {
    if ((free_bits(staged, static_cast<std::uint32_t>(i / 3)) >> (i % 3) & 1) == 0) b[i] = 0;
  }
  return free_matrix(staged).ldlt().solve(b);
}

/// A number of patches, and whether the matrix stores whole rows, as on a GPU.
class CoarseLevels : public testing::TestWithParam<std::tuple<std::uint32_t, bool>> {
 protected:
  static std::uint32_t patches() { return std::get<0>(GetParam()); }
  static matrix::Storage storage() {
    return std::get<1>(GetParam()) ? matrix::Storage::kRows : matrix::Storage::kEdges;
  }
};

TEST_P(CoarseLevels, FormTheMatrixOfTheRigidModes) {
  v1::Scene scene = scene_of(kSlender);
  v1::PrescribedDisplacement& sliding = *scene.mutable_bodies(0)->add_prescribed();  // free along x and z
  tests::set(*sliding.mutable_region()->mutable_box()->mutable_min_m(), 0.0399, -1, -1);
  tests::set(*sliding.mutable_region()->mutable_box()->mutable_max_m(), 0.0401, 2, 2);
  sliding.set_y_m(0);
  StagedScene<double> staged(scene, patches(), storage());
  assemble(staged);
  staged.run(StageKind::kCoarseLevel);
  const Eigen::MatrixXd z = modes(staged);
  Eigen::MatrixXd expected = z.transpose() * staged.matrix() * z;
  const Eigen::Index n = expected.rows();
  Eigen::MatrixXd c(n, n);
  for (Eigen::Index i = 0; i < n; ++i) {
    for (Eigen::Index j = 0; j < n; ++j) c(i, j) = staged.coarse.lower[i * n + j];
  }
  Eigen::MatrixXd found = c * c.transpose();
  if (storage() == matrix::Storage::kRows) {
    found = Eigen::Map<const Eigen::MatrixXd>(staged.coarse.sums, n, n).transpose().selfadjointView<Eigen::Lower>();
  }
  EXPECT_GT(staged.model.aggregates.count(), 3u);
  EXPECT_LT((found - expected).norm(), 1e-10 * expected.norm());
}

TEST_P(CoarseLevels, SolveTheSystemThatADenseFactorizationSolves) {
  StagedScene<double> staged(scene_of(kSlender), patches(), storage());
  assemble(staged);
  const Eigen::VectorXd expected = dense_solution(staged), change = solve(staged);
  EXPECT_LT((change - expected).norm(), 1e-9 * expected.norm());
  EXPECT_LE(staged.view.solve.report->relative_residual, kSlender.cg_tolerance);
}

TEST_P(CoarseLevels, TakeFarFewerIterations) {
  tests::Beam beam = kSlender;
  beam.cg_tolerance = 1e-3;
  StagedScene<double> plain(scene_of(beam), patches(), storage()), coarse(scene_of(beam), patches(), storage());
  assemble(plain, Start::kAtRest, false);
  assemble(coarse, Start::kAtRest);
  const Eigen::VectorXd expected = dense_solution(coarse);
  solve(plain);
  EXPECT_LT((solve(coarse) - expected).norm(), 1e-2 * expected.norm());
  EXPECT_GT(plain.view.solve.report->iterations, 200u);
  EXPECT_LT(coarse.view.solve.report->iterations, 60u);
}

/// The residual that a solve reports is close to the error in energy, which is what its tolerance bounds.
TEST_P(CoarseLevels, ReportTheErrorInEnergy) {
  for (const double tolerance : {1e-1, 1e-2, 1e-4}) {
    tests::Beam beam = kSlender;
    beam.cg_tolerance = tolerance;
    StagedScene<double> staged(scene_of(beam), patches(), storage());
    assemble(staged, Start::kAtRest);
    const Eigen::MatrixXd a = free_matrix(staged);
    const Eigen::VectorXd expected = dense_solution(staged), error = solve(staged) - expected;
    const double share = std::sqrt(error.dot(a * error) / expected.dot(a * expected));
    EXPECT_LT(share, 3 * staged.view.solve.report->relative_residual);
    EXPECT_GT(share, staged.view.solve.report->relative_residual / 10);
  }
}

TEST_P(CoarseLevels, SolveInFloat) {
  // The same system in double precision is the reference: in float, the matrix itself is off.
  tests::Beam beam = kSlender;
  StagedScene<double> exact(scene_of(beam), patches(), storage());
  assemble(exact, Start::kAtRest);
  const Eigen::VectorXd expected = dense_solution(exact);
  beam.double_precision = false;
  beam.cg_tolerance = 1e-4;
  StagedScene<float> staged(scene_of(beam), patches(), storage()), rounded(scene_of(beam), patches(), storage());
  assemble(staged, Start::kAtRest);
  assemble(rounded, Start::kAtRest);
  EXPECT_LT((solve(staged) - expected).norm(), 2e-3 * expected.norm());
  EXPECT_GT((dense_solution(rounded) - expected).norm(), 5e-4 * expected.norm()) << "rounding matters here";
}

TEST_P(CoarseLevels, RepeatBitwise) {
  tests::Beam beam = kSlender;
  beam.double_precision = false;
  beam.cg_tolerance = 1e-3;
  StagedScene<float> first(scene_of(beam), patches(), storage());
  assemble(first);
  const Eigen::VectorXd expected = solve(first);
  for (int round = 0; round < 3; ++round) {
    StagedScene<float> again(scene_of(beam), patches(), storage());
    assemble(again);
    EXPECT_EQ(solve(again), expected);
  }
}

TEST_P(CoarseLevels, StartAlongTheLastSolution) {
  StagedScene<double> first(scene_of(kSlender), patches(), storage());
  assemble(first);
  const Eigen::VectorXd expected = solve(first), last = first.by_node(first.view.solve.solution);
  for (const Eigen::VectorXd& start :
       {Eigen::VectorXd(-0.3 * last), Eigen::VectorXd(tests::random_field(last.size(), 1, 7)),
        Eigen::VectorXd(Eigen::VectorXd::Zero(last.size()))}) {
    StagedScene<double> staged(scene_of(kSlender), patches(), storage());
    assemble(staged);
    staged.put(staged.view.solve.kept, start);
    staged.inputs.control->starts_from_last = 1;
    EXPECT_LT((solve(staged) - expected).norm(), 1e-9 * expected.norm());
  }
}

TEST_P(CoarseLevels, ServeTwoBodiesOfDifferentWeight) {
  v1::Scene scene = scene_of(kSlender);
  v1::Body& heavy = *scene.add_bodies() = scene.bodies(0);
  heavy.set_name("heavy");
  heavy.set_density_kg_per_m3(1e5);
  heavy.clear_fixed();  // falls freely: its rigid motion resists by inertia alone
  StagedScene<double> staged(scene, patches(), storage());
  assemble(staged);
  const Eigen::VectorXd expected = dense_solution(staged), change = solve(staged);
  const Eigen::Index half = expected.size() / 2;
  EXPECT_LT((change - expected).head(half).norm(), 1e-7 * expected.head(half).norm());
  EXPECT_LT((change - expected).tail(half).norm(), 1e-7 * expected.tail(half).norm());
}

TEST_P(CoarseLevels, AnswerZeroForNothingToDo) {
  StagedScene<double> staged(scene_of(kSlender), patches(), storage());
  assemble(staged);
  staged.put(staged.view.matrix.rhs, Eigen::VectorXd::Zero(3 * staged.node_count()));
  EXPECT_EQ(solve(staged).norm(), 0);
  EXPECT_EQ(staged.view.solve.report->iterations, 0u);
}

INSTANTIATE_TEST_SUITE_P(Patches, CoarseLevels, testing::Combine(testing::Values(1u, 2u, 5u), testing::Bool()));

TEST(Aggregates, AreCompactPiecesOfOneBody) {
  v1::Scene scene = scene_of(kSlender);
  v1::Body& other = *scene.add_bodies() = scene.bodies(0);
  other.set_name("other");
  const model::Model model = tests::compile_into(scene, 3, matrix::Storage::kEdges);
  std::vector<std::set<std::size_t>> bodies(model.aggregates.count());
  std::vector<std::uint32_t> sizes(model.aggregates.count());
  for (std::uint32_t node = 0; node < model.layout.row_of_node.size(); ++node) {
    const std::uint32_t aggregate = model.aggregates.row_aggregate[model.layout.row_of_node[node]];
    ASSERT_LT(aggregate, model.aggregates.count());
    bodies[aggregate].insert(model::body_of_node(model.bodies, node));
    ++sizes[aggregate];
  }
  for (std::size_t a = 0; a < sizes.size(); ++a) {
    EXPECT_EQ(bodies[a].size(), 1u);
    EXPECT_GT(sizes[a], 20u);
    EXPECT_LT(sizes[a], 120u);
    EXPECT_EQ(model.aggregates.row_aggregate[model.aggregates.center_rows[a]], a);
  }
}

TEST(Aggregates, ExistOnlyIfASolveMayUseThem) {
  const auto count = [](const tests::Beam& beam, std::optional<bool> level) {
    return tests::compile_into(scene_of(beam, level), 1, matrix::Storage::kEdges).aggregates.count();
  };
  tests::Beam beam = kSlender;
  beam.cg_tolerance = 1e-6;
  EXPECT_GT(count(beam, std::nullopt), 0u);
  EXPECT_EQ(count(beam, false), 0u);
  beam.cg_max_iterations = model::kCoarseFromIterations;
  EXPECT_EQ(count(beam, std::nullopt), 0u) << "no solve takes so many iterations";
  EXPECT_GT(count(beam, true), 0u);
  beam = kSlender;
  beam.cg_tolerance = 0;
  EXPECT_EQ(count(beam, std::nullopt), 0u) << "the scene asks for a number of iterations";
  beam.cg_tolerance = 1e-9;
  EXPECT_EQ(count(beam, std::nullopt), 0u) << "rounding decides how far a solve comes";
  EXPECT_GT(count(beam, true), 0u);
}

}  // namespace
}  // namespace tensormass::solver
