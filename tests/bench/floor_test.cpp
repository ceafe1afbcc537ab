#include "bench/floor.h"

#include <stdexcept>
#include <string>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "support/scenes.h"

namespace tensormass::bench {
namespace {

class Floor : public testing::TestWithParam<model::SolveKind> {
 protected:
  static double bytes(model::SolveKind solve, std::uint32_t iterations) {
    v1::Scene scene = tests::beam_scene();
    scene.mutable_solver()->set_cg_max_iterations(iterations);
    model::PatchPolicy policy{.max_patches = 2, .min_nodes_per_patch = 1, .storage = matrix::Storage::kRows};
    policy.solve_of = [solve](const matrix::Layout&) { return solve; };
    const auto model = model::compile(scene, policy);
    if (!model) throw std::runtime_error(model.error().message);
    return floor_bytes(*model);
  }
};

TEST_P(Floor, IsThatOfTheStagesThatTheSolveReplaces) {
  EXPECT_DOUBLE_EQ(bytes(GetParam(), 50), bytes(model::SolveKind::kStages, 50));
}

TEST_P(Floor, CountsEveryIteration) {
  const double few = bytes(GetParam(), 10), more = bytes(GetParam(), 20), most = bytes(GetParam(), 1000);
  EXPECT_DOUBLE_EQ(most - few, 99 * (more - few));
  EXPECT_GT(most, 50 * few);
}

std::string name_of(const testing::TestParamInfo<model::SolveKind>& solve) {
  return solve.param == model::SolveKind::kResident ? "Resident" : "Streamed";
}

INSTANTIATE_TEST_SUITE_P(FusedSolves, Floor, testing::Values(model::SolveKind::kResident, model::SolveKind::kStreamed),
                         name_of);

}  // namespace
}  // namespace tensormass::bench
