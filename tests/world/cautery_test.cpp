#include <cmath>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/on_runner.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/runner.h"

/// Tools that burn tissue away: how much goes, when, and what is refused.
namespace tensormass::world {
namespace {

constexpr double kPowerW = 40, kEfficiency = 0.25, kAblationJPerM3 = 2e6, kDtS = 0.01;

/// A block under a probe with power. An element takes a few steps to burn.
v1::Scene burnable_block(bool in_double = true, double coagulated_stiffness_factor = 5) {
  v1::Scene scene = tests::block_with_probe(in_double);
  scene.mutable_stepping()->set_lockstep(true);
  scene.mutable_stepping()->set_dt_s(kDtS);
  scene.mutable_bodies(0)->set_ablation_j_per_m3(kAblationJPerM3);
  scene.mutable_bodies(0)->set_coagulated_stiffness_factor(coagulated_stiffness_factor);
  v1::Cautery& cautery = *scene.mutable_tools(0)->mutable_cautery();
  cautery.set_power_w(kPowerW);
  cautery.set_efficiency(kEfficiency);
  scene.mutable_editing();
  return scene;
}

v1::ToolPose pressed(double level, double y_m = 0.056) {
  v1::ToolPose pose;
  tests::set(*pose.mutable_position_m(), 0.051, y_m, 0.049);
  pose.set_level(level);
  return pose;
}

class Cautery : public tests::OnRunner {
 protected:
  static double removed_m3(Runner& runner) { return runner.status().removed_volume_m3(); }
  /// Puts the probe on the block and lets it come to rest.
  static void press(Runner& runner, double level) {
    ASSERT_TRUE(runner.submit_pose("probe", pressed(level)));
    ASSERT_TRUE(runner.step(30));
  }
};
TM_ON_EACH_BACKEND(Cautery);

TEST_P(Cautery, RemovesEnergyOverTheTissuesWithinOneElement) {
  constexpr double kElementM3 = 0.01 * 0.01 * 0.01 / 3;  // the largest of the five tetrahedra of a cell
  for (const double level : {1.0, 0.5}) {
    const auto runner = load(burnable_block());
    press(*runner, 0);
    EXPECT_EQ(removed_m3(*runner), 0) << "no level, no power";
    constexpr int kSteps = 90;
    double sunk_m = 0.056;
    double touching = 0;  // steps with power on tissue
    for (int i = 0; i < kSteps; ++i) {
      sunk_m -= 5e-5;  // the hand follows what goes
      ASSERT_TRUE(runner->submit_pose("probe", pressed(level, sunk_m)));
      ASSERT_TRUE(runner->step(1));
      const auto felt = runner->feedback("probe");
      touching += felt->touching() ? felt->level() : 0;
    }
    const double expected_m3 = kPowerW * kEfficiency * touching * kDtS / kAblationJPerM3;
    EXPECT_GT(touching, level * kSteps / 2);
    EXPECT_NEAR(removed_m3(*runner), expected_m3, kElementM3) << "level " << level << ", " << touching << " steps";
    v1::SurfaceChanges changes;
    ASSERT_TRUE(runner->changes(changes)) << "clients are told";
    EXPECT_GT(changes.revision(), 0u);
    EXPECT_FALSE(changes.bodies(0).dead_triangles().empty());
    v1::SceneEvents events;
    ASSERT_TRUE(runner->take_events(events));
    double told_m3 = 0;
    for (const v1::SceneEvent& event : events.events()) {
      EXPECT_EQ(event.kind(), v1::SceneEvent::KIND_ABLATED);
      EXPECT_EQ(event.body(), "beam");
      EXPECT_EQ(event.tool(), "probe");
      EXPECT_NEAR(event.position_m().x(), 0.051, 1e-6);
      EXPECT_GT(event.position_m().y(), 0.04);
      told_m3 += event.value();
    }
    EXPECT_GT(told_m3, 0.5 * expected_m3);
    EXPECT_LE(told_m3, removed_m3(*runner) * (1 + 1e-9));
    ASSERT_TRUE(runner->reset());
    EXPECT_EQ(removed_m3(*runner), 0) << "a reset heals";
    ASSERT_TRUE(runner->changes(changes));
    EXPECT_TRUE(changes.bodies(0).dead_triangles().empty());
  }
}

/// Energy that an element did not take goes to the next one, and a snapshot carries it.
TEST_P(Cautery, GoesOnFromASnapshotToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const auto first = load(burnable_block(in_double)), second = load(burnable_block(in_double));
    press(*first, 1);
    const auto snapshot = first->snapshot();
    ASSERT_TRUE(snapshot);
    const auto restored = second->restore(snapshot->snapshot());
    ASSERT_TRUE(restored) << restored.error().message;
    EXPECT_DOUBLE_EQ(removed_m3(*second), removed_m3(*first));  // added up in another order
    for (const auto* runner : {&first, &second}) ASSERT_TRUE((*runner)->step(40));
    EXPECT_GT(removed_m3(*first), 0);
    EXPECT_DOUBLE_EQ(removed_m3(*second), removed_m3(*first));  // added up in another order
    EXPECT_EQ(first->positions("beam")->positions(), second->positions("beam")->positions());
  }
}

/// The pedal of a client that died does not stay down.
TEST_P(Cautery, EndsWithThePose) {
  const auto runner = load(burnable_block());
  v1::ToolPose pose = pressed(1);
  pose.set_valid_for_s(0.1);
  ASSERT_TRUE(runner->submit_pose("probe", pose));
  ASSERT_TRUE(runner->step(60));
  const double once_m3 = removed_m3(*runner);
  ASSERT_TRUE(runner->step(60));
  EXPECT_EQ(removed_m3(*runner), once_m3);
  EXPECT_EQ(runner->feedback("probe")->level(), 0);
}

TEST_P(Cautery, BurnsNothingInTheAir) {
  const auto runner = load(burnable_block());
  ASSERT_TRUE(runner->submit_pose("probe", pressed(1, 0.075)));
  ASSERT_TRUE(runner->step(60));
  EXPECT_EQ(removed_m3(*runner), 0);
  EXPECT_EQ(runner->feedback("probe")->level(), 1) << "the pedal is down all the same";
}

/// The last element of a body stays, whatever the power.
TEST_P(Cautery, SparesTheLastElement) {
  v1::Scene scene = burnable_block();
  scene.mutable_bodies(0)->set_ablation_j_per_m3(1e3);
  v1::Grid& grid = *scene.mutable_bodies(0)->mutable_mesh()->mutable_grid();
  grid.set_cells_x(1);
  grid.set_cells_y(1);
  grid.set_cells_z(1);
  const auto runner = load(scene);
  ASSERT_TRUE(runner->submit_pose("probe", pressed(1)));
  for (int i = 0; i < 20; ++i) ASSERT_TRUE(runner->step(10));
  EXPECT_LT(removed_m3(*runner), 0.1 * 0.05 * 0.1);
}

TEST_P(Cautery, RefusesLevelsOutOfRange) {
  const auto runner = load(burnable_block());
  for (const double level :
       {-0.1, 1.1, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    EXPECT_REFUSED(runner->submit_pose("probe", pressed(level)), ErrorCode::kInvalidArgument, "level");
  }
  v1::Scene blunt = burnable_block();
  blunt.mutable_tools(0)->clear_cautery();
  EXPECT_REFUSED(load(blunt)->submit_pose("probe", pressed(0.5)), ErrorCode::kInvalidArgument, "has no power");
}

}  // namespace
}  // namespace tensormass::world
