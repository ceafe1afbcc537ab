#include "world/replay.h"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <random>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "core/recording_limits.h"
#include "support/eventually.h"
#include "support/on_runner.h"
#include "support/scenes.h"
#include "world/runner.h"

/// A scene is recorded through the interface of the control plane, and replayed by another runner.
namespace tensormass::world {
namespace {

using namespace std::chrono_literals;

class Replaying : public tests::OnRunner {
 protected:
  static StartedRecording record(Runner& runner, bool reset, std::uint32_t check_every = 50) {
    auto started = runner.record({.check_every_steps = check_every, .reset = reset});
    if (!started) throw std::runtime_error(started.error().message);
    return std::move(*started);
  }

  struct Recorded {
    std::vector<v1::RecordedStep> steps;
    std::vector<v1::RecordedEdit> edits;
    std::vector<v1::StateCheck> checks;
    std::uint64_t lost = 0;

    void take_from(Recording& recording) {
      v1::RecordSceneResponse response;
      while (recording.take(response)) {
        steps.insert(steps.end(), response.steps().begin(), response.steps().end());
        edits.insert(edits.end(), response.edits().begin(), response.edits().end());
        checks.insert(checks.end(), response.checks().begin(), response.checks().end());
        for (const v1::LostSteps& gap : response.lost()) lost += gap.count();
      }
    }
  };

  static v1::ToolPose random_pose(std::mt19937& random, std::uint64_t client, std::uint64_t sequence) {
    std::uniform_real_distribution<double> unit(-1, 1);
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), 0.05 + 0.02 * unit(random), 0.055 + 0.01 * unit(random),
               0.05 + 0.02 * unit(random));
    // Not of unit length to the last bit: the server normalizes it, once.
    pose.mutable_orientation()->set_w(1 + 0.005 * unit(random));
    pose.mutable_orientation()->set_x(0.02 * unit(random));
    pose.set_client_id(client);
    pose.set_sequence(sequence);
    if (sequence % 7 == 0) pose.set_valid_for_s(0.05);
    return pose;
  }

  /// Replays in parts and returns how many checks were equal.
  static Result<std::size_t> replay(Runner& runner, const v1::RecordingStart& start, const Recorded& recorded) {
    std::size_t equal = 0, next_check = 0;
    for (std::size_t begin = 0; begin < recorded.steps.size(); begin += 300) {
      v1::ReplaySceneRequest request;
      request.set_scene_hash(start.scene_hash());
      for (std::size_t i = begin; i < std::min(begin + 300, recorded.steps.size()); ++i) {
        *request.add_steps() = recorded.steps[i];
      }
      for (const v1::RecordedEdit& edit : recorded.edits) {
        if (edit.index() > begin && edit.index() <= begin + 300) *request.add_edits() = edit;
      }
      for (const v1::StateCheck& check : recorded.checks) request.add_check_indices(check.index());
      TM_ASSIGN_OR_RETURN(response, runner.replay(request));
      EXPECT_EQ(response.layout_hash(), start.layout_hash());
      for (const v1::StateCheck& check : response.checks()) {
        const v1::StateCheck& then = recorded.checks.at(next_check++);
        EXPECT_EQ(check.index(), then.index());
        EXPECT_EQ(check.step(), then.step());
        EXPECT_EQ(check.hash() == then.hash(), check.sample_displacements() == then.sample_displacements());
        equal += check.hash() == then.hash();
      }
    }
    EXPECT_EQ(next_check, recorded.checks.size());
    return equal;
  }

  static v1::Scene scene(bool lockstep) {
    v1::Scene scene = tests::block_with_probe(false, 4);
    scene.mutable_solver()->set_cg_tolerance(1e-3);
    scene.mutable_tools(0)->set_friction_coefficient(0.3);
    scene.mutable_stepping()->set_lockstep(lockstep);
    if (!lockstep) scene.mutable_stepping()->set_rate_hz(2000);
    return scene;
  }
};

TEST_P(Replaying, RepeatsALockstepSceneToTheLastBit) {
  const auto runner = load(scene(true));
  ASSERT_TRUE(runner->step(3));
  const StartedRecording started = record(*runner, true);
  EXPECT_EQ(started.start.step(), 0u);
  EXPECT_TRUE(started.start.snapshot().empty());
  std::mt19937 random(1);
  Recorded recorded;
  for (std::uint64_t i = 1; i <= 1500; ++i) {
    ASSERT_TRUE(runner->submit_pose("probe", random_pose(random, 5, i)));
    ASSERT_TRUE(runner->step(1 + i % 3));
    if (i == 700) {
      ASSERT_TRUE(runner->reset());
    }
    recorded.take_from(*started.recording);
  }
  EXPECT_EQ(recorded.lost, 0u);
  ASSERT_EQ(recorded.checks.size(), recorded.steps.size() / 50);
  EXPECT_GT(recorded.checks.back().largest_displacement_m(), 0);

  const auto second = load(scene(true));
  auto equal = replay(*second, started.start, recorded);
  ASSERT_TRUE(equal) << equal.error().message;
  EXPECT_EQ(*equal, recorded.checks.size());

  // A pose that differs by 10 µm is found. A single bit may get lost in single precision.
  auto step = recorded.steps.begin() + 100;
  while (step->poses().empty()) ++step;
  v1::RecordedPose& pose = *step->mutable_poses(0);
  pose.mutable_position_m()->set_y(pose.position_m().y() + 1e-5);
  recorded.steps.resize(1000);
  while (recorded.checks.back().index() > 1000) recorded.checks.pop_back();
  ASSERT_TRUE(second->reset());
  equal = replay(*second, started.start, recorded);
  ASSERT_TRUE(equal) << equal.error().message;
  EXPECT_EQ(*equal, 2u) << "steps 50 and 100 come before the pose that was changed";
}

/// Poses of two clients come whenever they come, and a budget changes the limit of iterations by the clock.
TEST_P(Replaying, RepeatsARunningSceneOfTwoClientsToTheLastBit) {
  v1::Scene running = scene(false);
  running.mutable_solver()->set_budget_s(1e-6);
  running.mutable_solver()->set_floor_cg_iterations(2);
  const auto runner = load(running);
  const StartedRecording started = record(*runner, false);
  EXPECT_FALSE(started.start.snapshot().empty());
  std::atomic<bool> ends{false};
  std::vector<std::thread> clients;
  for (const std::uint64_t id : {11u, 22u}) {
    clients.emplace_back([&, id] {
      std::mt19937 random(static_cast<unsigned>(id));
      for (std::uint64_t sequence = 1; !ends; ++sequence) {
        (void)runner->submit_pose("probe", random_pose(random, id, sequence));
        std::this_thread::yield();
      }
    });
  }
  Recorded recorded;
  EXPECT_TRUE(tests::eventually(
      [&] {
        recorded.take_from(*started.recording);
        return recorded.steps.size() >= 2000;
      },
      60s));
  ends = true;
  for (std::thread& client : clients) client.join();
  runner->stop_recording(started.recording);
  recorded.take_from(*started.recording);
  ASSERT_EQ(recorded.lost, 0u);

  std::size_t poses = 0;
  std::uint32_t least = ~0u;
  for (const v1::RecordedStep& step : recorded.steps) {
    poses += static_cast<std::size_t>(step.poses_size());
    least = std::min(least, step.cg_iteration_limit());
  }
  EXPECT_GT(poses, recorded.steps.size() / 20);  // a busy machine lets the clients run seldom
  EXPECT_LT(least, running.solver().cg_max_iterations()) << "the budget was at work";

  running.mutable_stepping()->set_lockstep(true);
  running.set_name("another_name");
  const auto second = load(running);
  const auto restored = second->restore(started.start.snapshot());
  ASSERT_TRUE(restored) << restored.error().message;
  EXPECT_EQ(restored->step(), started.start.step());
  const auto equal = replay(*second, started.start, recorded);
  ASSERT_TRUE(equal) << equal.error().message;
  EXPECT_EQ(*equal, recorded.checks.size());
}

/// A scene that is slower than real time retires a dead client's tool by real time, and a replay does so in the same
/// step.
TEST_P(Replaying, RepeatsTheExpiryOfAPoseInASlowScene) {
  v1::Scene slow = scene(false);
  slow.mutable_stepping()->set_rate_hz(400);
  slow.mutable_stepping()->set_dt_s(2.5e-4);  // a tenth of real time
  const auto runner = load(slow);
  const StartedRecording started = record(*runner, true);
  std::mt19937 random(3);
  v1::ToolPose last = random_pose(random, 5, 1);
  last.set_session(6);
  last.set_valid_for_s(0.5);
  ASSERT_TRUE(runner->submit_pose("probe", last));
  Recorded recorded;
  ASSERT_TRUE(tests::eventually(
      [&] {
        recorded.take_from(*started.recording);
        return runner->feedback("probe")->retired();
      },
      60s));
  EXPECT_FALSE(runner->feedback("probe")->claimed());
  runner->stop_recording(started.recording);
  recorded.take_from(*started.recording);
  ASSERT_EQ(recorded.lost, 0u);
  const auto step_of = [&](bool expired) {
    return std::find_if(recorded.steps.begin(), recorded.steps.end(), [expired](const v1::RecordedStep& step) {
      return step.poses_size() > 0 && step.poses(0).expired() == expired;
    });
  };
  ASSERT_NE(step_of(true), recorded.steps.end());
  const std::uint64_t steps = step_of(true)->index() - step_of(false)->index();
  EXPECT_LT(static_cast<double>(steps) * 2.5e-4, 0.4) << "half a second of simulated time has not passed";

  slow.mutable_stepping()->set_lockstep(true);
  const auto second = load(slow);
  const auto equal = replay(*second, started.start, recorded);
  ASSERT_TRUE(equal) << equal.error().message;
  EXPECT_EQ(*equal, recorded.checks.size());
  EXPECT_TRUE(second->feedback("probe")->retired());
  // The state of a pose that expired comes back from a snapshot.
  const auto snapshot = second->snapshot();
  ASSERT_TRUE(snapshot);
  const auto restored = second->restore(snapshot->snapshot());
  EXPECT_TRUE(restored) << restored.error().message;
}

TEST_P(Replaying, AReaderThatNeverReadsLosesStepsAndStopsNobody) {
  const auto runner = load(scene(true));
  auto started = runner->record({.check_every_steps = 1, .reset = true, .room_for_steps = 10, .room_for_checks = 2});
  ASSERT_TRUE(started);
  ASSERT_TRUE(runner->step(50));
  Recorded recorded;
  runner->stop_recording(started->recording);
  started->recording->close();
  recorded.take_from(*started->recording);
  EXPECT_EQ(recorded.steps.size(), 10u);
  EXPECT_EQ(recorded.lost, 40u);
  EXPECT_EQ(recorded.checks.size(), 2u);
}

TEST_P(Replaying, EndsWithTheScene) {
  auto runner = load(scene(true));
  const StartedRecording started = record(*runner, true);
  ASSERT_TRUE(runner->step(5));
  const auto second = runner->record({});
  ASSERT_FALSE(second);
  EXPECT_NE(second.error().message.find("is being recorded"), std::string::npos);
  EXPECT_FALSE(started.recording->closed());
  runner.reset();
  EXPECT_TRUE(started.recording->closed());
  Recorded recorded;
  recorded.take_from(*started.recording);
  EXPECT_EQ(recorded.steps.size(), 5u);
}

TEST_P(Replaying, RefusesWhatDoesNotFit) {
  const auto runner = load(scene(true));
  const StartedRecording started = record(*runner, true);
  std::mt19937 random(1);
  ASSERT_TRUE(runner->submit_pose("probe", random_pose(random, 1, 1)));
  ASSERT_TRUE(runner->step(4));
  Recorded recorded;
  recorded.take_from(*started.recording);
  v1::ReplaySceneRequest good;
  good.set_scene_hash(started.start.scene_hash());
  for (const v1::RecordedStep& step : recorded.steps) *good.add_steps() = step;

  const auto second = load(scene(true));
  const auto expect_refused = [&](Runner& loaded, const v1::ReplaySceneRequest& request, const char* part) {
    const auto response = loaded.replay(request);
    ASSERT_FALSE(response) << part;
    EXPECT_NE(response.error().message.find(part), std::string::npos) << response.error().message;
    EXPECT_EQ(loaded.status().step(), 0u) << "nothing was stepped";
  };
  v1::Scene stiffer = scene(true);
  stiffer.mutable_bodies(0)->set_density_kg_per_m3(1001);
  expect_refused(*load(stiffer), good, "another scene");
  v1::Scene paused = scene(false);
  const auto running = load(paused);
  ASSERT_TRUE(running->pause());
  ASSERT_TRUE(running->reset());
  expect_refused(*running, good, "runs by the clock");
  v1::ReplaySceneRequest bad = good;
  bad.clear_steps();
  expect_refused(*second, bad, "kMaxReplayedSteps");
  for (int i = 0; i <= limits::kMaxReplayedSteps; ++i) *bad.add_steps() = good.steps(0);
  expect_refused(*second, bad, "kMaxReplayedSteps");
  bad = good;
  bad.mutable_steps()->DeleteSubrange(1, 1);
  expect_refused(*second, bad, "steps were lost there");
  bad = good;
  bad.mutable_steps(0)->mutable_poses(0)->set_tool("knife");
  expect_refused(*second, bad, "no tool 'knife'");
  bad = good;
  bad.mutable_steps(0)->mutable_poses(0)->mutable_position_m()->set_x(std::nan(""));
  expect_refused(*second, bad, "steps[0].poses (probe).position_m");
  bad = good;
  bad.mutable_steps(0)->mutable_poses(0)->clear_orientation();
  expect_refused(*second, bad, "orientation");
  bad = good;
  bad.mutable_steps(0)->set_cg_iteration_limit(0);
  expect_refused(*second, bad, "cg_iteration_limit");
  bad = good;
  bad.mutable_steps(0)->set_step(3);
  expect_refused(*second, bad, "cannot follow");
  bad = good;
  bad.mutable_steps()->DeleteSubrange(1, 3);
  bad.mutable_steps(0)->set_rejected(true);
  const auto response = second->replay(bad);
  ASSERT_FALSE(response);
  EXPECT_NE(response.error().message.find("is good now"), std::string::npos) << response.error().message;
}

TM_ON_EACH_BACKEND(Replaying);

}  // namespace
}  // namespace tensormass::world
