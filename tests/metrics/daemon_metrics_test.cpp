#include "metrics/daemon_metrics.h"

#include <chrono>
#include <fstream>
#include <memory>
#include <sstream>
#include <string>

#include <gtest/gtest.h>

#include "support/scenes.h"
#include "world/scene_counts.h"
#include "world/step_clock.h"

namespace tensormass::metrics {
namespace {

using namespace std::chrono_literals;

/// The whole text for these numbers. Who changes a name, a label or a bucket breaks dashboards: change docs/metrics.md,
/// docker/ and this file in the same commit, and say so in CHANGELOG.md.
constexpr const char* kBaseline = "tests/metrics/exposition.txt";

world::SceneMetrics invented_scene() {
  world::SceneMetrics scene;
  scene.status.set_scene("liver");
  scene.status.set_state(v1::SceneStatus::STATE_RUNNING);
  scene.status.set_backend("cuda");
  scene.status.set_device(1);
  scene.status.set_target_rate_hz(1000);
  scene.status.set_reached_rate_hz(999.5);
  scene.status.set_frames_published(60);
  scene.status.set_frames_replaced(2);
  scene.status.set_cg_relative_residual(0.001);
  scene.status.set_momentum_error(0.25);
  scene.status.set_cut_area_m2(0.0125);
  scene.status.set_removed_mass_kg(0.5);
  scene.bytes = 1 << 20;
  scene.tools.push_back({"probe", 100, 3, 4});
  const auto statistics = std::make_shared<world::StepStatistics>();
  statistics->add(700us, world::Clock::time_point{1s}, true);
  statistics->add(1500us, world::Clock::time_point{2s}, false);
  scene.statistics = statistics;
  const auto counts = std::make_shared<world::SceneCounts>();
  counts->pose_ages.add(400'000);
  counts->poses_to_force.add(1'800'000);
  counts->cg_iterations = 240;
  counts->held_steps = 5;
  counts->guard_events[static_cast<std::size_t>(world::Breach::kMove)] = 6;
  counts->recoveries[static_cast<std::size_t>(world::Breach::kToolLoad)] = 7;
  counts->faults[world::SceneCounts::kDeviceFault] = 1;
  scene.counts = counts;
  return scene;
}

TEST(DaemonMetrics, NamesLabelsAndBucketsAreThoseOfTheBaseline) {
  control::Refusals refusals;
  refusals.count(control::Limit::kLongCalls);
  const auto losses = std::make_shared<control::RecordingLosses>();
  losses->steps = 13;
  losses->recordings = 1;
  DaemonMetrics metrics{.identity = {},
                        .malformed_messages = 9,
                        .memory_bytes = 3 << 20,
                        .memory_limit_bytes = 6 << 20,
                        .refusals = &refusals,
                        .losses = {{"liver", losses}}};
  metrics.bus.full_queues[0][3] = 11;
  metrics.bus.refusals[1][0] = 12;
  metrics.identity.set_version("1.2.3");
  metrics.identity.set_server("local");
  metrics.identity.set_backend("cuda");
  metrics.identity.set_device("a \"GPU\"");
  metrics.scenes.push_back(invented_scene());
  std::ostringstream baseline;
  baseline << std::ifstream(kBaseline).rdbuf();
  EXPECT_EQ(to_text(metrics), baseline.str()) << kBaseline;
}

TEST(DaemonMetrics, AreThoseOfLoadedScenes) {
  control::SceneRegistry registry({}, [] {}, {.scene_bytes = 1e9, .all_bytes = 2e9});
  const auto text = [&] { return to_text(read_metrics(registry, {}, 0)); };
  EXPECT_NE(text().find("\ntensormass_scenes 0\n"), std::string::npos);
  EXPECT_NE(text().find("\ntensormass_memory_limit_bytes 2000000000\n"), std::string::npos) << text();
  EXPECT_EQ(text().find("tensormass_memory_bytes 0\n"), std::string::npos) << "this test needs some";
  const auto loaded = registry.load(tests::block_with_probe(false, 2));
  ASSERT_TRUE(loaded) << loaded.error().message;
  ASSERT_TRUE((*loaded)->step(3));
  EXPECT_NE(text().find("\ntensormass_scenes 1\n"), std::string::npos);
  EXPECT_NE(text().find("tensormass_step_duration_seconds_count{scene=\"block\"} 3\n"), std::string::npos) << text();
  EXPECT_NE(text().find("{scene=\"block\",state=\"lockstep\"} 1\n"), std::string::npos) << text();
}

TEST(DaemonMetrics, CountRefusalsByTheirLimit) {
  control::SceneRegistry registry({}, [] {}, {.scene_bytes = 1e3, .all_bytes = 2e9});
  EXPECT_FALSE(registry.load(tests::block_with_probe(false, 2)));
  EXPECT_FALSE(registry.inspect(tests::block_with_probe(false, 2)));
  const std::string text = to_text(read_metrics(registry, {}, 0));
  EXPECT_NE(text.find("tensormass_refusals_total{limit=\"max_scene_mib\"} 2\n"), std::string::npos) << text;
  EXPECT_NE(text.find("tensormass_refusals_total{limit=\"max_memory_mib\"} 0\n"), std::string::npos) << text;
}

}  // namespace
}  // namespace tensormass::metrics
