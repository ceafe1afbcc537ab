#include <cmath>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/faulty_backend.h"
#include "support/on_runner.h"
#include "support/scenes.h"
#include "support/tools.h"
#include "world/world.h"

/// A hand that pushes a tool never stops a scene: the tool gives way above its largest load, backs off where a step
/// cannot be made, and the tissue is held where that does not help.
namespace tensormass::world {
namespace {

using tests::Fault;
using Outcome = GuardEvent::Outcome;

constexpr double kDtS = 0.01;
/// Above the block, and pressed 6 mm into it.
const Pose kAbove{{0.05, 0.07, 0.05}, {1, 0, 0, 0}, {}};
const Pose kPressed{{0.05, 0.054, 0.05}, {1, 0, 0, 0}, {}};

/// Precision and solver of a step, over all that a recovery restores.
struct Kind {
  const char* name;
  bool double_precision;
  v1::Solver::Integrator integrator;
  std::uint32_t newton_iterations;
};
const std::vector<Kind> kKinds{{"plain", true, v1::Solver::INTEGRATOR_IMPLICIT_EULER, 0},
                               {"float", false, v1::Solver::INTEGRATOR_IMPLICIT_EULER, 0},
                               {"bdf2", true, v1::Solver::INTEGRATOR_BDF2, 0},
                               {"newton", true, v1::Solver::INTEGRATOR_BDF2, 5}};

v1::Scene block(const Kind& kind, std::uint32_t cells = 4) {
  v1::Scene scene = tests::block_with_probe(kind.double_precision, cells);
  scene.mutable_stepping()->set_dt_s(kDtS);
  scene.mutable_solver()->set_integrator(kind.integrator);
  if (kind.newton_iterations > 0) scene.mutable_solver()->set_newton_max_iterations(kind.newton_iterations);
  return scene;
}

class Recovery : public tests::OnFaultyBackend {
 protected:
  /// Returns a world with the probe pressed in, as many steps long as that takes.
  static void press(World& world) {
    world.set_tool_target(0, kPressed);
    for (std::uint64_t i = 0; i < kPressSteps; ++i) ASSERT_TRUE(world.step(false));
    ASSERT_GT(world.readings()[0].force_n.y(), 0.01);
  }
  static constexpr std::uint64_t kPressSteps = 40;
};

/// The tool stays where the step began, then follows the hand in growing steps.
TEST_P(Recovery, AStepIsMadeWithToolsThatBackOff) {
  for (const Kind& kind : kKinds) {
    SCOPED_TRACE(kind.name);
    constexpr std::uint64_t kFaulty = kPressSteps + 1;
    // The step as planned and its retry fail at once: the call after them is the first with the tool moved.
    const auto world = start_faulty(block(kind), [](std::uint64_t step, std::uint64_t call) {
      return step == kFaulty && call < 2 ? std::optional(Fault::kNotANumber) : std::nullopt;
    });
    press(*world);
    const ToolReading before = world->readings()[0];
    Pose deeper = kPressed;
    deeper.position_m.y() -= 0.004;
    world->set_tool_target(0, deeper);
    ASSERT_TRUE(world->step(false));
    ASSERT_NE(world->guard_event(), nullptr);
    EXPECT_EQ(world->guard_event()->outcome, Outcome::kBackedOff);
    EXPECT_TRUE(world->recovering());
    const ToolReading during = world->readings()[0];
    EXPECT_TRUE(during.recovering && during.gives_way);
    EXPECT_EQ(during.pose.position_m, before.pose.position_m);
    EXPECT_EQ(during.hand_m, deeper.position_m) << "the local model starts at the hand";
    EXPECT_GT(during.force_n.y(), 0.5 * before.force_n.y()) << "the hand still feels tissue";
    ASSERT_TRUE(world->step(false));
    EXPECT_FALSE(world->recovering());
    const double advance_m = before.pose.position_m.y() - world->readings()[0].pose.position_m.y();
    EXPECT_GT(advance_m, 0);
    EXPECT_LT(advance_m, 0.004 / 4);
    for (int i = 0; i < 10; ++i) ASSERT_TRUE(world->step(false));
    EXPECT_EQ(world->readings()[0].pose.position_m, deeper.position_m) << "the tool is in the hand again";
    EXPECT_FALSE(world->readings()[0].gives_way);
  }
}

TEST_P(Recovery, TissueIsHeldAtRestWhereNoTrialHelps) {
  for (const Kind& kind : kKinds) {
    for (const Fault fault : {Fault::kNotANumber, Fault::kExplosion}) {
      SCOPED_TRACE(kind.name);
      const auto world = start_faulty(block(kind), [=](std::uint64_t step, std::uint64_t) {
        return step == kPressSteps + 1 ? std::optional(fault) : std::nullopt;
      });
      const auto sound = start(block(kind));
      press(*world);
      press(*sound);
      const backend::RowState before = world->state();
      const ToolReading reading = world->readings()[0];
      ASSERT_TRUE(world->step(false));
      ASSERT_NE(world->guard_event(), nullptr);
      EXPECT_EQ(world->guard_event()->outcome, Outcome::kHeld);
      EXPECT_TRUE(world->readings()[0].recovering);
      EXPECT_EQ(world->step_count(), kPressSteps + 1) << "time goes on";
      EXPECT_EQ(world->state().displacement, before.displacement);
      EXPECT_EQ(world->state().velocity, std::vector<double>(before.velocity.size(), 0.0));
      EXPECT_EQ(world->readings()[0].force_n, reading.force_n);
      EXPECT_EQ(world->last().kinetic_energy_j, 0);
      for (int i = 0; i < 40; ++i) {
        ASSERT_TRUE(world->step(false)) << i;
        EXPECT_GT(world->readings()[0].force_n.y(), 0.1 * reading.force_n.y()) << i;
        EXPECT_LT(world->readings()[0].force_n.y(), 2 * reading.force_n.y()) << i;
      }
      for (int i = 0; i < 41; ++i) ASSERT_TRUE(sound->step(false));
      const double settled_n = sound->readings()[0].force_n.y();
      EXPECT_NEAR(world->readings()[0].force_n.y(), settled_n, 0.02 * settled_n);
    }
  }
}

/// If no step can be made again, that is not a recovery.
TEST_P(Recovery, ASceneThatIsHeldForATenthOfASecondStops) {
  const auto world = start_faulty(block(kKinds[0]), [](std::uint64_t step, std::uint64_t) {
    return step > kPressSteps ? std::optional(Fault::kNotANumber) : std::nullopt;
  });
  press(*world);
  const backend::RowState before = world->state();
  int held = 0;
  while (world->step(false)) ASSERT_LE(++held, 1000);
  EXPECT_EQ(held, std::lround(World::kLongestHeldS / kDtS));
  EXPECT_EQ(world->guard_event()->outcome, Outcome::kStopped);
  EXPECT_EQ(world->state().displacement, before.displacement);
}

TEST_P(Recovery, OnlyAToolThatAHandMovesLetsASceneGoOn) {
  const auto goes_on = [&](const std::function<void(v1::Scene&)>& change) {
    v1::Scene scene = block(kKinds[0]);
    change(scene);
    return start(scene)->model().goes_on;
  };
  EXPECT_TRUE(goes_on([](v1::Scene&) {}));
  EXPECT_FALSE(goes_on([](v1::Scene& s) { s.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP); }));
  EXPECT_FALSE(goes_on([](v1::Scene& s) { s.clear_tools(); }));
  EXPECT_FALSE(goes_on([](v1::Scene& s) {
    s.mutable_tools(0)->set_fixed(true);
    s.mutable_tools(0)->clear_max_force_n();
    s.mutable_tools(0)->clear_max_torque_n_m();
  }));
  EXPECT_TRUE(goes_on([](v1::Scene& s) {
    s.clear_tools();
    s.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
  }));
  EXPECT_FALSE(goes_on([](v1::Scene& s) { s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC); }));
}

/// The hand pushes on; the load stays at the largest. Where the hand goes back, the tool is in it again.
TEST_P(Recovery, AToolGivesWayAboveItsLargestForce) {
  for (const Kind& kind : kKinds) {
    for (const double dt_s : {kDtS, 1e-3}) {
      SCOPED_TRACE(kind.name + std::to_string(dt_s));
      v1::Scene scene = block(kind, 8);  // on the coarse one the probe touches one triangle, and bounces off
      scene.mutable_stepping()->set_dt_s(dt_s);
      const double largest_n = 0.25;
      scene.mutable_tools(0)->set_max_force_n(largest_n);
      const auto world = start(scene);
      Pose hand = kAbove;
      bool gave_way = false;
      const auto move_to = [&](double y_m) {
        const double from_m = hand.position_m.y();
        const int steps = static_cast<int>(std::ceil(std::abs(y_m - from_m) / (0.1 * dt_s)));
        for (int i = 1; i <= steps; ++i) {
          hand.position_m.y() = from_m + (y_m - from_m) * i / steps;
          world->set_tool_target(0, hand);
          ASSERT_TRUE(world->step(false));
          const ToolReading& reading = world->readings()[0];
          ASSERT_LE(reading.force_n.norm(), largest_n) << hand.position_m.y();
          ASSERT_FALSE(reading.recovering);
          if (reading.gives_way) {
            EXPECT_EQ(reading.hand_m, hand.position_m);
          }
          gave_way = gave_way || reading.gives_way;
        }
      };
      move_to(0.04);
      EXPECT_TRUE(gave_way);
      // At its largest load the tool gives way and comes back, step by step, so the mean of the last 0.1 s counts.
      double mean_n = 0, counted = 0;
      for (double t_s = 0; t_s < 0.5; t_s += dt_s) {
        ASSERT_TRUE(world->step(false));
        if (t_s < 0.4) continue;
        mean_n += world->readings()[0].force_n.norm();
        ++counted;
      }
      mean_n /= counted;
      // In small steps of BDF2 nothing damps this tissue, and the tool bounces off it.
      const bool damped = kind.integrator == v1::Solver::INTEGRATOR_IMPLICIT_EULER || dt_s == kDtS;
      if (damped) {
        EXPECT_GT(mean_n, 0.6 * largest_n) << "it holds against the hand";
      }
      EXPECT_GT(world->readings()[0].pose.position_m.y(), 0.045);
      move_to(0.07);
      EXPECT_EQ(world->readings()[0].pose.position_m, hand.position_m);
      EXPECT_FALSE(world->readings()[0].gives_way);
      EXPECT_EQ(world->readings()[0].force_n.norm(), 0);
    }
  }
}

/// Below the largest force the hold is rigid: no bit depends on it.
TEST_P(Recovery, AHoldThatIsNotReachedCostsNothing) {
  v1::Scene scene = block(kKinds[1]);
  const auto free = start(scene);
  scene.mutable_tools(0)->set_max_force_n(2);
  const auto held = start(scene);
  press(*free);
  press(*held);
  EXPECT_LT(free->readings()[0].force_n.norm(), 2);
  EXPECT_EQ(free->state().displacement, held->state().displacement);
  EXPECT_EQ(free->readings()[0].force_n, held->readings()[0].force_n);
}

/// Jaws that shut on tissue stop on it. Opened again, they leave it as it was.
TEST_P(Recovery, JawsStopOnTissueAtTheirLargestLoad) {
  v1::Scene scene = tests::block_with_probe(true, 4);
  scene.mutable_stepping()->set_dt_s(kDtS);
  scene.clear_gravity_m_per_s2();
  scene.clear_tools();
  v1::Tool& jaws = tests::add_tool(scene, "grasper", 0.004, 0.05, 0.06, 0.05, 2e6);
  jaws.mutable_grasper()->set_jaw_length_m(0.03);
  jaws.mutable_orientation()->set_w(0.70710678118654757);  // z downwards, so that the jaws open around the top
  jaws.mutable_orientation()->set_x(0.70710678118654757);
  jaws.add_joint_values(1.2);
  const double largest_n_m = 5e-3;
  jaws.set_max_joint_load(largest_n_m);
  const auto world = start(scene);
  Pose hand = world->readings()[0].pose;
  double most = 0;
  for (int i = 0; i < 300; ++i) {
    hand.joint_values[0] = std::max(0.0, 1.2 - 0.01 * i);
    hand.position_m.y() = std::max(0.035, 0.06 - 5e-4 * i);
    world->set_tool_target(0, hand);
    ASSERT_TRUE(world->step(false)) << i;
    most = std::max(most, std::abs(world->readings()[0].joint_loads[0]));
    ASSERT_LE(most, largest_n_m);
  }
  hand.joint_values[0] = 1.2;
  hand.position_m.y() = 0.12;
  world->set_tool_target(0, hand);
  for (int i = 0; i < 400; ++i) ASSERT_TRUE(world->step(false)) << i;
  double away_m = 0;
  for (const double u : world->state().displacement) away_m = std::max(away_m, std::abs(u));
  EXPECT_LT(away_m, 1e-4);
}

/// What a tool that gives way remembers is part of the saved state.
TEST_P(Recovery, AGivingToolGoesOnBitByBitFromASavedState) {
  v1::Scene scene = block(kKinds[1]);
  scene.mutable_tools(0)->set_max_force_n(0.2);
  const auto world = start(scene), other = start(scene);
  Pose hand = kAbove;
  const auto push = [&](World& one, int from, int to) {
    for (int i = from; i < to; ++i) {
      hand.position_m.y() = 0.07 - 5e-4 * i;
      one.set_tool_target(0, hand);
      ASSERT_TRUE(one.step(false));
    }
  };
  push(*world, 0, 50);
  ASSERT_TRUE(world->readings()[0].gives_way);
  const World::Saved saved = world->save();
  push(*world, 50, 60);
  other->restore(saved);
  push(*other, 50, 60);
  EXPECT_EQ(world->state().displacement, other->state().displacement);
  EXPECT_EQ(world->readings()[0].pose.position_m, other->readings()[0].pose.position_m);
  EXPECT_EQ(world->readings()[0].force_n, other->readings()[0].force_n);
}

/// The hand of a tool with a mass feels the coupling, which slips.
TEST_P(Recovery, TheCouplingOfAToolWithAMassSlips) {
  v1::Scene scene = block(kKinds[0]);
  v1::Tool& tool = *scene.mutable_tools(0);
  tool.set_mass_kg(0.05);
  tool.set_max_force_n(0.2);
  const auto world = start(scene);
  Pose hand = kAbove;
  double most_n = 0;
  for (int i = 0; i < 100; ++i) {
    hand.position_m.y() = 0.07 - 5e-4 * i;
    world->set_tool_target(0, hand);
    ASSERT_TRUE(world->step(false));
    most_n = std::max(most_n, world->readings()[0].force_n.norm());
  }
  EXPECT_LE(most_n, 0.2 * (1 + 1e-12));
  EXPECT_GT(most_n, 0.19);
}

TM_ON_EACH_BACKEND(Recovery);

using RunningRecovery = tests::OnRunner;

/// Two recoveries: one step with tools that backed off, then two steps on end in which the tissue was held.
TEST_P(RunningRecovery, ARecoveryIsCountedToldAndMarked) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.055, 0.05);
  const auto runner = load(scene, [](std::uint64_t step, std::uint64_t call) {
    const bool fails = (step == 4 && call < 2) || step == 8 || step == 9;
    return fails ? std::optional(tests::Fault::kNotANumber) : std::nullopt;
  });
  const auto recording = runner->record({});
  ASSERT_TRUE(recording);
  std::vector<std::uint64_t> flagged;
  v1::SceneStatus told;
  for (std::uint64_t step = 1; step <= 12; ++step) {
    while (runner->take_status(told)) {
    }
    const auto status = runner->step(1);
    ASSERT_TRUE(status) << status.error().message;
    if (runner->feedback("probe")->recovering()) flagged.push_back(step);
    EXPECT_EQ(status->recovering(), runner->feedback("probe")->recovering());
    if (step == 4 || step == 8) {
      ASSERT_TRUE(runner->take_status(told)) << "an event for clients, at once";
      EXPECT_TRUE(told.recovering());
      EXPECT_NE(told.guard_text().find("step " + std::to_string(step)), std::string::npos) << told.guard_text();
    }
  }
  EXPECT_EQ(flagged, (std::vector<std::uint64_t>{4, 8, 9}));
  const v1::SceneStatus status = runner->status();
  EXPECT_EQ(status.recoveries(), 2u);
  EXPECT_EQ(status.recovering_steps(), 3u);
  EXPECT_EQ(status.held_steps(), 2u);
  EXPECT_EQ(status.state(), v1::SceneStatus::STATE_LOCKSTEP);
  EXPECT_FALSE(status.recovering());
  runner->stop_recording(recording->recording);
  recording->recording->close();
  v1::RecordSceneResponse recorded;
  std::vector<std::uint64_t> marked;
  while (recording->recording->take(recorded)) {
    for (const v1::RecordedStep& step : recorded.steps()) {
      if (step.recovered()) marked.push_back(step.step());
    }
  }
  EXPECT_EQ(marked, flagged);
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  std::vector<std::uint64_t> begun;
  for (const v1::SceneEvent& event : events.events()) {
    EXPECT_EQ(event.kind(), v1::SceneEvent::KIND_HELD);
    begun.push_back(event.step());
  }
  EXPECT_EQ(begun, (std::vector<std::uint64_t>{4, 8})) << "once for each recovery";
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->status().recoveries(), 0u);
}

/// The first trial leaves too large a load, and the next one, in which the tool gives way, cannot be made.
TEST_P(RunningRecovery, AStepMayBothGiveWayAndBackOff) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_tools(0)->set_max_force_n(0.2);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.06, 0.05);
  const auto runner = load(scene, [](std::uint64_t step, std::uint64_t call) {
    return step > 1 && call == 1 ? std::optional(tests::Fault::kNotANumber) : std::nullopt;
  });
  for (int i = 1; i <= 30; ++i) {
    v1::ToolPose hand;
    tests::set(*hand.mutable_position_m(), 0.05, 0.06 - 1e-3 * i, 0.05);
    ASSERT_TRUE(runner->submit_pose("probe", hand));
    const auto status = runner->step(1);
    ASSERT_TRUE(status) << status.error().message;
    EXPECT_LE(
        Vec3<double>(status->tools(0).force_n().x(), status->tools(0).force_n().y(), status->tools(0).force_n().z())
            .norm(),
        0.2);
  }
  EXPECT_GT(runner->status().recoveries(), 0u);
  EXPECT_NE(runner->status().guard_text().find("left its bounds"), std::string::npos);
}

TM_ON_EACH_BACKEND(RunningRecovery);

}  // namespace
}  // namespace tensormass::world
