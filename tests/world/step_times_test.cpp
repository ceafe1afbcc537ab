#include <algorithm>
#include <cstdint>
#include <numeric>

#include <gtest/gtest.h>

#include "core/duration_buckets.h"
#include "support/on_runner.h"
#include "support/scenes.h"
#include "world/runner.h"

/// Step times of the whole run, in a scene's status.
namespace tensormass::world {
namespace {

v1::Scene beam() {
  v1::Scene scene = tests::beam_scene({.cells_x = 4, .cells_y = 2, .cells_z = 2});
  scene.mutable_stepping()->set_lockstep(true);
  return scene;
}

std::uint64_t count_of(const v1::DurationHistogram& times) {
  return std::accumulate(times.counts().begin(), times.counts().end(), std::uint64_t{0});
}

class StepTimes : public tests::OnRunner {};

TEST_P(StepTimes, AreCountedThroughAReset) {
  const auto runner = load(beam());
  EXPECT_EQ(runner->status().step_times().buckets_size(), 0);
  ASSERT_TRUE(runner->step(30));
  ASSERT_TRUE(runner->reset());
  const auto status = runner->step(12);
  ASSERT_TRUE(status) << status.error().message;
  const v1::DurationHistogram& times = status->step_times();
  ASSERT_EQ(times.counts_size(), times.buckets_size());
  EXPECT_EQ(count_of(times), 42u);
  EXPECT_TRUE(std::is_sorted(times.buckets().begin(), times.buckets().end()));
  const auto last_ns = static_cast<double>(DurationBuckets::upper_ns(times.buckets(times.buckets_size() - 1)));
  EXPECT_LE(times.max_s(), 1e-9 * last_ns);
  EXPECT_NEAR(times.max_s(), status->step_time_max_s(), 1e-6) << "the window has all 42 steps, too";
}

TEST_P(StepTimes, AreCountedThroughAnAdjustment) {
  const auto runner = load(beam());
  ASSERT_TRUE(runner->step(20));
  v1::SceneAdjustments stiffer;
  v1::BodyAdjustment& body = *stiffer.add_bodies();
  body.set_body("beam");
  body.set_stiffness_factor(2);
  const auto adjusted = runner->adjust(stiffer);
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  EXPECT_EQ(count_of(adjusted->status().step_times()), 20u);
  ASSERT_TRUE(runner->step(1));
  EXPECT_EQ(count_of(runner->status().step_times()), 21u);
}

TM_ON_EACH_BACKEND(StepTimes);

}  // namespace
}  // namespace tensormass::world
