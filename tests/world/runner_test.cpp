#include "world/runner.h"

#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstring>
#include <limits>
#include <mutex>
#include <thread>

#include <gtest/gtest.h>

#include "core/limits.h"
#include "support/eventually.h"
#include "support/faulty_backend.h"
#include "support/on_runner.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/compiled_scene.h"

/// A scene on its own thread, through the interface that the control plane and the publisher use.
namespace tensormass::world {
namespace {

using namespace std::chrono_literals;

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, 60s);
}

v1::ToolPose pose(double x, double y, double z, std::uint64_t sequence = 0) {
  v1::ToolPose out;
  tests::set(*out.mutable_position_m(), x, y, z);
  out.set_sequence(sequence);
  out.set_client_id(sequence == 0 ? 0 : 77);
  return out;
}

double norm(const v1::Vector3& v) { return std::sqrt(v.x() * v.x() + v.y() * v.y() + v.z() * v.z()); }

std::vector<float> floats(const std::string& bytes) {
  std::vector<float> out(bytes.size() / sizeof(float));
  std::memcpy(out.data(), bytes.data(), bytes.size());
  return out;
}

bool all_finite(const std::vector<float>& values) {
  return std::all_of(values.begin(), values.end(), [](float value) { return std::isfinite(value); });
}

v1::Scene lockstep_scene() { return tests::block_with_probe(false, 4); }

v1::Scene running_scene(double rate_hz, double frame_rate_hz = 60) {
  v1::Scene scene = lockstep_scene();
  scene.mutable_stepping()->set_lockstep(false);
  scene.mutable_stepping()->set_rate_hz(rate_hz);
  scene.mutable_streams()->set_frame_rate_hz(frame_rate_hz);
  return scene;
}

/// A body of almost no mass and stiffness. After some steps it moves farther in one step than its own size.
v1::Scene doomed(v1::Scene scene) {
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
  body.set_density_kg_per_m3(1e-3);
  body.mutable_law()->mutable_hooke()->set_young_modulus_pa(1e-3);  // linear: the same on every machine
  v1::Load& load = *body.add_loads();
  v1::Box& everywhere = *load.mutable_region()->mutable_box();
  tests::set(*everywhere.mutable_min_m(), -1, -1, -1);
  tests::set(*everywhere.mutable_max_m(), 1, 1, 1);
  tests::set(*load.mutable_force_n(), 1e-4, 0, 0);
  return scene;
}

using Running = tests::OnRunner;

TEST_P(Running, LockstepStepsWhenAskedAndOnlyThen) {
  const auto runner = load(lockstep_scene());
  EXPECT_EQ(runner->name(), "block");
  EXPECT_EQ(runner->status().state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_EQ(runner->status().step(), 0u);
  EXPECT_EQ(runner->status().target_rate_hz(), 0);
  EXPECT_EQ(runner->status().backend(), GetParam());
  auto status = runner->step(3);
  ASSERT_TRUE(status) << status.error().message;
  EXPECT_EQ(status->step(), 3u);
  EXPECT_NEAR(status->simulated_time_s(), 0.03, 1e-12);
  EXPECT_GT(status->cg_iterations(), 0u);
  status = runner->step(1);
  ASSERT_TRUE(status);
  EXPECT_EQ(status->step(), 4u);
  EXPECT_GT(status->step_time_p50_s(), 0);
  EXPECT_EQ(runner->status().step(), 4u);
}

TEST_P(Running, LockstepRefusesPauseResumeAndInvalidCounts) {
  const auto runner = load(lockstep_scene());
  EXPECT_REFUSED(runner->step(0), ErrorCode::kInvalidArgument, "count");
  EXPECT_REFUSED(runner->step(limits::kMaxStepsPerCall + 1), ErrorCode::kInvalidArgument, "kMaxStepsPerCall");
  EXPECT_REFUSED(runner->pause(), ErrorCode::kFailedPrecondition, "lockstep");
  EXPECT_REFUSED(runner->resume(), ErrorCode::kFailedPrecondition, "lockstep");
  EXPECT_EQ(runner->status().step(), 0u);
}

TEST_P(Running, RefusesSceneBodyAndToolThatItDoesNotKnow) {
  v1::Scene broken = lockstep_scene();
  broken.mutable_bodies(0)->clear_law();
  EXPECT_REFUSED(Runner::start(broken, {BackendChoice::kCpu, 1}), ErrorCode::kInvalidArgument, "body 'beam'.law");
  EXPECT_REFUSED(Runner::inspect(broken, {BackendChoice::kCpu, 1}), ErrorCode::kInvalidArgument, "body 'beam'.law");
  const auto runner = load(lockstep_scene());
  EXPECT_REFUSED(runner->positions("liver"), ErrorCode::kNotFound, "liver");
  EXPECT_REFUSED(runner->feedback("scalpel"), ErrorCode::kNotFound, "scalpel");
}

TEST_P(Running, ResetGoesBackToTheBeginning) {
  const auto runner = load(lockstep_scene());
  const std::string rest = runner->positions("beam")->positions();
  ASSERT_EQ(rest.size(), 75 * 3 * sizeof(double));
  ASSERT_TRUE(runner->submit_pose("probe", pose(0.05, 0.055, 0.05, 1)));
  ASSERT_TRUE(runner->step(10));
  EXPECT_NE(runner->positions("beam")->positions(), rest);
  EXPECT_EQ(runner->positions("beam")->step(), 10u);
  ASSERT_GT(norm(runner->feedback("probe")->force_n()), 0);

  ASSERT_TRUE(runner->submit_pose("probe", pose(0.05, 0.02, 0.05, 2)));  // before the reset, so not for after it
  const auto status = runner->reset();
  ASSERT_TRUE(status);
  EXPECT_EQ(status->step(), 0u);
  EXPECT_EQ(status->simulated_time_s(), 0);
  EXPECT_EQ(runner->positions("beam")->positions(), rest);
  const auto feedback = runner->feedback("probe");
  EXPECT_EQ(norm(feedback->force_n()), 0);
  EXPECT_EQ(feedback->pose_sequence(), 0u);
  EXPECT_EQ(feedback->position_m().y(), 0.07);
  ASSERT_TRUE(runner->step(1));
  EXPECT_EQ(runner->feedback("probe")->position_m().y(), 0.07);
}

TEST_P(Running, StepsByTheClockUntilPausedAndAgainWhenResumed) {
  const auto runner = load(running_scene(200));
  EXPECT_EQ(runner->status().target_rate_hz(), 200);
  ASSERT_TRUE(eventually([&] { return runner->status().step() >= 5; }));
  EXPECT_REFUSED(runner->step(1), ErrorCode::kFailedPrecondition, "lockstep");
  const auto paused = runner->pause();
  ASSERT_TRUE(paused);
  EXPECT_EQ(paused->state(), v1::SceneStatus::STATE_PAUSED);
  // The loop runs commands between two steps. If it still stepped, some of these would see a new step.
  for (int i = 0; i < 20; ++i) EXPECT_EQ(runner->positions("beam")->step(), paused->step());
  const auto resumed = runner->resume();
  ASSERT_TRUE(resumed);
  EXPECT_EQ(resumed->state(), v1::SceneStatus::STATE_RUNNING);
  EXPECT_TRUE(eventually([&] { return runner->status().step() >= paused->step() + 5; }));
}

TEST_P(Running, APausedSceneStepsByHandAndStaysPaused) {
  v1::Scene scene = running_scene(200);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
  const auto runner = load(scene);
  const auto paused = runner->pause();
  ASSERT_TRUE(paused);
  const auto stepped = runner->step(3);
  ASSERT_TRUE(stepped);
  EXPECT_EQ(stepped->step(), paused->step() + 3);
  EXPECT_EQ(stepped->state(), v1::SceneStatus::STATE_PAUSED);
  EXPECT_EQ(norm(runner->feedback("probe")->force_n()), 0) << "a paused scene pushes nobody";
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.step(), stepped->step());
  ASSERT_TRUE(runner->resume());
  EXPECT_TRUE(eventually([&] { return runner->status().step() >= stepped->step() + 5; }));
}

TEST_P(Running, PausePublishesZeroForces) {
  v1::Scene scene = running_scene(200);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
  const auto runner = load(scene);
  ASSERT_TRUE(eventually([&] { return norm(runner->feedback("probe")->force_n()) > 0; }));
  ASSERT_TRUE(runner->pause());
  std::vector<v1::ToolFeedback> feedback;
  ASSERT_TRUE(runner->take_feedback(feedback));
  ASSERT_EQ(feedback.size(), 1u);
  EXPECT_EQ(norm(feedback[0].force_n()), 0);
  for (const double stiffness : feedback[0].local_model().stiffness_n_per_m()) EXPECT_EQ(stiffness, 0);
  EXPECT_EQ(norm(runner->status().tools(0).force_n()), 0);
}

/// Frames are rarer than steps. Without this frame, a viewer would keep showing an older one and its forces.
TEST_P(Running, PausePublishesAFrameOfTheLastStep) {
  v1::Scene scene = running_scene(200, 0.001);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
  const auto runner = load(scene);
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  ASSERT_TRUE(eventually([&] { return norm(runner->feedback("probe")->force_n()) > 0; }));
  ASSERT_FALSE(runner->take_frame(frame)) << "none is due for a thousand seconds";
  const auto paused = runner->pause();
  ASSERT_TRUE(paused);
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.sequence(), 2u);
  EXPECT_EQ(frame.step(), paused->step());
  EXPECT_GT(frame.step(), 0u);
  EXPECT_EQ(norm(frame.tools(0).force_n()), 0);
  EXPECT_EQ(frame.positions(), runner->frame()->positions());
  ASSERT_TRUE(runner->pause());
  EXPECT_FALSE(runner->take_frame(frame)) << "it stands there already";
  EXPECT_EQ(runner->frame()->server_time_ns(), frame.server_time_ns());
}

TEST_P(Running, UsesTheNewestPoseAndNamesItInFeedback) {
  const auto runner = load(lockstep_scene());
  for (std::uint64_t sequence = 1; sequence <= 3; ++sequence) {
    v1::ToolPose next = pose(0.05, 0.07 + 0.001 * static_cast<double>(sequence), 0.05, sequence);
    next.set_client_time_ns(100 + sequence);
    ASSERT_TRUE(runner->submit_pose("probe", next));
  }
  EXPECT_EQ(runner->feedback("probe")->pose_sequence(), 0u) << "a pose counts from the step that uses it";
  ASSERT_TRUE(runner->step(1));
  const auto feedback = runner->feedback("probe");
  EXPECT_EQ(feedback->pose_sequence(), 3u);
  EXPECT_EQ(feedback->client_time_ns(), 103u);
  EXPECT_EQ(feedback->client_id(), 77u);
  EXPECT_NEAR(feedback->position_m().y(), 0.073, 1e-12);
  const v1::SceneStatus status = runner->status();
  EXPECT_EQ(status.poses_received(), 3u);
  EXPECT_EQ(status.poses_superseded(), 2u);
  EXPECT_EQ(status.poses_rejected(), 0u);
}

/// The schedule alone would start a step every 200 s. A script's pose waits for it.
TEST_P(Running, AHandsPoseStartsTheStepThatWaitsForIt) {
  const auto runner = load(running_scene(1.0 / 200));
  ASSERT_TRUE(runner->pause());
  const std::uint64_t before = runner->status().step();
  for (std::uint64_t sequence = 1; sequence <= 2; ++sequence) {
    v1::ToolPose next = pose(0.05, 0.07 + 0.001 * static_cast<double>(sequence), 0.05, sequence);
    next.set_valid_for_s(10);
    ASSERT_TRUE(runner->submit_pose("probe", next));
    if (sequence == 1) {
      ASSERT_TRUE(runner->resume());  // starts a step at once, which has the first pose
    }
    ASSERT_TRUE(eventually([&] { return runner->feedback("probe")->pose_sequence() == sequence; })) << sequence;
  }
  EXPECT_EQ(runner->status().step(), before + 2);
}

TEST_P(Running, RefusesAndCountsBadPoses) {
  const auto runner = load(lockstep_scene());
  ASSERT_TRUE(runner->submit_pose("probe", pose(0.05, 0.08, 0.05, 5)));
  EXPECT_REFUSED(runner->submit_pose("probe", pose(0, 0, 0, 5)), ErrorCode::kInvalidArgument, "not newer");
  EXPECT_REFUSED(runner->submit_pose("probe", pose(0, std::numeric_limits<double>::quiet_NaN(), 0, 6)),
                 ErrorCode::kInvalidArgument, "not finite");
  EXPECT_REFUSED(runner->submit_pose("scalpel", pose(0, 0, 0, 7)), ErrorCode::kNotFound, "scalpel");
  runner->count_malformed_pose();
  EXPECT_EQ(runner->status().poses_rejected(), 4u);
  EXPECT_EQ(runner->status().poses_received(), 1u);
  ASSERT_TRUE(runner->step(1));
  EXPECT_EQ(runner->feedback("probe")->pose_sequence(), 5u);
}

TEST_P(Running, LimitsTheSpeedOfAPoseThatJumps) {
  const auto runner = load(lockstep_scene());  // 0.5 m/s, 10 ms: 5 mm a step
  ASSERT_TRUE(runner->submit_pose("probe", pose(1.05, 0.07, 0.05, 1)));
  ASSERT_TRUE(runner->step(4));
  EXPECT_NEAR(runner->feedback("probe")->position_m().x(), 0.05 + 4 * 0.005, 1e-12);
  ASSERT_TRUE(runner->step(197));
  EXPECT_EQ(runner->feedback("probe")->position_m().x(), 1.05);
}

/// One frame for every fourth step: 50 Hz of 200 Hz.
TEST_P(Running, LeavesFramesAtTheStatedRate) {
  const auto runner = load(running_scene(200, 50));
  v1::Frame frame;
  std::uint64_t frames = 0, last_step = 0, last_sequence = 0;
  ASSERT_TRUE(eventually([&] {
    if (runner->take_frame(frame)) {
      ++frames;
      EXPECT_EQ(frame.sequence(), last_sequence + 1);
      EXPECT_EQ(frame.step() % 4, 0u) << "after the one at rest";
      EXPECT_EQ(frame.topology_version(), runner->topology()->version());
      EXPECT_EQ(frame.tools_size(), 1);
      last_sequence = frame.sequence();
      last_step = frame.step();
    }
    return last_step >= 80;
  }));
  const v1::SceneStatus status = runner->status();
  EXPECT_EQ(status.frames_published(), frames);
  // The frame at rest, then one for every fourth step, each either published or replaced by a newer one.
  EXPECT_GE(status.frames_published() + status.frames_replaced(), last_step / 4);
  EXPECT_LE(status.frames_published() + status.frames_replaced(), status.step() / 4 + 1);
}

TEST_P(Running, WithoutAFrameRateThereAreNoFrames) {
  v1::Scene scene = lockstep_scene();
  scene.mutable_streams()->set_frame_rate_hz(0);
  const auto runner = load(scene);
  ASSERT_TRUE(runner->step(5));
  v1::Frame frame;
  EXPECT_FALSE(runner->take_frame(frame));
  EXPECT_REFUSED(runner->frame(), ErrorCode::kFailedPrecondition, "frame_rate_hz");
}

TEST_P(Running, FrameIsOfTheLastStep) {
  const auto runner = load(lockstep_scene());
  const auto rest = runner->frame();
  ASSERT_TRUE(rest);
  EXPECT_EQ(rest->step(), 0u);
  EXPECT_EQ(rest->positions().size(), 12u * runner->topology()->bodies(0).vertex_count());
  ASSERT_TRUE(runner->step(7));
  const auto later = runner->frame();
  ASSERT_TRUE(later);
  EXPECT_EQ(later->step(), 7u);
  EXPECT_NE(later->positions(), rest->positions());
  v1::Frame streamed;
  ASSERT_TRUE(runner->take_frame(streamed)) << "the last of a call's steps always goes out";
  EXPECT_EQ(streamed.step(), 7u);
  EXPECT_EQ(streamed.positions(), later->positions());
  EXPECT_FALSE(runner->take_frame(streamed));
}

TEST_P(Running, SignalsOutput) {
  const auto runner = load(lockstep_scene());
  std::atomic<int> signals{0};
  runner->set_output_signal([&] { ++signals; });
  const int before = signals;
  EXPECT_GT(before, 0) << "what lies there already is announced";
  ASSERT_TRUE(runner->step(5));
  EXPECT_EQ(signals - before, 5);
  runner->set_output_signal({});
}

TEST_P(Running, StatusIsDueAtItsRateAndWhenTheStateChanges) {
  v1::Scene scene = running_scene(100);
  scene.mutable_streams()->set_status_rate_hz(0);  // never by the clock
  const auto runner = load(scene);
  v1::SceneStatus status;
  EXPECT_TRUE(runner->take_status(status)) << "the first";
  EXPECT_FALSE(runner->take_status(status));
  ASSERT_TRUE(runner->pause());
  EXPECT_TRUE(runner->take_status(status));
  EXPECT_EQ(status.state(), v1::SceneStatus::STATE_PAUSED);
  EXPECT_FALSE(runner->take_status(status));

  scene.mutable_streams()->set_status_rate_hz(100);
  const auto talkative = load(scene);
  ASSERT_TRUE(talkative->take_status(status));
  EXPECT_TRUE(eventually([&] { return talkative->take_status(status); }));
}

TEST_P(Running, AStepThatLeftItsBoundsStopsTheSceneAndIsNotPublished) {
  const auto runner = load(doomed(lockstep_scene()));
  Result<v1::SceneStatus> status;
  std::uint64_t good_steps = 0;
  while (good_steps < 5000 && (status = runner->step(1))) ++good_steps;
  ASSERT_FALSE(status) << "it still goes on";
  EXPECT_EQ(status.error().code, ErrorCode::kFailedPrecondition);
  EXPECT_NE(status.error().message.find("farther than max_move_m"), std::string::npos) << status.error().message;
  EXPECT_GE(good_steps, 1u);

  const v1::SceneStatus faulted = runner->status();
  EXPECT_EQ(faulted.state(), v1::SceneStatus::STATE_FAULTED);
  EXPECT_NE(faulted.fault().find("step " + std::to_string(good_steps + 1)), std::string::npos) << faulted.fault();
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.step(), good_steps) << "the last good step's";
  EXPECT_EQ(norm(frame.tools(0).force_n()), 0);
  EXPECT_TRUE(all_finite(floats(frame.positions())));
  std::vector<v1::ToolFeedback> feedback;
  ASSERT_TRUE(runner->take_feedback(feedback));
  EXPECT_EQ(norm(feedback.at(0).force_n()), 0);
  EXPECT_EQ(norm(runner->feedback("probe")->force_n()), 0);
  EXPECT_REFUSED(runner->step(1), ErrorCode::kFailedPrecondition, "is stopped");
  const auto last_good = runner->frame();
  ASSERT_TRUE(last_good) << "for a report";
  EXPECT_EQ(last_good->positions(), frame.positions());
  EXPECT_EQ(runner->positions("beam")->step(), good_steps);

  const auto reset = runner->reset();
  ASSERT_TRUE(reset);
  EXPECT_EQ(reset->state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_EQ(reset->fault(), "");
  ASSERT_TRUE(runner->step(1));
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_TRUE(all_finite(floats(frame.positions())));
}

TEST_P(Running, AFaultStopsARunningSceneUntilItsReset) {
  const auto runner = load(doomed(running_scene(1000)));
  ASSERT_TRUE(eventually([&] { return runner->status().state() == v1::SceneStatus::STATE_FAULTED; }));
  EXPECT_REFUSED(runner->resume(), ErrorCode::kFailedPrecondition, "is stopped");
  EXPECT_REFUSED(runner->pause(), ErrorCode::kFailedPrecondition, "is stopped");
  const auto reset = runner->reset();
  ASSERT_TRUE(reset);
  EXPECT_EQ(reset->state(), v1::SceneStatus::STATE_RUNNING);
  EXPECT_TRUE(eventually([&] { return runner->status().step() > 0; }));
}

/// After any failure the bad step is not published, forces are zero, the status says why, and a reset restarts the
/// scene.
TEST_P(Running, NothingOfABadStepIsPublished) {
  for (const tests::Fault fault : {tests::Fault::kNotANumber, tests::Fault::kExplosion, tests::Fault::kStall}) {
    v1::Scene scene = lockstep_scene();
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
    tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
    const auto runner =
        load(scene, [&](std::uint64_t step, std::uint64_t) { return step == 4 ? std::optional(fault) : std::nullopt; });
    ASSERT_TRUE(runner->step(3));
    const std::string good = runner->positions("beam")->positions();
    EXPECT_GT(norm(runner->feedback("probe")->force_n()), 0);
    EXPECT_REFUSED(runner->step(2), ErrorCode::kFailedPrecondition, "step 4 left its bounds");

    v1::Frame frame;
    ASSERT_TRUE(runner->take_frame(frame));
    EXPECT_EQ(frame.step(), 3u);
    EXPECT_TRUE(all_finite(floats(frame.positions())));
    EXPECT_FALSE(runner->take_frame(frame));
    std::vector<v1::ToolFeedback> feedback;
    ASSERT_TRUE(runner->take_feedback(feedback));
    EXPECT_EQ(norm(feedback.at(0).force_n()), 0);
    for (const double stiffness : feedback[0].local_model().stiffness_n_per_m()) EXPECT_EQ(stiffness, 0);
    EXPECT_EQ(runner->positions("beam")->positions(), good);
    const v1::SceneStatus stopped = runner->status();
    EXPECT_EQ(stopped.state(), v1::SceneStatus::STATE_FAULTED);
    EXPECT_EQ(stopped.step(), 3u);
    EXPECT_EQ(stopped.guard_events(), 1u);
    EXPECT_EQ(stopped.guard_recoveries(), 0u);
    EXPECT_EQ(stopped.guard_text(), stopped.fault());

    ASSERT_TRUE(runner->reset());
    const auto again = runner->step(3);
    ASSERT_TRUE(again);
    EXPECT_EQ(again->step(), 3u);
    EXPECT_EQ(again->guard_events(), 0u);
    EXPECT_EQ(again->fault(), "");
    EXPECT_EQ(runner->positions("beam")->positions(), good);
  }
}

TEST_P(Running, ASceneGoesOnAfterASuccessfulRetryAndCountsIt) {
  const auto runner = load(lockstep_scene(), [](std::uint64_t step, std::uint64_t call) {
    return step % 2 == 0 && call < 2 ? std::optional(tests::Fault::kNotANumber) : std::nullopt;
  });
  const auto status = runner->step(6);
  ASSERT_TRUE(status) << status.error().message;
  EXPECT_EQ(status->state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_EQ(status->guard_events(), 3u);
  EXPECT_EQ(status->guard_recoveries(), 3u);
  EXPECT_NE(status->guard_text().find("step 6 left its bounds"), std::string::npos) << status->guard_text();
  EXPECT_NE(status->guard_text().find("repeated as 8 steps"), std::string::npos) << status->guard_text();
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.step(), 6u);
  EXPECT_TRUE(all_finite(floats(frame.positions()))) << "gathered again after the retry";
}

/// State on a failed device is not shown. After a reset, a device that works again is used again.
TEST_P(Running, ADeviceThatFailsStopsTheSceneUntilItsReset) {
  const auto runner = load(lockstep_scene(), [](std::uint64_t step, std::uint64_t) {
    return step == 3 ? std::optional(tests::Fault::kDeviceError) : std::nullopt;
  });
  EXPECT_REFUSED(runner->step(5), ErrorCode::kFailedPrecondition, "the device failed in step 3: injected");
  EXPECT_EQ(runner->status().state(), v1::SceneStatus::STATE_FAULTED);
  EXPECT_EQ(norm(runner->feedback("probe")->force_n()), 0);
  EXPECT_REFUSED(runner->frame(), ErrorCode::kFailedPrecondition, "is stopped");
  EXPECT_REFUSED(runner->positions("beam"), ErrorCode::kFailedPrecondition, "is stopped");
  const auto reset = runner->reset();
  ASSERT_TRUE(reset);
  EXPECT_EQ(reset->state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_TRUE(runner->step(1));
  EXPECT_TRUE(runner->frame());
}

TEST_P(Running, KeepsToABudgetDownToTheFloorAndWarns) {
  v1::Scene scene = running_scene(1000);
  scene.mutable_solver()->set_cg_max_iterations(60);
  scene.mutable_solver()->set_cg_tolerance(0);
  scene.mutable_solver()->set_floor_cg_iterations(25);
  scene.mutable_solver()->set_budget_s(limits::kMinBudgetS);  // no machine is that fast
  const auto runner = load(scene);
  EXPECT_EQ(runner->status().step_budget_s(), limits::kMinBudgetS);
  EXPECT_EQ(runner->status().floor_cg_iterations(), 25u);
  ASSERT_TRUE(eventually([&] { return runner->status().cg_iteration_limit() == 25; }));
  const std::uint64_t then = runner->status().step();
  ASSERT_TRUE(eventually([&] { return runner->status().step() > then + 20; }));
  const v1::SceneStatus status = runner->status();
  EXPECT_EQ(status.cg_iterations(), 25u) << "and no fewer";
  ASSERT_EQ(status.warnings_size(), 2);
  EXPECT_NE(status.warnings(0).find("25 of 60 iterations"), std::string::npos) << status.warnings(0);
  EXPECT_NE(status.warnings(1).find("the floor is 25 iterations"), std::string::npos) << status.warnings(1);
  const auto reset = runner->reset();
  ASSERT_TRUE(reset);
  EXPECT_EQ(reset->cg_iteration_limit(), 60u);

  scene.mutable_solver()->set_budget_s(limits::kMaxBudgetS);
  const auto rich = load(scene);
  ASSERT_TRUE(eventually([&] { return rich->status().step() > 40; }));
  EXPECT_EQ(rich->status().cg_iteration_limit(), 60u);
  const v1::SceneStatus at_ease = rich->status();
  EXPECT_EQ(at_ease.warnings_size(), 0) << at_ease.warnings(0);
}

TEST_P(Running, CountsMissedDeadlines) {
  v1::Scene scene = tests::block_with_probe(true, 12);
  scene.mutable_stepping()->set_lockstep(false);
  scene.mutable_stepping()->set_rate_hz(limits::kMaxRateHz);
  scene.mutable_solver()->set_cg_max_iterations(500);
  scene.mutable_solver()->set_cg_tolerance(0);
  const auto runner = load(scene);
  ASSERT_TRUE(eventually([&] { return runner->status().missed_deadlines() >= 3; }));
  const v1::SceneStatus status = runner->status();
  EXPECT_LE(status.missed_deadlines(), status.step());
  EXPECT_EQ(status.state(), v1::SceneStatus::STATE_RUNNING) << "it says so and goes on";
}

/// Unloading releases the runner. The scene ends when the last call in progress returns.
TEST_P(Running, EndsWithTheLastCallThatHoldsIt) {
  std::shared_ptr<Runner> runner = load(lockstep_scene());
  const std::weak_ptr<Runner> watched = runner;
  std::atomic<bool> stepping{false};
  std::thread client([held = runner, &stepping] {
    for (int i = 0; i < 20; ++i) {
      EXPECT_TRUE(held->step(5));
      stepping = true;
    }
  });
  ASSERT_TRUE(eventually([&] { return stepping.load(); }));
  runner.reset();
  client.join();
  EXPECT_TRUE(watched.expired());
}

/// A daemon can end although a `step` call would take hours.
TEST_P(Running, CancelEndsAStepCallUnderWay) {
  const auto runner = load(lockstep_scene());
  std::thread canceller([&] {
    EXPECT_TRUE(eventually([&] { return runner->status().step() > 0; }));
    runner->cancel();
  });
  EXPECT_REFUSED(runner->step(limits::kMaxStepsPerCall), ErrorCode::kUnavailable, "is being unloaded");
  canceller.join();
}

TEST_P(Running, EndsWhileItRuns) {
  for (int i = 0; i < 20; ++i) {
    const auto runner = load(running_scene(limits::kMaxRateHz));
    ASSERT_TRUE(eventually([&] { return runner->status().step() > 0; }));
  }
}

TEST_P(Running, AnswersFromManyThreadsAtOnce) {
  const auto runner = load(running_scene(500));
  std::vector<std::thread> clients;
  for (int id = 1; id <= 4; ++id) {
    clients.emplace_back([&, id] {
      for (std::uint64_t i = 1; i <= 50; ++i) {
        v1::ToolPose next = pose(0.05, 0.06, 0.05, i);
        next.set_client_id(static_cast<std::uint64_t>(id));
        EXPECT_TRUE(runner->submit_pose("probe", next));
        EXPECT_TRUE(runner->frame());
        EXPECT_TRUE(runner->feedback("probe"));
        EXPECT_EQ(runner->status().scene(), "block");
        EXPECT_TRUE(i % 10 != 0 || runner->reset());
      }
    });
  }
  for (std::thread& client : clients) client.join();
  EXPECT_EQ(runner->status().poses_received(), 200u);
}

TM_ON_EACH_BACKEND(Running);

TEST(Backends, AutoFallsBackToTheCpuAndCudaDoesNot) {
  const auto cpu = describe_backend(BackendChoice::kCpu);
  ASSERT_TRUE(cpu);
  EXPECT_EQ(cpu->backend, "cpu");
  EXPECT_NE(cpu->device.find("threads"), std::string::npos);
  const auto automatic = describe_backend(BackendChoice::kAuto), cuda = describe_backend(BackendChoice::kCuda);
  ASSERT_TRUE(automatic);
  EXPECT_EQ(automatic->backend, cuda ? "cuda" : "cpu");
  if (!cuda) {
    EXPECT_EQ(cuda.error().code, ErrorCode::kUnavailable);
    EXPECT_FALSE(cuda.error().message.empty());
  }
}

}  // namespace
}  // namespace tensormass::world
