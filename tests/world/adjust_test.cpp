#include "world/adjustments.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <limits>
#include <thread>

#include <gtest/gtest.h>

#include "support/eventually.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/loop.h"
#include "world/runner.h"

/// Gravity, stiffness and damping that change while a scene is loaded.
namespace tensormass::world {
namespace {

v1::Scene sagging_beam(bool lockstep = true) {
  v1::Scene scene = tests::beam_scene({.cells_x = 8, .cells_y = 2, .cells_z = 2, .frame_rate_hz = 60});
  scene.mutable_stepping()->set_lockstep(lockstep);
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(1);
  return scene;
}

v1::SceneAdjustments stiffness(double factor) {
  v1::SceneAdjustments out;
  v1::BodyAdjustment& body = *out.add_bodies();
  body.set_body("beam");
  body.set_stiffness_factor(factor);
  return out;
}

class Adjusting : public tests::OnRunner {
 protected:
  static std::string positions(Runner& runner) {
    auto out = runner.positions("beam");
    if (!out) throw std::runtime_error(out.error().message);
    return out->positions();
  }
  /// Height of the lowest node [m].
  static double lowest_m(Runner& runner) {
    const std::string bytes = positions(runner);
    double lowest = 1e9;
    for (std::size_t at = sizeof(double); at < bytes.size(); at += 3 * sizeof(double)) {
      double y;
      std::memcpy(&y, bytes.data() + at, sizeof(y));
      lowest = std::min(lowest, y);
    }
    return lowest;
  }
};

TEST_P(Adjusting, GoesOnFromTheStateAndKeepsTheTopology) {
  const auto runner = load(sagging_beam());
  ASSERT_TRUE(runner->step(20));
  const std::string before = positions(*runner);
  const std::uint64_t version = runner->topology()->version();
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  const std::uint64_t sequence = frame.sequence();
  std::atomic<int> signals{0};
  runner->set_output_signal([&] { ++signals; });
  const auto adjusted = runner->adjust(stiffness(10));
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  EXPECT_EQ(adjusted->status().step(), 20u);
  EXPECT_EQ(adjusted->adjustments().bodies(0).stiffness_factor(), 10);
  EXPECT_EQ(adjusted->adjustments().bodies(0).rayleigh_mass_per_s(), 1);
  EXPECT_EQ(positions(*runner), before);
  EXPECT_EQ(runner->topology()->version(), version);
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_GT(frame.sequence(), sequence) << "viewers drop what is not newer";
  const int signals_before = signals;
  ASSERT_TRUE(runner->step(1));
  EXPECT_GT(signals, signals_before) << "the publisher waits for it";
}

/// An adjusted scene moves as a scene that was loaded with these values, from the same state on.
TEST_P(Adjusting, StepsAsASceneThatWasLoadedWithTheseValues) {
  const auto adjusted = load(sagging_beam());
  v1::SceneAdjustments changes = stiffness(4);
  changes.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
  tests::set(*changes.mutable_gravity_m_per_s2(), 1, -5, 0);
  ASSERT_TRUE(adjusted->adjust(changes));

  v1::Scene other = sagging_beam();
  other.mutable_bodies(0)->mutable_law()->mutable_st_venant_kirchhoff()->set_young_modulus_pa(4e6);
  other.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
  tests::set(*other.mutable_gravity_m_per_s2(), 1, -5, 0);
  const auto loaded = load(other);
  for (Runner* runner : {adjusted.get(), loaded.get()}) ASSERT_TRUE(runner->step(30));
  EXPECT_EQ(positions(*adjusted), positions(*loaded));
  for (Runner* runner : {adjusted.get(), loaded.get()}) ASSERT_TRUE(runner->reset());
  for (Runner* runner : {adjusted.get(), loaded.get()}) ASSERT_TRUE(runner->step(10));
  EXPECT_EQ(positions(*adjusted), positions(*loaded)) << "a reset keeps the values";
}

TEST_P(Adjusting, AStifferBeamRises) {
  const auto runner = load(sagging_beam());
  ASSERT_TRUE(runner->step(60));
  const double sagged = lowest_m(*runner);
  ASSERT_TRUE(runner->adjust(stiffness(20)));
  const auto status = runner->step(60);
  ASSERT_TRUE(status) << status.error().message;
  EXPECT_EQ(status->step(), 120u);
  EXPECT_GT(lowest_m(*runner), sagged + 0.1);
}

/// Every kind of law, also those of parts and of single elements, has its moduli scaled.
TEST(Adjustments, ScaleEveryModulusAndNothingElse) {
  v1::Scene scene = sagging_beam();
  v1::Body& body = *scene.mutable_bodies(0);
  v1::Ogden& ogden = *body.add_law_regions()->mutable_law()->mutable_ogden();
  ogden.set_mu_pa(100);
  ogden.set_alpha(3);
  ogden.set_bulk_modulus_pa(1000);
  const double young = 7;
  body.mutable_element_fields()->set_young_modulus_pa(&young, sizeof(young));
  const auto wanted = with_changes(adjustments_of(scene), stiffness(2));
  ASSERT_TRUE(wanted);
  const v1::Scene out = adjusted(scene, *wanted);
  EXPECT_EQ(out.bodies(0).law().st_venant_kirchhoff().young_modulus_pa(), 2e6);
  EXPECT_EQ(out.bodies(0).law().st_venant_kirchhoff().poisson_ratio(), 0.4);
  EXPECT_EQ(out.bodies(0).law_regions(0).law().ogden().mu_pa(), 200);
  EXPECT_EQ(out.bodies(0).law_regions(0).law().ogden().alpha(), 3);
  EXPECT_EQ(out.bodies(0).law_regions(0).law().ogden().bulk_modulus_pa(), 2000);
  double scaled;
  std::memcpy(&scaled, out.bodies(0).element_fields().young_modulus_pa().data(), sizeof(scaled));
  EXPECT_EQ(scaled, 14);
}

TEST_P(Adjusting, BadValuesChangeNothing) {
  const auto runner = load(sagging_beam());
  ASSERT_TRUE(runner->step(3));
  const std::string before = positions(*runner);
  EXPECT_REFUSED(runner->adjust(stiffness(0)), ErrorCode::kInvalidArgument, "stiffness_factor");
  EXPECT_REFUSED(runner->adjust(stiffness(std::nan(""))), ErrorCode::kInvalidArgument, "stiffness_factor");
  v1::SceneAdjustments unknown = stiffness(2);
  unknown.mutable_bodies(0)->set_body("liver");
  EXPECT_REFUSED(runner->adjust(unknown), ErrorCode::kNotFound, "no body 'liver'");
  v1::SceneAdjustments twice = stiffness(2);
  *twice.add_bodies() = twice.bodies(0);
  EXPECT_REFUSED(runner->adjust(twice), ErrorCode::kInvalidArgument, "named twice");
  v1::SceneAdjustments negative;
  negative.add_bodies()->set_body("beam");
  negative.mutable_bodies(0)->set_rayleigh_mass_per_s(-1);
  EXPECT_REFUSED(runner->adjust(negative), ErrorCode::kInvalidArgument, "rayleigh_mass_per_s");
  v1::SceneAdjustments up;
  tests::set(*up.mutable_gravity_m_per_s2(), 0, std::numeric_limits<double>::infinity(), 0);
  EXPECT_REFUSED(runner->adjust(up), ErrorCode::kInvalidArgument, "gravity_m_per_s2");
  const auto present = runner->adjust({});
  ASSERT_TRUE(present);
  EXPECT_EQ(present->adjustments().bodies(0).stiffness_factor(), 1);
  EXPECT_EQ(present->adjustments().gravity_m_per_s2().y(), -9.81);
  EXPECT_EQ(positions(*runner), before);
  ASSERT_TRUE(runner->step(1));
}

/// What a status counts, and the newest pose, are of the scene and not of its present values.
TEST_P(Adjusting, CountsStepTimesAndTheNewestPoseStay) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_stepping()->set_lockstep(true);
  const auto runner = load(scene);
  v1::ToolPose pose;
  pose.mutable_position_m()->set_y(0.1);
  ASSERT_TRUE(runner->submit_pose("probe", pose));
  EXPECT_REFUSED(runner->submit_pose("knife", pose), ErrorCode::kNotFound, "knife");
  ASSERT_TRUE(runner->step(20));
  pose.mutable_position_m()->set_x(0.02);
  ASSERT_TRUE(runner->submit_pose("probe", pose));
  pose.mutable_position_m()->set_x(0.04);
  ASSERT_TRUE(runner->submit_pose("probe", pose));
  const v1::SceneStatus before = runner->status();
  v1::SceneAdjustments lighter;
  lighter.mutable_gravity_m_per_s2()->set_y(-1);
  ASSERT_TRUE(runner->adjust(lighter));
  const v1::SceneStatus after = runner->status();
  EXPECT_EQ(after.poses_received(), 3u);
  EXPECT_EQ(after.poses_superseded(), 1u);
  EXPECT_EQ(after.poses_rejected(), before.poses_rejected());
  EXPECT_EQ(after.step_time_p99_s(), before.step_time_p99_s());
  EXPECT_GT(after.step_time_p50_s(), 0);
  EXPECT_EQ(after.step_times().SerializeAsString(), before.step_times().SerializeAsString());
  EXPECT_EQ(after.cg_iterations(), before.cg_iterations()) << "of the last step";
  EXPECT_GE(after.frames_published() + after.frames_replaced(), before.frames_published() + before.frames_replaced());
  ASSERT_TRUE(runner->step(200));
  EXPECT_NEAR(runner->feedback("probe")->position_m().x(), 0.04, 1e-9) << "a pose that no step had taken";
}

TEST_P(Adjusting, AHandKeepsItsToolAndItsSequence) {
  const auto runner = load(tests::block_with_probe(false, 4));
  v1::ToolPose hand;
  hand.mutable_position_m()->set_y(0.1);
  hand.set_session(5);
  hand.set_sequence(9);
  hand.set_valid_for_s(3600);
  ASSERT_TRUE(runner->submit_pose("probe", hand));
  v1::SceneAdjustments lighter;
  lighter.mutable_gravity_m_per_s2()->set_y(-1);
  const auto adjusted = runner->adjust(lighter);
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  v1::ToolPose other = hand;
  other.set_session(6);
  EXPECT_REFUSED(runner->submit_pose("probe", other), ErrorCode::kFailedPrecondition, "claims it");
  EXPECT_REFUSED(runner->submit_pose("probe", hand), ErrorCode::kInvalidArgument, "not newer");
  hand.set_sequence(10);
  EXPECT_TRUE(runner->submit_pose("probe", hand));
}

TEST_P(Adjusting, APausedSceneStaysPaused) {
  const auto runner = load(sagging_beam(false));
  ASSERT_TRUE(runner->pause());
  const std::uint64_t step = runner->status().step();
  const auto adjusted = runner->adjust(stiffness(3));
  ASSERT_TRUE(adjusted);
  EXPECT_EQ(adjusted->status().state(), v1::SceneStatus::STATE_PAUSED);
  EXPECT_EQ(runner->status().step(), step);
}

/// No command is lost and no reader waits while loops replace each other.
TEST_P(Adjusting, CommandsFromManyThreadsAllArrive) {
  const auto runner = load(sagging_beam());
  std::atomic<bool> ends{false};
  std::thread reader([&] {
    v1::Frame frame;
    std::uint64_t newest = 0;
    while (!ends) {
      if (runner->take_frame(frame)) {
        EXPECT_GT(frame.sequence(), newest);
        newest = frame.sequence();
      }
      EXPECT_EQ(runner->status().scene(), "beam");
    }
  });
  constexpr std::uint64_t kSteps = 40;
  std::thread stepper([&] {
    for (std::uint64_t i = 0; i < kSteps; ++i) EXPECT_TRUE(runner->step(1));
  });
  for (int i = 0; i < 6; ++i) EXPECT_TRUE(runner->adjust(stiffness(i % 2 == 0 ? 2 : 1)));
  stepper.join();
  ends = true;
  reader.join();
  EXPECT_EQ(runner->status().step(), kSteps);
}

/// What a keeper gets has the values of its state, whenever an adjustment comes.
TEST_P(Adjusting, AStateIsKeptWithItsValues) {
  const auto runner = load(sagging_beam(false));
  std::atomic<bool> ends{false};
  std::thread adjuster([&] {
    for (int i = 0; i < 8; ++i) EXPECT_TRUE(runner->adjust(stiffness(2 + i)));
    ends = true;
  });
  std::vector<KeptState> kept;
  do {
    auto state = runner->keep();
    EXPECT_TRUE(state) << state.error().message;
    if (!state) break;
    const double factor = state->adjustments.bodies(0).stiffness_factor();
    if (kept.empty() || kept.back().adjustments.bodies(0).stiffness_factor() != factor) kept.push_back(*state);
  } while (!ends);
  adjuster.join();
  EXPECT_GT(kept.size(), 1u);
  const auto other = load(sagging_beam());
  for (const KeptState& state : kept) {
    ASSERT_TRUE(other->adjust(state.adjustments));
    const auto restored = other->restore(state.snapshot);
    EXPECT_TRUE(restored) << restored.error().message;
  }
}

/// A snapshot is of the values before an adjustment or of those after it, never of something in between.
TEST_P(Adjusting, ARestoreMeetsTheValuesBeforeOrAfter) {
  const auto runner = load(sagging_beam());
  ASSERT_TRUE(runner->step(3));
  const auto snapshot = runner->snapshot();
  ASSERT_TRUE(snapshot);
  std::atomic<bool> ends{false};
  std::thread adjuster([&] {
    for (int i = 0; i < 10; ++i) EXPECT_TRUE(runner->adjust(stiffness(i % 2 == 0 ? 2 : 1)));
    ends = true;
  });
  while (!ends) {
    const auto restored = runner->restore(snapshot->snapshot());
    if (!restored) {
      EXPECT_REFUSED(restored, ErrorCode::kFailedPrecondition, "or of other values");
    }
  }
  adjuster.join();
  EXPECT_TRUE(runner->restore(snapshot->snapshot())) << "the last adjustment brought the first values back";
}

/// A world that cannot take the state over is dropped, and the scene steps on with the one that it has.
TEST_P(Adjusting, AWorldThatCannotTakeOverChangesNothing) {
  auto world = start(sagging_beam());
  const auto first = std::make_shared<const Generation>(Generation{0, world->shared_model(), 1, {}, false, {}});
  Loop loop(SceneDevice{GetParam(), "", 0}, std::move(world), first);
  const auto positions_now = [&] { return loop.call([&] { return loop.do_positions("beam"); }).value().positions(); };
  ASSERT_TRUE(loop.call([&] { return loop.do_step(3); }));
  const std::string before = positions_now();
  const v1::SceneStatus status = loop.status().make();
  const auto edit = std::make_shared<const Edit>(Adjust{stiffness(2)});

  backend_ = std::make_unique<tests::FaultyBackend>(
      std::move(backend_), [](std::uint64_t step, std::uint64_t) -> std::optional<tests::Fault> {
        return step == 0 ? std::optional(tests::Fault::kWriteError) : std::nullopt;
      });
  auto broken = start(sagging_beam());
  SetUp();  // the working backend again
  const auto second = std::make_shared<const Generation>(Generation{1, broken->shared_model(), 2, {}, true, {}});
  Loop::Swap fails{std::move(broken), second, edit, nullptr};
  EXPECT_REFUSED(loop.call([&] { return loop.do_swap(fails); }), ErrorCode::kUnavailable,
                 "injected; the scene is unchanged");
  EXPECT_EQ(loop.generation(), first);
  EXPECT_EQ(positions_now(), before);
  EXPECT_EQ(loop.status().make().state(), status.state());
  ASSERT_TRUE(loop.call([&] { return loop.do_step(1); }));

  auto sound = start(sagging_beam());
  const auto third = std::make_shared<const Generation>(Generation{1, sound->shared_model(), 2, {}, true, {}});
  const std::string later = positions_now();
  Loop::Swap swap{std::move(sound), third, edit, nullptr};
  ASSERT_TRUE(loop.call([&] { return loop.do_swap(swap); }));
  EXPECT_EQ(loop.generation(), third);
  EXPECT_EQ(&swap.world->model(), first->model.get()) << "the caller ends the world before";
  EXPECT_EQ(positions_now(), later);
}

/// Values that make the scene safe end a fault, as a reset does.
TEST_P(Adjusting, AFaultEndsWithItsValues) {
  v1::Scene scene = sagging_beam();
  scene.mutable_guard()->set_max_move_m(1e-9);
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
  const auto runner = load(scene);
  EXPECT_FALSE(runner->step(3));
  ASSERT_EQ(runner->status().state(), v1::SceneStatus::STATE_FAULTED);
  v1::SceneAdjustments weightless;
  weightless.mutable_gravity_m_per_s2()->set_y(0);
  const auto adjusted = runner->adjust(weightless);
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  EXPECT_EQ(adjusted->status().state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_EQ(adjusted->status().fault(), "");
  const auto stepped = runner->step(3);
  EXPECT_TRUE(stepped) << stepped.error().message;
}

/// Presses the probe of block_with_probe into the block by 6 mm.
void press(Runner& runner) {
  v1::ToolPose pose;
  tests::set(*pose.mutable_position_m(), 0.05, 0.054, 0.05);
  ASSERT_TRUE(runner.submit_pose("probe", pose));
  ASSERT_TRUE(runner.step(150));
  ASSERT_GT(runner.feedback("probe")->force_n().y(), 0);
}

/// Tissue under a tool holds energy. A hundred times the stiffness would make it a hundred times as much at once.
TEST_P(Adjusting, TissueUnderAToolGetsStifferInParts) {
  const v1::Scene scene = tests::block_with_probe(false, 6);
  const auto runner = load(scene);
  const auto started = runner->record({.check_every_steps = 1, .reset = true});
  ASSERT_TRUE(started) << started.error().message;
  press(*runner);
  const double before_n = runner->feedback("probe")->force_n().y();
  const auto adjusted = runner->adjust(stiffness(100));
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  EXPECT_EQ(adjusted->adjustments().bodies(0).stiffness_factor(), 100) << "what it will be";
  double factor = runner->snapshot()->adjustments().bodies(0).stiffness_factor();
  EXPECT_LE(factor, 1.25);
  int parts = 1;
  for (int i = 0; i < 60; ++i) {
    const auto status = runner->step(1);
    ASSERT_TRUE(status) << status.error().message;
    EXPECT_EQ(status->fault(), "");
    const double now = runner->snapshot()->adjustments().bodies(0).stiffness_factor();
    EXPECT_LE(now, factor * 1.2501);
    if (now != factor) ++parts;
    factor = now;
  }
  EXPECT_EQ(factor, 100);
  EXPECT_GE(parts, 20);
  EXPECT_EQ(runner->status().guard_events(), 0u) << "no step was made again";
  EXPECT_GT(runner->feedback("probe")->force_n().y(), 20 * before_n);

  const auto [request, checks] = tests::take_recorded(*started);
  const auto other = load(scene);
  const auto replayed = other->replay(request);
  ASSERT_TRUE(replayed) << replayed.error().message;
  tests::expect_repeated(*replayed, checks);
}

/// A reset takes what is left of a change, and another change goes on from the values that were wanted.
TEST_P(Adjusting, PartsThatAreLeftAreNotForgotten) {
  const auto runner = load(tests::block_with_probe(false, 4));
  press(*runner);
  ASSERT_TRUE(runner->adjust(stiffness(50)));
  ASSERT_TRUE(runner->step(3));
  v1::SceneAdjustments lighter;
  lighter.mutable_gravity_m_per_s2()->set_y(-1);
  const auto adjusted = runner->adjust(lighter);
  ASSERT_TRUE(adjusted) << adjusted.error().message;
  EXPECT_EQ(adjusted->adjustments().bodies(0).stiffness_factor(), 50);
  EXPECT_EQ(adjusted->adjustments().gravity_m_per_s2().y(), -1);
  EXPECT_LT(runner->snapshot()->adjustments().bodies(0).stiffness_factor(), 50);
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->snapshot()->adjustments().bodies(0).stiffness_factor(), 50);
  EXPECT_EQ(runner->snapshot()->adjustments().gravity_m_per_s2().y(), -1);
}

/// A scene that runs by the clock takes its parts without a call.
TEST_P(Adjusting, PartsComeWhileAHandPresses) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_stepping()->set_lockstep(false);
  const auto runner = load(scene);
  v1::ToolPose pose;
  tests::set(*pose.mutable_position_m(), 0.05, 0.056, 0.05);
  pose.set_valid_for_s(3600);
  ASSERT_TRUE(runner->submit_pose("probe", pose));
  ASSERT_TRUE(tests::eventually([&] { return runner->feedback("probe")->touching(); }, std::chrono::seconds(60)));
  ASSERT_TRUE(runner->adjust(stiffness(4)));
  EXPECT_LT(runner->snapshot()->adjustments().bodies(0).stiffness_factor(), 4);
  EXPECT_TRUE(tests::eventually([&] { return runner->snapshot()->adjustments().bodies(0).stiffness_factor() == 4; },
                                std::chrono::seconds(60)));
  EXPECT_EQ(runner->status().fault(), "");
}

TM_ON_EACH_BACKEND(Adjusting);

}  // namespace
}  // namespace tensormass::world
