#include "world/edits.h"

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <random>
#include <string>
#include <variant>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "support/on_runner.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/runner.h"

/// Edits of a scene that is recorded, and a replay that repeats them.
namespace tensormass::world {
namespace {

v1::SceneAdjustments stiffness(double factor) {
  v1::SceneAdjustments out;
  v1::BodyAdjustment& body = *out.add_bodies();
  body.set_body("beam");
  body.set_stiffness_factor(factor);
  return out;
}

DoneEdit adjust(double factor) { return {std::make_shared<const Edit>(Adjust{stiffness(factor)}), 7}; }
DoneEdit change_tools(double factor) { return {std::make_shared<const Edit>(Adjust{stiffness(factor), true}), 7}; }
DoneEdit restore(std::string snapshot) { return {std::make_shared<const Edit>(Restore{std::move(snapshot)}), 3}; }
DoneEdit burn(std::uint32_t element) {
  v1::SceneEdit edit;
  v1::Ablation& ablation = *edit.add_ablations();
  ablation.set_body("beam");
  ablation.add_elements(element);
  return {std::make_shared<const Edit>(ChangeScene{edit}), 5};
}
DoneEdit reset() { return {std::make_shared<const Edit>(Reset{}), 0}; }

/// Edits as a text: "2" for a stiffness, "s" for a snapshot s, "x7" for the ablation of element 7, "0" for a reset.
std::string text_of(const std::vector<DoneEdit>& edits) {
  std::string out;
  for (const DoneEdit& done : edits) {
    if (const auto* values = std::get_if<Adjust>(&*done.edit)) {
      out += std::to_string(static_cast<int>(values->values.bodies(0).stiffness_factor()));
    } else if (const auto* state = std::get_if<Restore>(&*done.edit)) {
      out += state->snapshot;
    } else if (const auto* change = std::get_if<ChangeScene>(&*done.edit)) {
      out += 'x';
      out += std::to_string(change->edit.ablations(0).elements(0));
    } else {
      out += "0";
    }
  }
  return out;
}

TEST(EditsOfAStep, KeepWhatTheNextStepDependsOn) {
  const auto after = [](const std::vector<DoneEdit>& all) {
    std::vector<DoneEdit> kept;
    for (const DoneEdit& done : all) add_edit(kept, done);
    return text_of(kept);
  };
  EXPECT_EQ(after({adjust(2), adjust(3)}), "3");
  EXPECT_EQ(after({restore("a"), reset(), restore("b")}), "b");
  EXPECT_EQ(after({restore("a"), adjust(2)}), "a2") << "the snapshot is of the values before";
  EXPECT_EQ(after({adjust(2), restore("a"), adjust(3), adjust(4)}), "2a4");
  EXPECT_EQ(after({adjust(2), restore("a"), adjust(3), reset()}), "30");
  EXPECT_EQ(after({adjust(2), restore("a"), adjust(3), reset(), adjust(5), restore("c")}), "5c");
  EXPECT_EQ(after({burn(1), burn(2)}), "x1x2") << "each counts, in its order";
  EXPECT_EQ(after({burn(1), adjust(2), burn(3), adjust(4)}), "x1x34");
  EXPECT_EQ(after({adjust(2), burn(1), reset(), burn(3)}), "20x3");
  EXPECT_EQ(after({adjust(2), change_tools(3), adjust(4), change_tools(5), adjust(6)}), "356")
      << "a tool that went and came again is another one";
  EXPECT_EQ(after({change_tools(3), burn(1), change_tools(5), reset()}), "50") << "a reset places all tools";
  EXPECT_EQ(count_changes({adjust(1), change_tools(3), burn(1)}), 2u);
}

TEST(EditsOfAStep, EachKindHasAMessage) {
  EXPECT_EQ(std::variant_size_v<Edit>, v1::RecordedEdit::descriptor()->FindOneofByName("edit")->field_count());
  for (const DoneEdit& done : {adjust(2), restore("bytes"), reset(), burn(7)}) {
    v1::RecordedEdit message;
    write_edit(9, done, message);
    EXPECT_EQ(message.index(), 9u);
    EXPECT_EQ(message.step(), done.step);
    const auto read = read_edit(message, "edit");
    ASSERT_TRUE(read) << read.error().message;
    EXPECT_EQ((*read)->index(), done.edit->index());
    EXPECT_EQ(text_of({{*read, 0}}), text_of({done}));
  }
  EXPECT_REFUSED(read_edit(v1::RecordedEdit{}, "edits[2]"), ErrorCode::kInvalidArgument, "edits[2]: has no edit");
}

class Editing : public tests::OnRunner {
 protected:
  struct Recorded {
    v1::RecordingStart start;
    std::vector<v1::RecordedStep> steps;
    std::vector<v1::RecordedEdit> edits;
    std::vector<v1::StateCheck> checks;

    void take_from(Recording& recording) {
      v1::RecordSceneResponse response;
      while (recording.take(response)) {
        EXPECT_EQ(response.lost_size(), 0);
        steps.insert(steps.end(), response.steps().begin(), response.steps().end());
        edits.insert(edits.end(), response.edits().begin(), response.edits().end());
        checks.insert(checks.end(), response.checks().begin(), response.checks().end());
      }
    }
  };

  static v1::Scene scene(bool in_double, bool lockstep = true) {
    v1::Scene scene = tests::block_with_probe(in_double, 4);
    scene.mutable_tools(0)->set_friction_coefficient(0.3);
    scene.mutable_stepping()->set_lockstep(lockstep);
    return scene;
  }

  /// Moves the probe at random in the tissue and makes a step for each pose.
  static void drag(Runner& runner, std::mt19937& random, int steps) {
    std::uniform_real_distribution<double> unit(-1, 1);
    for (int i = 0; i < steps; ++i) {
      v1::ToolPose pose;
      tests::set(*pose.mutable_position_m(), 0.05 + 0.02 * unit(random), 0.055 + 0.01 * unit(random),
                 0.05 + 0.02 * unit(random));
      ASSERT_TRUE(runner.submit_pose("probe", pose));
      ASSERT_TRUE(runner.step(1));
    }
  }

  static v1::ReplaySceneRequest request_of(const Recorded& recorded) {
    v1::ReplaySceneRequest request;
    request.set_scene_hash(recorded.start.scene_hash());
    for (const v1::RecordedStep& step : recorded.steps) *request.add_steps() = step;
    for (const v1::RecordedEdit& edit : recorded.edits) *request.add_edits() = edit;
    for (const v1::StateCheck& check : recorded.checks) request.add_check_indices(check.index());
    return request;
  }

  /// Replays in parts, in a scene that is loaded anew, and returns how many checks are equal.
  std::size_t equal_checks(const v1::Scene& scene, const Recorded& recorded) {
    const auto runner = load(scene);
    if (recorded.start.has_adjustments()) {
      EXPECT_TRUE(runner->adjust(recorded.start.adjustments()));
    }
    if (!recorded.start.snapshot().empty()) {
      EXPECT_TRUE(runner->restore(recorded.start.snapshot()));
    }
    constexpr std::size_t kPart = 40;
    std::size_t equal = 0, checks = 0;
    Recorded part{recorded.start, {}, {}, recorded.checks};
    for (std::size_t begin = 0; begin < recorded.steps.size(); begin += kPart) {
      const std::size_t end = std::min(begin + kPart, recorded.steps.size());
      part.steps.assign(recorded.steps.begin() + static_cast<std::ptrdiff_t>(begin),
                        recorded.steps.begin() + static_cast<std::ptrdiff_t>(end));
      part.edits.clear();
      for (const v1::RecordedEdit& edit : recorded.edits) {
        if (edit.index() > begin && edit.index() <= end) part.edits.push_back(edit);
      }
      const auto response = runner->replay(request_of(part));
      EXPECT_TRUE(response) << response.error().message;
      if (!response) return 0;
      part.start.set_scene_hash(response->scene_hash());
      for (const v1::StateCheck& check : response->checks()) {
        EXPECT_EQ(check.index(), recorded.checks.at(checks).index());
        equal += check.hash() == recorded.checks.at(checks++).hash();
      }
    }
    EXPECT_EQ(checks, recorded.checks.size());
    return equal;
  }
};

TEST_P(Editing, AReplayAdjustsRestoresAndResetsAtTheSameSteps) {
  for (const bool in_double : {false, true}) {
    SCOPED_TRACE(in_double ? "double" : "float");
    const auto runner = load(scene(in_double));
    ASSERT_TRUE(runner->adjust(stiffness(1.5)));
    std::mt19937 random(3);
    drag(*runner, random, 20);
    Recorded recorded;
    auto started = runner->record({.check_every_steps = 5});
    ASSERT_TRUE(started);
    recorded.start = started->start;
    EXPECT_EQ(recorded.start.adjustments().bodies(0).stiffness_factor(), 1.5) << "as it was adjusted before";
    const auto drag_and_take = [&](int steps) {
      drag(*runner, random, steps);
      recorded.take_from(*started->recording);
    };
    drag_and_take(30);
    v1::SceneAdjustments both = stiffness(1.8);  // little enough to come at once under a tool
    both.mutable_bodies(0)->set_rayleigh_mass_per_s(2);
    tests::set(*both.mutable_gravity_m_per_s2(), 1, -5, 0);
    ASSERT_TRUE(runner->adjust(both));
    drag_and_take(30);
    const auto snapshot = runner->snapshot();
    ASSERT_TRUE(snapshot);
    drag_and_take(10);
    ASSERT_TRUE(runner->restore(snapshot->snapshot()));
    drag_and_take(30);
    // Three edits without a step in between; the first restore is forgotten.
    ASSERT_TRUE(runner->restore(snapshot->snapshot()));
    ASSERT_TRUE(runner->adjust(stiffness(2)));
    ASSERT_TRUE(runner->adjust(stiffness(1.7)));
    drag_and_take(30);
    ASSERT_TRUE(runner->reset());
    drag_and_take(15);

    ASSERT_EQ(recorded.steps.size(), 145u);
    EXPECT_EQ(recorded.edits.size(), 5u);
    EXPECT_EQ(recorded.steps[30].edits(), 1u);
    EXPECT_EQ(recorded.steps[100].edits(), 2u);
    EXPECT_TRUE(recorded.steps[130].reset());
    EXPECT_EQ(recorded.edits[1].step(), 80u) << "the restored step";
    EXPECT_EQ(recorded.checks.size(), 29u);
    EXPECT_EQ(equal_checks(scene(in_double), recorded), 29u);

    // The adjustment matters: without it, the checks from there on differ.
    recorded.edits.clear();
    recorded.steps[30].clear_edits();
    recorded.steps.resize(70);
    recorded.checks.resize(14);
    EXPECT_EQ(equal_checks(scene(in_double), recorded), 6u);
  }
}

/// Another number of threads rounds sums in another order. Friction and contact go on from what the snapshot has of
/// them.
TEST_P(Editing, ARestoreIsRepeatedOnAnotherNumberOfThreads) {
  v1::Scene wide = tests::block_with_probe(true, 14);  // enough nodes for two threads
  wide.mutable_tools(0)->set_friction_coefficient(0.3);
  wide.mutable_solver()->set_cpu_threads(2);
  const auto runner = load(wide);
  auto started = runner->record({.check_every_steps = 5, .reset = true});
  ASSERT_TRUE(started);
  const auto press = [&](int from, int to) {
    for (int i = from; i < to; ++i) {
      v1::ToolPose pose;
      tests::set(*pose.mutable_position_m(), 0.05 + 2e-4 * i, 0.059 - 1e-4 * i, 0.05);
      ASSERT_TRUE(runner->submit_pose("probe", pose));
      ASSERT_TRUE(runner->step(1));
    }
  };
  press(0, 20);
  const auto snapshot = runner->snapshot();
  ASSERT_TRUE(snapshot);
  press(20, 30);
  ASSERT_TRUE(runner->restore(snapshot->snapshot()));
  press(20, 30);
  Recorded recorded;
  recorded.start = started->start;
  recorded.take_from(*started->recording);
  ASSERT_EQ(recorded.edits.size(), 1u);

  wide.mutable_solver()->set_cpu_threads(1);
  const auto other = load(wide);
  const auto response = other->replay(request_of(recorded));
  ASSERT_TRUE(response) << response.error().message;
  const bool cpu = std::string(GetParam()) == "cpu";
  EXPECT_EQ(response->layout_hash() == recorded.start.layout_hash(), !cpu);
  ASSERT_EQ(response->checks_size(), 8);
  for (int i = 0; i < response->checks_size(); ++i) {
    const v1::StateCheck &here = response->checks(i), &there = recorded.checks[static_cast<std::size_t>(i)];
    const std::string &a = here.sample_displacements(), &b = there.sample_displacements();
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t at = 0; at < a.size(); at += sizeof(double)) {
      double x, y;
      std::memcpy(&x, a.data() + at, sizeof(x));
      std::memcpy(&y, b.data() + at, sizeof(y));
      ASSERT_NEAR(x, y, 1e-9 * there.largest_displacement_m()) << "check " << i;
    }
  }
}

/// A scene that runs by the clock goes on while an adjustment is compiled, and no step is missing from the recording.
TEST_P(Editing, ARunningSceneIsRepeatedToo) {
  v1::Scene running = scene(false, false);
  running.mutable_stepping()->set_rate_hz(500);
  const auto runner = load(running);
  auto started = runner->record({.check_every_steps = 5});
  ASSERT_TRUE(started);
  Recorded recorded;
  recorded.start = started->start;
  std::mt19937 random(5);
  std::uniform_real_distribution<double> unit(-1, 1);
  for (int i = 0; i < 4; ++i) {
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), 0.05, 0.055 + 0.01 * unit(random), 0.05);
    pose.set_valid_for_s(3600);
    ASSERT_TRUE(runner->submit_pose("probe", pose));
    ASSERT_TRUE(runner->adjust(stiffness(i % 2 == 0 ? 3 : 1)));
    recorded.take_from(*started->recording);
  }
  ASSERT_TRUE(runner->pause());
  EXPECT_FALSE(started->recording->closed()) << "the recording outlives the loops";
  const std::uint64_t steps = runner->status().step();
  ASSERT_TRUE(runner->step(10));
  recorded.take_from(*started->recording);
  EXPECT_EQ(recorded.steps.back().index(), recorded.steps.size());
  EXPECT_EQ(recorded.steps.back().step(), steps + 10);
  EXPECT_GE(recorded.edits.size(), 1u);
  running.mutable_stepping()->set_lockstep(true);
  EXPECT_EQ(equal_checks(running, recorded), recorded.checks.size());
}

TEST_P(Editing, WhatIsRefusedLeavesNoTrace) {
  const auto runner = load(scene(false));
  const auto snapshot = runner->snapshot();
  ASSERT_TRUE(snapshot);
  auto started = runner->record({.check_every_steps = 1, .reset = true});
  ASSERT_TRUE(started);
  EXPECT_REFUSED(runner->adjust(stiffness(1e9)), ErrorCode::kInvalidArgument, "stiffness_factor");
  v1::SceneAdjustments negative = stiffness(2);
  negative.mutable_bodies(0)->set_rayleigh_mass_per_s(-1);
  EXPECT_REFUSED(runner->adjust(negative), ErrorCode::kInvalidArgument, "rayleigh_mass_per_s");
  EXPECT_REFUSED(runner->restore("no snapshot"), ErrorCode::kInvalidArgument, "too few");
  ASSERT_TRUE(runner->adjust(stiffness(1))) << "the values that it has";
  ASSERT_TRUE(runner->step(3));
  Recorded recorded;
  recorded.start = started->start;
  recorded.take_from(*started->recording);
  EXPECT_EQ(recorded.steps.size(), 3u);
  EXPECT_TRUE(recorded.edits.empty());
  EXPECT_FALSE(recorded.start.has_adjustments());
  ASSERT_TRUE(runner->adjust(stiffness(2)));
  EXPECT_REFUSED(runner->restore(snapshot->snapshot()), ErrorCode::kFailedPrecondition, "other values");
  ASSERT_TRUE(runner->step(1));
  recorded.take_from(*started->recording);
  EXPECT_EQ(recorded.edits.size(), 1u);
}

TEST_P(Editing, AReplayRefusesEditsThatDoNotFit) {
  const auto runner = load(scene(false));
  auto started = runner->record({.check_every_steps = 1, .reset = true});
  ASSERT_TRUE(started);
  ASSERT_TRUE(runner->step(1));
  ASSERT_TRUE(runner->adjust(stiffness(2)));
  ASSERT_TRUE(runner->step(1));
  Recorded recorded;
  recorded.start = started->start;
  recorded.take_from(*started->recording);
  const v1::ReplaySceneRequest good = request_of(recorded);

  const auto second = load(scene(false));
  v1::ReplaySceneRequest bad = good;
  bad.clear_edits();
  EXPECT_REFUSED(second->replay(bad), ErrorCode::kInvalidArgument, "the request has 0 of them");
  bad = good;
  *bad.add_edits() = good.edits(0);
  bad.mutable_edits(1)->set_index(7);
  EXPECT_REFUSED(second->replay(bad), ErrorCode::kInvalidArgument, "edits[1].index: 7");
  bad = good;
  for (std::size_t i = 0; i < kMaxEditsOfStep; ++i) *bad.add_edits() = good.edits(0);
  bad.mutable_steps(1)->set_edits(kMaxEditsOfStep + 1);
  EXPECT_REFUSED(second->replay(bad), ErrorCode::kInvalidArgument,
                 fmt::format("edits[{0}]: more than kMaxEditsOfStep = {0}", kMaxEditsOfStep));
  bad = good;
  bad.mutable_edits(0)->clear_edit();
  EXPECT_REFUSED(second->replay(bad), ErrorCode::kInvalidArgument, "edits[0]: has no edit");
  EXPECT_EQ(second->status().step(), 0u);
  bad = good;
  bad.mutable_edits(0)->mutable_adjust()->mutable_bodies(0)->set_body("liver");
  EXPECT_REFUSED(second->replay(bad), ErrorCode::kNotFound, "before recorded step 2: changes.bodies: the scene has no");
  // What comes next has the hash of the values after the edit.
  ASSERT_TRUE(second->reset());
  const auto response = second->replay(good);
  ASSERT_TRUE(response) << response.error().message;
  EXPECT_EQ(response->scene_hash(), runner->snapshot()->scene_hash());
  EXPECT_REFUSED(second->replay(good), ErrorCode::kFailedPrecondition, "or of other values");
}

/// An unload cancels the scene, whichever loop steps it by then. Otherwise it would wait for a replay that goes on.
TEST_P(Editing, ACancelledSceneStaysCancelledWhenItIsAdjusted) {
  const auto runner = load(scene(false));
  auto started = runner->record({.check_every_steps = 1, .reset = true});
  ASSERT_TRUE(started);
  ASSERT_TRUE(runner->adjust(stiffness(2)));
  ASSERT_TRUE(runner->step(1));
  Recorded recorded;
  recorded.start = started->start;
  recorded.take_from(*started->recording);

  const auto second = load(scene(false));
  second->cancel();
  EXPECT_REFUSED(second->replay(request_of(recorded)), ErrorCode::kUnavailable, "step 1 was not replayed");
  (void)second->adjust(stiffness(3));
  EXPECT_REFUSED(second->step(1), ErrorCode::kUnavailable, "0 of 1 steps were done");
}

/// Poses that clients send while a scene is adjusted reach it.
TEST_P(Editing, CountsOfPosesGoOn) {
  const auto runner = load(scene(false));
  runner->count_malformed_pose();
  EXPECT_FALSE(runner->submit_pose("scalpel", {}));
  ASSERT_TRUE(runner->adjust(stiffness(2)));
  EXPECT_EQ(runner->status().poses_rejected(), 2u);
  runner->count_malformed_pose();
  EXPECT_EQ(runner->status().poses_rejected(), 3u);
}

/// Recordings did not always have edits: a reset was a flag.
TEST_P(Editing, AResetOfAnOlderRecordingIsRepeated) {
  const auto runner = load(scene(false));
  auto started = runner->record({.check_every_steps = 2, .reset = true});
  ASSERT_TRUE(started);
  std::mt19937 random(8);
  Recorded recorded;
  recorded.start = started->start;
  drag(*runner, random, 10);
  recorded.take_from(*started->recording);
  ASSERT_TRUE(runner->reset());
  drag(*runner, random, 10);
  recorded.take_from(*started->recording);
  ASSERT_TRUE(recorded.steps[10].reset());
  recorded.edits.clear();
  for (v1::RecordedStep& step : recorded.steps) step.clear_edits();
  EXPECT_EQ(equal_checks(scene(false), recorded), 10u);
}

TM_ON_EACH_BACKEND(Editing);

}  // namespace
}  // namespace tensormass::world
