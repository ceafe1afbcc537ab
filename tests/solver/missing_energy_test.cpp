#include "solver/missing_energy.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include <gtest/gtest.h>

#include "support/scenes.h"
#include "support/staged_scene.h"

/// What a solve says that it missed, against a dense factorization of the very same system.
namespace tensormass::solver {
namespace {

using step::StageKind;
using tests::StagedScene;

/// A stiff, slender ligament and a soft block in steps of 10 ms.
constexpr tests::Beam kLigament{.cells_x = 16,
                                .cells_y = 3,
                                .cells_z = 3,
                                .size_x_m = 0.04,
                                .size_y_m = 0.005,
                                .size_z_m = 0.004,
                                .double_precision = true};
constexpr tests::Beam kBlock{.cells_x = 10,
                             .cells_y = 5,
                             .cells_z = 4,
                             .size_x_m = 0.1,
                             .size_y_m = 0.05,
                             .size_z_m = 0.04,
                             .double_precision = true,
                             .young_modulus_pa = 2e4};

struct Shortfall {
  double energy_j, estimate_j;  // e·A e
  double worst_m, estimated_m;  // error of the displacement
  double mass_kg = 0;
};

/// Solves the first step of a fall with some iterations.
Shortfall solve(tests::Beam beam, std::uint32_t iterations, matrix::Storage storage, std::uint32_t patches,
                bool coarse = false) {
  beam.cg_max_iterations = iterations;
  v1::Scene scene = tests::beam_scene(beam);
  scene.mutable_solver()->set_coarse_level(coarse);
  StagedScene<double> staged(scene, patches, storage);
  if (coarse) staged.use_coarse_level();
  staged.run_through(StageKind::kExternalForces);
  const Eigen::MatrixXd whole = staged.matrix();
  const Eigen::VectorXd load = staged.by_node(staged.view.matrix.rhs);
  std::vector<int> free;
  Shortfall out{};
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    if (staged.is_fixed(node)) continue;
    for (int c = 0; c < 3; ++c) free.push_back(static_cast<int>(3 * node) + c);
    out.mass_kg += staged.model.row_mass[staged.row(node)];
  }
  const Eigen::MatrixXd a = whole(free, free);
  const Eigen::VectorXd before = staged.by_node(staged.view.state.velocity);
  for (const StageKind kind : {StageKind::kCoarseLevel, StageKind::kFactorize, StageKind::kScaleEdges,
                               StageKind::kSolve, StageKind::kAdvance}) {
    staged.run(kind);
  }
  const Eigen::VectorXd change = (staged.by_node(staged.view.state.velocity) - before)(free);
  const Eigen::VectorXd error = a.ldlt().solve(Eigen::VectorXd(load(free))) - change;
  out.energy_j = error.dot(a * error);
  out.estimate_j = missing_energy_j(*staged.view.solve.report, iterations);
  for (Eigen::Index i = 0; i < error.size(); i += 3) {
    out.worst_m = std::max(out.worst_m, beam.dt_s * error.segment<3>(i).norm());
  }
  out.estimated_m = step_error(out.estimate_j, out.mass_kg, beam.dt_s).displacement_m;
  return out;
}

TEST(MissingEnergy, IsThatOfTheError) {
  for (const tests::Beam& beam : {kLigament, kBlock}) {
    for (const std::uint32_t iterations : {20u, 50u}) {
      // 50 nearly solve the block. The estimate is then too large by a factor of five.
      if (beam.size_x_m == kBlock.size_x_m && iterations > 20) continue;
      for (const matrix::Storage storage : {matrix::Storage::kEdges, matrix::Storage::kRows}) {
        const Shortfall found = solve(beam, iterations, storage, 2);
        const double ratio = std::sqrt(found.estimate_j / found.energy_j);
        EXPECT_GT(ratio, 1 / 3.0) << beam.size_x_m << ", " << iterations;
        EXPECT_LT(ratio, 3) << beam.size_x_m << ", " << iterations;
        EXPECT_GT(found.estimated_m, found.worst_m / 5) << beam.size_x_m << ", " << iterations;
        EXPECT_LT(found.estimated_m, found.worst_m * 3) << beam.size_x_m << ", " << iterations;
      }
    }
  }
}

TEST(MissingEnergy, IsThatOfTheErrorWithACoarseLevel) {
  for (const std::uint32_t iterations : {12u, 20u}) {
    const Shortfall found = solve(kLigament, iterations, matrix::Storage::kEdges, 2, true);
    EXPECT_GT(std::sqrt(found.estimate_j / found.energy_j), 1 / 5.0) << iterations;
    EXPECT_LT(std::sqrt(found.estimate_j / found.energy_j), 5) << iterations;
  }
}

TEST(MissingEnergy, IsNothingIfTheSolveEndedByItself) {
  view::SolveReport<float> report{1e-4f, 40, 0, {1, 2, 2.5f}};
  EXPECT_EQ(missing_energy_j(report, 41), 0);
  EXPECT_DOUBLE_EQ(missing_energy_j(report, 40), 0.5) << "a half, a quarter, an eighth ..: late · 1";
  report.gained_energy[1] = 1.1f;
  EXPECT_NEAR(missing_energy_j(report, 40), 1.4 * 19, 1e-4) << "the gain grows";
  report.gained_energy[2] = NAN;
  EXPECT_EQ(missing_energy_j(report, 40), 0);
  EXPECT_EQ(missing_energy_j(view::SolveReport<float>{0, 4, 0, {1, 2, 3}}, 4), 0) << "too few iterations to tell";
}

TEST(StepError, FollowsFromEnergyAndMass) {
  // A body of 2 kg whose velocity is off by 0.1 m/s: 0.02 J, 1 mm in a step of 10 ms, 20 N to make up for it in one.
  const StepError error = step_error(0.02, 2, 0.01);
  EXPECT_DOUBLE_EQ(error.displacement_m, 1e-3);
  EXPECT_DOUBLE_EQ(error.force_n, 20);
  EXPECT_EQ(step_error(0.02, 0, 0.01).displacement_m, 0) << "without mass";
}

}  // namespace
}  // namespace tensormass::solver
