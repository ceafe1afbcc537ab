#include "world/scene_counts.h"

#include <chrono>
#include <optional>
#include <vector>

#include <gtest/gtest.h>

#include "support/eventually.h"
#include "support/faulty_backend.h"
#include "support/on_runner.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/runner.h"
#include "world/step_clock.h"

/// What metrics say of a scene.
namespace tensormass::world {
namespace {

using namespace std::chrono_literals;
using tests::Fault;

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, 60s);
}

std::uint64_t total(const DurationCounts& counts) {
  std::uint64_t sum = 0;
  for (std::size_t bucket = 0; bucket < DurationBuckets::kCount; ++bucket) sum += counts.count(bucket);
  return sum;
}

v1::Scene running_block() {
  v1::Scene scene = tests::block_with_probe(false, 2);
  scene.mutable_stepping()->set_lockstep(false);
  scene.mutable_stepping()->set_rate_hz(200);
  return scene;
}

v1::ToolPose pose(std::uint64_t sequence, std::optional<double> valid_for_s = std::nullopt) {
  v1::ToolPose out;
  tests::set(*out.mutable_position_m(), 0.05, 0.05, 0.05);
  out.set_sequence(sequence);
  out.set_client_id(7);
  if (valid_for_s) out.set_valid_for_s(*valid_for_s);
  return out;
}

TEST(DurationCounts, KnowTheirSum) {
  DurationCounts counts;
  for (const std::int64_t duration_ns : {5, 1000, 12}) counts.add(duration_ns);
  EXPECT_EQ(counts.sum_ns(), 1017);
  EXPECT_EQ(total(counts), 3u);
}

class Counting : public tests::OnRunner {};

TEST_P(Counting, GuardEventsAndFaultsByTheirReason) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
  const auto runner = load(scene, [](std::uint64_t step, std::uint64_t call) {
    return step == 4 || (step == 2 && call < 2) ? std::optional(Fault::kNotANumber) : std::nullopt;
  });
  EXPECT_FALSE(runner->step(6));
  const SceneMetrics metrics = runner->metrics();
  constexpr auto kReason = static_cast<std::size_t>(Breach::kNotFinite);
  EXPECT_EQ(kBreachNames[kReason], "not_finite");
  EXPECT_EQ(metrics.counts->guard_events[kReason], 2u);
  EXPECT_EQ(metrics.counts->faults[kReason], 1u);
  EXPECT_EQ(metrics.counts->faults[SceneCounts::kDeviceFault], 0u);
  EXPECT_GT(metrics.counts->cg_iterations, 3u);
  EXPECT_EQ(metrics.bytes, runner->report().bytes_total());
  // A counter of Prometheus only grows.
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->status().guard_events(), 0u);
  EXPECT_EQ(runner->metrics().counts->faults[kReason], 1u);
}

TEST_P(Counting, ADeviceThatFailed) {
  const auto runner = load(tests::block_with_probe(false, 4), [](std::uint64_t step, std::uint64_t) {
    return step == 3 ? std::optional(Fault::kDeviceError) : std::nullopt;
  });
  EXPECT_FALSE(runner->step(5));
  EXPECT_EQ(runner->metrics().counts->faults[SceneCounts::kDeviceFault], 1u);
}

TEST_P(Counting, ARecoveryOnceAndItsHeldSteps) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
  const auto runner = load(scene, [](std::uint64_t step, std::uint64_t) {
    return step == 4 || step == 5 ? std::optional(Fault::kNotANumber) : std::nullopt;
  });
  ASSERT_TRUE(runner->step(8));
  const SceneMetrics metrics = runner->metrics();
  EXPECT_EQ(metrics.counts->recoveries[static_cast<std::size_t>(Breach::kNotFinite)], metrics.status.recoveries());
  EXPECT_GE(metrics.status.recoveries(), 1u);
  EXPECT_EQ(metrics.counts->held_steps, metrics.status.held_steps());
  EXPECT_GE(metrics.status.held_steps(), 2u);
}

TEST_P(Counting, EachPoseOnceFromItsArrivalToItsForce) {
  const auto runner = load(running_block());
  std::vector<v1::ToolFeedback> feedback;
  ASSERT_TRUE(runner->submit_pose("probe", pose(1)));
  ASSERT_TRUE(eventually(
      [&] { return runner->take_feedback(feedback) && !feedback.empty() && feedback[0].pose_sequence() == 1; }));
  const SceneMetrics metrics = runner->metrics();
  EXPECT_EQ(total(metrics.counts->poses_to_force), 1u);
  EXPECT_GT(metrics.counts->poses_to_force.sum_ns(), 0);
  const std::uint64_t step = runner->status().step();
  ASSERT_TRUE(eventually([&] { return runner->take_feedback(feedback) && feedback[0].step() > step + 2; }));
  EXPECT_EQ(total(metrics.counts->poses_to_force), 1u) << "steps with the same pose are not counted";
  ASSERT_EQ(metrics.tools.size(), 1u);
  EXPECT_EQ(metrics.tools[0].name, "probe");
  EXPECT_EQ(metrics.tools[0].received, 1u);
}

/// The pose of a script may be as old as it likes.
TEST_P(Counting, TheAgeOfPosesThatAClientStreams) {
  const auto runner = load(running_block());
  ASSERT_TRUE(runner->submit_pose("probe", pose(1)));
  ASSERT_TRUE(eventually([&] { return runner->status().step() > 5; }));
  const auto counts = runner->metrics().counts;
  EXPECT_EQ(total(counts->pose_ages), 0u);
  ASSERT_TRUE(runner->submit_pose("probe", pose(2, 3600)));
  ASSERT_TRUE(eventually([&] { return total(counts->pose_ages) >= 3; }));
  EXPECT_GT(counts->pose_ages.sum_ns(), 0);
}

/// An adjusted scene steps in another world.
TEST_P(Counting, GoesOnAfterAnAdjustment) {
  const auto runner = load(running_block());
  ASSERT_TRUE(eventually([&] { return runner->status().step() > 3; }));
  const auto counts = runner->metrics().counts;
  v1::SceneAdjustments lighter;
  lighter.mutable_gravity_m_per_s2()->set_y(-1);
  ASSERT_TRUE(runner->adjust(lighter));
  EXPECT_EQ(runner->metrics().counts, counts);
}

TM_ON_EACH_BACKEND(Counting);

}  // namespace
}  // namespace tensormass::world
