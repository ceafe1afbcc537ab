#include <atomic>
#include <new>
#include <string>

#include <gtest/gtest.h>

#include "control/scene_registry.h"
#include "support/eventually.h"
#include "support/operator_new.h"
#include "support/scenes.h"

/// A call whose n-th allocation fails is refused, for every n, and other scenes step on. This program replaces operator
/// new, in every thread and for protobuf, too.
namespace {

/// Allocations until one fails; 0 or less: none does.
std::atomic<long> countdown{0};

}  // namespace

bool tensormass::tests::may_allocate(std::size_t) noexcept {
  return countdown.load(std::memory_order_relaxed) <= 0 || countdown.fetch_sub(1) != 1;
}

namespace tensormass::control {
namespace {

const world::RunnerOptions kCpu{.backend = world::BackendChoice::kCpu, .cpu_threads = 1};

class NoMemory : public testing::Test {
 protected:
  void SetUp() override {
    v1::Scene running = scene("other");
    running.mutable_stepping()->set_lockstep(false);
    ASSERT_TRUE(registry.load(running));
  }
  void TearDown() override {
    const auto other = registry.find("other");
    ASSERT_TRUE(other);
    const std::uint64_t step = (*other)->status().step();
    EXPECT_TRUE(tests::eventually([&] { return (*other)->status().step() > step; }, std::chrono::seconds(60)));
  }
  static v1::Scene scene(const std::string& name) {
    v1::Scene scene = tests::block_with_probe(false, 2);
    scene.set_name(name);
    return scene;
  }
  /// Calls `call` again and again; in the n-th call the n-th allocation fails. Ends with the call that had all its
  /// memory, and returns the number of calls. after: called after each call.
  template <class Call, class After>
  static long fail_each(const Call& call, const After& after) {
    for (long n = 1;; ++n) {
      countdown = n;
      try {
        call();
      } catch (const std::bad_alloc&) {
        // gRPC answers the call; refused_calls.h says how.
      }
      const bool failed = countdown.exchange(0) <= 0;
      after(failed);
      if (!failed || testing::Test::HasFailure()) return n;
    }
  }

  SceneRegistry registry{kCpu, [] {}};
};

TEST_F(NoMemory, ALoadIsRefusedAndItsNameIsFree) {
  const v1::Scene tiny = scene("tiny");
  const long calls = fail_each([&] { (void)registry.load(tiny); },
                               [&](bool failed) {
                                 const bool loaded = static_cast<bool>(registry.find("tiny"));
                                 EXPECT_TRUE(loaded || failed);
                                 EXPECT_TRUE(!loaded || registry.unload("tiny"));
                                 EXPECT_EQ(registry.list().size(), 1u);
                               });
  EXPECT_GT(calls, 50);
  EXPECT_TRUE(registry.load(tiny));
}

TEST_F(NoMemory, ACallThatReadsLeavesItsSceneAsItWas) {
  const auto runner = registry.load(scene("tiny"));
  ASSERT_TRUE(runner);
  ASSERT_TRUE((*runner)->step(3));
  const auto before = (*runner)->snapshot();
  ASSERT_TRUE(before);
  const auto unharmed = [&](bool) { ASSERT_EQ((*runner)->status().state(), v1::SceneStatus::STATE_LOCKSTEP); };
  EXPECT_GT(fail_each([&] { (void)(*runner)->snapshot(); }, unharmed), 5);
  fail_each([&] { (void)(*runner)->status(); }, unharmed);
  fail_each([&] { (void)(*runner)->frame(); }, unharmed);
  fail_each([&] { (void)(*runner)->feedback("probe"); }, unharmed);
  fail_each([&] { (void)(*runner)->positions("block"); }, unharmed);
  EXPECT_EQ((*runner)->snapshot()->snapshot(), before->snapshot());
}

TEST_F(NoMemory, AnAdjustmentIsWholeOrNotThere) {
  const auto runner = registry.load(scene("tiny"));
  ASSERT_TRUE(runner);
  ASSERT_TRUE((*runner)->step(3));
  const std::string before = (*runner)->positions("beam")->positions();
  double asked = 1;
  const auto adjust = [&] {
    asked += 0.001;  // each call changes something
    v1::SceneAdjustments changes;
    v1::BodyAdjustment& body = *changes.add_bodies();
    body.set_body("beam");
    body.set_stiffness_factor(asked);
    (void)registry.adjust("tiny", changes);
  };
  double present = 1;
  const long calls = fail_each(adjust, [&](bool failed) {
    ASSERT_EQ((*runner)->status().state(), v1::SceneStatus::STATE_LOCKSTEP);
    const auto values = (*runner)->adjust({});
    ASSERT_TRUE(values);
    const double factor = values->adjustments().bodies(0).stiffness_factor();
    EXPECT_TRUE(factor == asked || (failed && factor == present)) << factor;
    present = factor;
    EXPECT_EQ((*runner)->positions("beam")->positions(), before);
    EXPECT_TRUE((*runner)->restore((*runner)->snapshot()->snapshot())) << "state and values belong together";
  });
  EXPECT_GT(calls, 50);
}

TEST_F(NoMemory, AMessageIsNotParsed) {
  v1::LoadSceneRequest request;
  *request.mutable_scene() = scene("tiny");
  const std::string bytes = request.SerializeAsString();
  fail_each(
      [&] {
        v1::LoadSceneRequest parsed;
        EXPECT_TRUE(parsed.ParseFromString(bytes));
      },
      [](bool) {});
}

TEST_F(NoMemory, APoseIsDropped) {
  const auto runner = registry.load(scene("tiny"));
  ASSERT_TRUE(runner);
  v1::ToolPose pose;
  pose.mutable_position_m()->set_y(0.1);
  fail_each([&] { (void)(*runner)->submit_pose("probe", pose); }, [](bool) {});
  ASSERT_TRUE((*runner)->step(1));
}

}  // namespace
}  // namespace tensormass::control
