#include "control/scene_registry.h"

#include <algorithm>
#include <atomic>
#include <future>
#include <set>
#include <string_view>
#include <thread>
#include <utility>

#include <gtest/gtest.h>

#include "core/limits.h"
#include "support/refused.h"
#include "support/scenes.h"

namespace tensormass::control {
namespace {

const world::RunnerOptions kCpu{.backend = world::BackendChoice::kCpu, .cpu_threads = 1};

v1::Scene small_scene(const std::string& name) {
  v1::Scene scene = tests::beam_scene({.cells_x = 2, .cells_y = 1, .cells_z = 1});
  scene.set_name(name);
  return scene;
}

class SceneRegistryTest : public testing::Test {
 protected:
  std::atomic<int> signals{0};
  SceneRegistry registry{kCpu, [this] { ++signals; }};
};

TEST_F(SceneRegistryTest, FindsLoadedScenesAndNotUnloadedOnes) {
  EXPECT_TRUE(registry.list().empty());
  const auto before = registry.generation();
  ASSERT_TRUE(registry.load(small_scene("b")));
  ASSERT_TRUE(registry.load(small_scene("a")));
  EXPECT_NE(registry.generation(), before);
  EXPECT_GE(signals, 2);
  const auto runners = registry.list();
  ASSERT_EQ(runners.size(), 2u);
  EXPECT_EQ(runners[0]->name(), "a");
  EXPECT_EQ(*registry.find("b"), runners[1]);

  ASSERT_TRUE(registry.unload("a"));
  EXPECT_EQ(registry.find("a").error().code, ErrorCode::kNotFound);
  EXPECT_EQ(registry.unload("a").error().code, ErrorCode::kNotFound);
  EXPECT_TRUE(registry.load(small_scene("a")));
}

/// Bytes that the process seems to hold.
std::atomic<double> used_bytes{0};

TEST(SceneRegistryAdmission, ReadsWhetherAnAdjustedSceneFitsBesideTheRunningOne) {
  SceneRegistry registry(
      kCpu, [] {}, {.all_bytes = 1e12}, [] { return used_bytes.load(); });
  ASSERT_TRUE(registry.load(small_scene("a")));
  v1::SceneAdjustments changes;
  changes.mutable_gravity_m_per_s2()->set_y(-1);
  EXPECT_TRUE(registry.adjust("a", changes));
  used_bytes = 1e12;
  changes.mutable_gravity_m_per_s2()->set_y(-2);
  EXPECT_REFUSED(registry.adjust("a", changes), ErrorCode::kResourceExhausted, "--max-memory-mib");
  EXPECT_REFUSED(registry.adjust("b", changes), ErrorCode::kNotFound, "no scene 'b'");
  EXPECT_TRUE(registry.find("a"));
}

TEST_F(SceneRegistryTest, RefusesANameThatIsTaken) {
  ASSERT_TRUE(registry.load(small_scene("a")));
  const auto second = registry.load(small_scene("a"));
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, ErrorCode::kAlreadyExists);
}

TEST_F(SceneRegistryTest, ARefusedSceneFreesItsName) {
  v1::Scene broken = small_scene("a");
  broken.mutable_bodies(0)->clear_law();
  const auto refused = registry.load(broken);
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, ErrorCode::kInvalidArgument);
  EXPECT_TRUE(registry.load(small_scene("a")));
}

TEST_F(SceneRegistryTest, ALoadReservesItsNameAndDelaysNoOtherScene) {
  ASSERT_TRUE(registry.load(small_scene("running")));
  std::promise<void> started, checked;
  std::thread loading([&] {  // blocks at its first progress report
    const auto block = [&, first = true](std::string_view, double) mutable {
      if (std::exchange(first, false)) {
        started.set_value();
        checked.get_future().wait();
      }
      return true;
    };
    EXPECT_TRUE(registry.load(small_scene("slow"), model::Progress(block)));
  });
  started.get_future().wait();
  EXPECT_EQ(registry.unload("slow").error().code, ErrorCode::kFailedPrecondition);
  EXPECT_EQ(registry.load(small_scene("slow")).error().code, ErrorCode::kAlreadyExists);
  EXPECT_EQ(registry.find("slow").error().code, ErrorCode::kNotFound);
  EXPECT_EQ(registry.list().size(), 1u);
  EXPECT_TRUE((*registry.find("running"))->step(1));
  checked.set_value();
  loading.join();
  EXPECT_TRUE(registry.find("slow"));
}

TEST_F(SceneRegistryTest, RefusesScenesBeyondItsLimit) {
  for (std::size_t i = 0; i < limits::kMaxScenes; ++i) ASSERT_TRUE(registry.load(small_scene(std::to_string(i))));
  const auto one_more = registry.load(small_scene("more"));
  ASSERT_FALSE(one_more);
  EXPECT_EQ(one_more.error().code, ErrorCode::kResourceExhausted);
  EXPECT_NE(one_more.error().message.find("kMaxScenes"), std::string::npos);
}

TEST_F(SceneRegistryTest, CloseRemovesEverySceneAndRefusesLoads) {
  ASSERT_TRUE(registry.load(small_scene("a")));
  const auto ending = registry.close();
  ASSERT_EQ(ending.size(), 1u);
  EXPECT_TRUE(registry.list().empty());
  // A closed scene still answers, but refuses commands that would delay its end.
  EXPECT_EQ(ending[0]->status().scene(), "a");
  EXPECT_EQ(ending[0]->step(1).error().code, ErrorCode::kUnavailable);
  EXPECT_EQ(registry.load(small_scene("b")).error().code, ErrorCode::kUnavailable);
}

TEST_F(SceneRegistryTest, ReportsTheProgressOfALoad) {
  std::vector<double> fractions;
  std::set<std::string, std::less<>> parts;
  const model::Progress progress([&](std::string_view part, double fraction) {
    fractions.push_back(fraction);
    EXPECT_TRUE(parts.emplace(part).second) << part;
    return true;
  });
  ASSERT_TRUE(registry.load(small_scene("a"), progress));
  EXPECT_GE(fractions.size(), 6u);
  EXPECT_TRUE(std::is_sorted(fractions.begin(), fractions.end()));
  EXPECT_EQ(fractions.front(), 0);
  EXPECT_LT(fractions.back(), 1);
}

/// Cancels the load at each of its parts in turn. It must end there and free its name.
TEST_F(SceneRegistryTest, ACancelledLoadEndsAndFreesItsName) {
  for (int last = 1;; ++last) {
    int part = 0;
    const auto loaded =
        registry.load(small_scene("a"), model::Progress([&](std::string_view, double) { return ++part < last; }));
    if (loaded) {
      EXPECT_GT(last, 6);
      return;
    }
    EXPECT_EQ(part, last) << "the load continued after the cancellation";
    EXPECT_EQ(loaded.error().code, ErrorCode::kCancelled);
    EXPECT_TRUE(registry.list().empty());
  }
}

}  // namespace
}  // namespace tensormass::control
