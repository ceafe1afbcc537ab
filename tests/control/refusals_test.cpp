#include "control/refusals.h"

#include <gtest/gtest.h>

#include "control/admission.h"
#include "control/call_share.h"
#include "support/refused.h"

namespace tensormass::control {
namespace {

TEST(Refusals, AreCountedByTheirLimit) {
  Refusals refusals;
  refusals.count(Limit::kRole);
  refusals.count(Limit::kRole);
  EXPECT_EQ(refusals.of(Limit::kRole), 2u);
  EXPECT_EQ(refusals.of(Limit::kScenes), 0u);
}

TEST(Refusals, OfCallsBeyondTheirShare) {
  Refusals refusals;
  CallShare share(1, "kMaxLongCalls", refusals, Limit::kLongCalls);
  {
    const CallShare::Place first(share);
    EXPECT_TRUE(first);
    const CallShare::Place second(share);
    EXPECT_FALSE(second);
    EXPECT_EQ(second.refusal().error_code(), grpc::StatusCode::RESOURCE_EXHAUSTED);
  }
  EXPECT_EQ(refusals.of(Limit::kLongCalls), 1u);
  EXPECT_TRUE(CallShare::Place(share));
  EXPECT_EQ(refusals.of(Limit::kLongCalls), 1u);
}

TEST(Refusals, OfLoadsByTheBoundThatTheyPass) {
  v1::Scene scene;
  v1::Grid& grid = *scene.add_bodies()->mutable_mesh()->mutable_grid();
  grid.set_cells_x(100);
  grid.set_cells_y(100);
  grid.set_cells_z(100);
  const auto refused = [&](const AdmissionLimits& limits) {
    Refusals refusals;
    Admission admission(
        limits, [] { return 0.0; }, &refusals);
    EXPECT_FALSE(admission.admit(scene));
    std::size_t found = kLimitNames.size();
    for (std::size_t limit = 0; limit < kLimitNames.size(); ++limit) {
      if (refusals.of(static_cast<Limit>(limit)) == 1) found = limit;
    }
    return static_cast<Limit>(found);
  };
  EXPECT_EQ(refused({.all_bytes = 1e12, .load_s = 1e-3}), Limit::kLoadTime);
  EXPECT_EQ(refused({.scene_bytes = 1e6, .all_bytes = 1e12, .load_s = 1e6}), Limit::kSceneMemory);
  EXPECT_EQ(refused({.scene_bytes = 1e12, .all_bytes = 1e6, .load_s = 1e6}), Limit::kMemory);
}

}  // namespace
}  // namespace tensormass::control
