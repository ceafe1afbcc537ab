#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <gtest/gtest.h>

#include "support/blades.h"
#include "support/editing.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/edits.h"
#include "world/runner.h"

/// Tools that are added to a scene that steps, and removed from it.
namespace tensormass::world {
namespace {

v1::Tool probe(const std::string& name, double x, double y, double z, double friction = 0) {
  v1::Scene scene;
  v1::Tool& tool = tests::add_probe(scene, name, 0.01, x, y, z);
  tool.set_friction_coefficient(friction);
  return tool;
}

v1::SceneEdit add(const v1::Tool& tool) {
  v1::SceneEdit edit;
  *edit.add_add_tools() = tool;
  return edit;
}

v1::SceneEdit removal(const std::string& name) {
  v1::SceneEdit edit;
  edit.add_remove_tools(name);
  return edit;
}

class ToolEdits : public tests::OnRunner {
 protected:
  /// A soft block with a rough probe above it.
  static v1::Scene scene(bool in_double = true) {
    v1::Scene scene = tests::block_with_probe(in_double, 4);
    scene.mutable_tools(0)->set_friction_coefficient(0.3);
    scene.mutable_solver()->set_cg_max_iterations(60);
    scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
    return scene;
  }

  static void move(Runner& runner, const std::string& tool, double x, double y, double z) {
    v1::ToolPose pose;
    tests::set(*pose.mutable_position_m(), x, y, z);
    const auto moved = runner.submit_pose(tool, pose);
    EXPECT_TRUE(moved) << moved.error().message;
  }

  /// Rubs the block with a probe: n steps, a pose before each.
  static void rub(Runner& runner, const std::string& tool, int n, double x = 0.05) {
    for (int i = 0; i < n; ++i) {
      move(runner, tool, x + 0.01 * std::sin(0.2 * i), 0.055, 0.05 + 0.01 * std::cos(0.3 * i));
      const auto stepped = runner.step(1);
      ASSERT_TRUE(stepped) << stepped.error().message;
    }
  }

  static std::string positions(Runner& runner) {
    return runner.positions(runner.topology()->bodies(0).name()).value().positions();
  }

  static void edit(Runner& runner, const v1::SceneEdit& change) {
    const auto done = runner.edit(change);
    ASSERT_TRUE(done) << done.error().message;
  }

  static v1::ToolFeedback feedback(Runner& runner, const std::string& tool) { return runner.feedback(tool).value(); }

  static double force_n(Runner& runner, const std::string& tool) {
    const v1::ToolFeedback felt = feedback(runner, tool);
    return std::hypot(felt.force_n().x(), felt.force_n().y(), felt.force_n().z());
  }
};
TM_ON_EACH_BACKEND(ToolEdits);

/// A scene goes on as if the tool had been there from the start, and as if one that is gone had never been.
TEST_P(ToolEdits, LeaveTissueAndOtherToolsAsTheyWere) {
  for (const bool in_double : {true, false}) {
    v1::Scene with_both = scene(in_double);
    *with_both.add_tools() = probe("other", 0.02, 0.08, 0.05, 0.2);
    const auto both = load(with_both), one = load(scene(in_double));
    for (Runner* runner : {both.get(), one.get()}) rub(*runner, "probe", 8);
    edit(*one, add(with_both.tools(1)));
    EXPECT_EQ(positions(*one), positions(*both)) << "the edit itself moves nothing";
    EXPECT_EQ(force_n(*one, "probe"), force_n(*both, "probe"));
    for (Runner* runner : {both.get(), one.get()}) {
      rub(*runner, "probe", 12);         // within which the new tool has faded in
      rub(*runner, "other", 12, 0.025);  // and touches
    }
    EXPECT_GT(force_n(*one, "other"), 0.01);
    EXPECT_EQ(positions(*one), positions(*both));
    for (const std::string tool : {"probe", "other"}) {
      EXPECT_EQ(force_n(*one, tool), force_n(*both, tool)) << tool;
    }

    for (Runner* runner : {both.get(), one.get()}) {
      move(*runner, "probe", 0.05, 0.3, 0.05);
      ASSERT_TRUE(runner->step(20));
    }
    edit(*one, removal("probe"));  // the first of two, so the other one changes its place
    for (Runner* runner : {both.get(), one.get()}) rub(*runner, "other", 10, 0.025);
    EXPECT_EQ(positions(*one), positions(*both));
    EXPECT_EQ(force_n(*one, "other"), force_n(*both, "other"));
    EXPECT_EQ(one->status().tools_size(), 1);
  }
}

TEST_P(ToolEdits, LetGoOfWhatTheToolHeld) {
  const auto runner = load(scene());
  rub(*runner, "probe", 10);
  const double force = force_n(*runner, "probe");
  ASSERT_GT(force, 0.01);
  const std::uint64_t received = runner->status().poses_received();
  EXPECT_EQ(received, 10u);
  edit(*runner, removal("probe"));
  EXPECT_EQ(runner->status().poses_received(), received) << "counts of a scene only grow";
  EXPECT_TRUE(runner->metrics().tools.empty());
  EXPECT_REFUSED(runner->feedback("probe"), ErrorCode::kNotFound, "has no tool 'probe'; it has: none");
  EXPECT_REFUSED(runner->submit_pose("probe", v1::ToolPose{}), ErrorCode::kNotFound, "has no tool 'probe'");
  EXPECT_EQ(runner->status().poses_rejected(), 1u);
  ASSERT_TRUE(runner->step(400));  // the tissue comes to rest
  const auto never = load(scene());
  ASSERT_TRUE(never->step(400));
  const std::string after = positions(*runner), rest = positions(*never);
  double most = 0;
  for (std::size_t at = 0; at < rest.size(); at += sizeof(double)) {
    double a = 0, b = 0;
    std::memcpy(&a, after.data() + at, sizeof(a));
    std::memcpy(&b, rest.data() + at, sizeof(b));
    most = std::max(most, std::abs(a - b));
  }
  EXPECT_LT(most, 1e-4) << "of 5 mm that the probe pressed";

  edit(*runner, add(probe("probe", 0.05, 0.07, 0.05)));
  EXPECT_EQ(feedback(*runner, "probe").pose_sequence(), 0u) << "a new tool that has no pose";
  rub(*runner, "probe", 10);
  EXPECT_GT(force_n(*runner, "probe"), 0.01);
}

/// Tissue is not struck by a tool that appears inside it.
TEST_P(ToolEdits, FadeIn) {
  const auto runner = load(scene());
  ASSERT_TRUE(runner->step(5));
  edit(*runner, add(probe("deep", 0.05, 0.055, 0.05)));
  std::vector<double> forces;
  for (int i = 0; i < 14; ++i) {
    ASSERT_TRUE(runner->step(1));
    forces.push_back(force_n(*runner, "deep"));
  }
  EXPECT_LT(forces[0], 0.05 * forces.back());
  EXPECT_GT(forces.back(), 0.01);
  EXPECT_EQ(runner->status().guard_events(), 0u);
}

TEST_P(ToolEdits, AreToldToClients) {
  const auto runner = load(scene());
  const std::shared_ptr<const v1::Topology> before = runner->topology();
  rub(*runner, "probe", 3);
  edit(*runner, add(probe("second", 0.02, 0.2, 0.05)));
  const std::shared_ptr<const v1::Topology> after = runner->topology();
  EXPECT_GT(after->version(), before->version());
  ASSERT_EQ(after->tools_size(), 2);
  EXPECT_EQ(after->tools(1).name(), "second");
  EXPECT_EQ(after->tools(1).tool().spherical_probe().radius_m(), 0.01);
  EXPECT_EQ(after->bodies(0).SerializeAsString(), before->bodies(0).SerializeAsString());
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.topology_version(), after->version());
  ASSERT_EQ(frame.tools_size(), 2);
  EXPECT_EQ(frame.tools(1).tool(), "second");
  EXPECT_EQ(frame.step(), 3u);
  const std::uint64_t sequence = frame.sequence();
  std::vector<v1::ToolFeedback> felt;
  ASSERT_TRUE(runner->take_feedback(felt));
  ASSERT_EQ(felt.size(), 2u);
  ASSERT_TRUE(runner->step(1));

  edit(*runner, removal("probe"));
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_GT(frame.sequence(), sequence) << "counts on, so that a reader sees which frame is newer";
  EXPECT_EQ(frame.topology_version(), runner->topology()->version());
  ASSERT_EQ(frame.tools_size(), 1);
  EXPECT_EQ(frame.tools(0).tool(), "second");
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  EXPECT_EQ(events.topology_version(), before->version()) << "that of the load, so sequences go on";
  ASSERT_EQ(events.events_size(), 2);
  EXPECT_EQ(events.events(0).kind(), v1::SceneEvent::KIND_TOOL_ADDED);
  EXPECT_EQ(events.events(0).tool(), "second");
  EXPECT_EQ(events.events(0).position_m().y(), 0.2);
  EXPECT_EQ(events.events(0).step(), 3u);
  EXPECT_EQ(events.events(1).kind(), v1::SceneEvent::KIND_TOOL_REMOVED);
  EXPECT_EQ(events.events(1).tool(), "probe") << "its name, although it is gone";
  EXPECT_EQ(events.events(1).text(), "tool 'probe' was removed");
}

TEST_P(ToolEdits, RefuseInWords) {
  const auto runner = load(scene());
  rub(*runner, "probe", 5);
  const std::string before = positions(*runner);
  const std::uint64_t version = runner->topology()->version();
  using Code = ErrorCode;
  EXPECT_REFUSED(runner->edit(removal("needle")), Code::kNotFound,
                 "edit.remove_tools[0]: the scene has no tool 'needle'; it has: probe");
  v1::SceneEdit twice = removal("probe");
  twice.add_remove_tools("probe");
  EXPECT_REFUSED(runner->edit(twice), Code::kInvalidArgument, "edit.remove_tools[1]: tool 'probe' is named twice");
  EXPECT_REFUSED(runner->edit(add(probe("probe", 0, 1, 0))), Code::kAlreadyExists,
                 "edit.add_tools[0]: the scene has a tool 'probe' already");
  v1::SceneEdit again = removal("probe");
  *again.add_add_tools() = probe("probe", 0, 1, 0);
  EXPECT_REFUSED(runner->edit(again), Code::kInvalidArgument, "the edit removes a tool 'probe', too");
  v1::SceneEdit mixed = removal("probe");
  mixed.add_ablations()->set_body("beam");
  EXPECT_REFUSED(runner->edit(mixed), Code::kInvalidArgument, "make two edits of it");
  EXPECT_REFUSED(runner->edit(add(probe("a b", 0, 1, 0))), Code::kInvalidArgument, "tools[1].name");
  v1::Tool bad = probe("bad", 0, 1, 0);
  bad.mutable_spherical_probe()->set_radius_m(-1);
  EXPECT_REFUSED(runner->edit(add(bad)), Code::kInvalidArgument, "radius_m");
  bad = probe("bad", std::nan(""), 1, 0);
  EXPECT_REFUSED(runner->edit(add(bad)), Code::kInvalidArgument, "position_m");
  bad = probe("bad", 0, 1, 0);
  bad.mutable_cautery()->set_power_w(30);
  EXPECT_REFUSED(runner->edit(add(bad)), Code::kInvalidArgument, "cautery");
  v1::SceneEdit many;
  for (int i = 0; i < 16; ++i) *many.add_add_tools() = probe("p" + std::to_string(i), 0, 1, 0);
  EXPECT_REFUSED(runner->edit(many), Code::kResourceExhausted, "limits::kMaxTools = 16");
  EXPECT_EQ(positions(*runner), before);
  EXPECT_EQ(runner->topology()->version(), version);
  v1::SceneEvents events;
  EXPECT_FALSE(runner->take_events(events)) << "nothing happened";
  many.mutable_add_tools()->RemoveLast();
  edit(*runner, many);
  EXPECT_EQ(runner->status().tools_size(), 16);
  rub(*runner, "p14", 3);
}

TEST_P(ToolEdits, AreRecordedAndRepeatedToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const auto runner = load(scene(in_double));
    rub(*runner, "probe", 4);
    edit(*runner, add(probe("first", 0.03, 0.07, 0.05, 0.2)));
    const auto started = runner->record({.check_every_steps = 3});
    ASSERT_TRUE(started) << started.error().message;
    EXPECT_EQ(started->start.adjustments().tools().tools_size(), 2) << "those at its start";
    rub(*runner, "first", 6, 0.03);
    edit(*runner, add(probe("second", 0.07, 0.07, 0.05)));
    rub(*runner, "second", 5, 0.07);
    // Removed and added again between two steps: another tool, at another place.
    edit(*runner, removal("first"));
    edit(*runner, add(probe("first", 0.03, 0.07, 0.05, 0.2)));
    v1::SceneAdjustments softer;
    softer.add_bodies()->set_body("beam");
    softer.mutable_bodies(0)->set_stiffness_factor(0.9);
    ASSERT_TRUE(runner->adjust(softer));
    rub(*runner, "first", 6, 0.03);
    edit(*runner, removal("probe"));
    ASSERT_TRUE(runner->reset()) << "which keeps the tools";
    EXPECT_EQ(runner->status().tools_size(), 2);
    rub(*runner, "second", 5, 0.07);
    const tests::Recorded recorded = tests::take_recorded(*started);
    ASSERT_EQ(recorded.checks.size(), 7u);

    const auto other = load(scene(in_double));
    ASSERT_NO_FATAL_FAILURE(tests::expect_repeats(*other, *started, recorded));
    EXPECT_EQ(other->status().tools_size(), 2);
  }
}

TEST_P(ToolEdits, AreInASnapshot) {
  const auto runner = load(scene());
  const auto early = runner->snapshot();
  edit(*runner, add(probe("second", 0.07, 0.07, 0.05)));
  rub(*runner, "second", 12, 0.07);
  const auto late = runner->snapshot();
  ASSERT_TRUE(early && late);
  const std::string there = positions(*runner);
  EXPECT_REFUSED(runner->restore(early->snapshot()), ErrorCode::kFailedPrecondition, "or of other values");
  const auto other = load(scene());
  ASSERT_TRUE(other->adjust(late->adjustments()));
  ASSERT_TRUE(other->restore(late->snapshot()));
  EXPECT_EQ(positions(*other), there);
  for (Runner* of : {runner.get(), other.get()}) rub(*of, "second", 4, 0.07);
  EXPECT_EQ(positions(*runner), positions(*other));
}

/// What edits have left of tissue stays, also where the last tool goes and another one comes.
TEST_P(ToolEdits, LeaveWhatIsBurnt) {
  v1::Scene scene = tests::edited_beam({.double_precision = true, .cells = 2, .threads = 1});
  scene.mutable_streams()->set_frame_rate_hz(60);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.2, 0.05);
  const auto runner = load(scene), untouched = load(scene);
  const auto burn = [](Runner& of, std::uint32_t element) {
    v1::SceneEdit change;
    v1::Ablation& ablation = *change.add_ablations();
    ablation.set_body("beam");
    ablation.add_elements(element);
    edit(of, change);
  };
  for (Runner* of : {runner.get(), untouched.get()}) burn(*of, 3);
  edit(*runner, removal("probe"));
  for (Runner* of : {runner.get(), untouched.get()}) {
    ASSERT_TRUE(of->step(5));
    burn(*of, 7);
  }
  edit(*runner, add(scene.tools(0)));
  v1::SurfaceChanges changes, others;
  ASSERT_TRUE(runner->take_changes(changes));
  ASSERT_TRUE(untouched->take_changes(others));
  EXPECT_EQ(changes.topology_version(), runner->topology()->version());
  ASSERT_EQ(changes.bodies_size(), 1);
  EXPECT_EQ(changes.bodies(0).SerializeAsString(), others.bodies(0).SerializeAsString());
  for (Runner* of : {runner.get(), untouched.get()}) {
    ASSERT_TRUE(of->step(10));
    for (int i = 0; i < 5; ++i) {
      move(*of, "probe", 0.15, 0.118, 0.05);
      ASSERT_TRUE(of->step(1));
    }
  }
  EXPECT_EQ(runner->status().removed_mass_kg(), untouched->status().removed_mass_kg());
  EXPECT_EQ(positions(*runner), positions(*untouched));
}

/// A blade that cuts goes on cutting while others come and go, before it in the scene or behind.
TEST_P(ToolEdits, LeaveABladeThatCuts) {
  const auto cut_with = [&](bool changes) {
    v1::Scene scene = tests::block_with_scalpel();
    if (changes) {
      const v1::Tool scalpel = scene.tools(0);
      *scene.mutable_tools(0) = probe("probe", 0, 0.2, 0.2);
      *scene.add_tools() = scalpel;
    }
    const auto runner = load(scene);
    const v1::Vector3 start = runner->topology()->tools(changes ? 1 : 0).tool().position_m();
    for (int i = 0; i < 240; ++i) {
      move(*runner, "scalpel", start.x() + 1e-4 * i, start.y(), start.z());
      EXPECT_TRUE(runner->step(1));
      if (changes && i == 120) edit(*runner, removal("probe"));
      if (changes && i == 130) {
        v1::Tool second = scene.tools(1);
        second.set_name("second");
        second.mutable_position_m()->set_x(-1);
        edit(*runner, add(second));
      }
    }
    return runner->status();
  };
  const v1::SceneStatus without = cut_with(false), with = cut_with(true);
  EXPECT_GT(without.fracture_energy_j(), 0);
  EXPECT_EQ(with.fracture_energy_j(), without.fracture_energy_j());
  EXPECT_EQ(with.cut_area_m2(), without.cut_area_m2());
}

/// Poses, readers and edits of a scene that runs by the clock, at the same time.
TEST_P(ToolEdits, GoWithPosesAndReaders) {
  v1::Scene running = scene(false);
  running.mutable_stepping()->set_lockstep(false);
  const auto runner = load(running);
  std::atomic<bool> ends{false};
  std::thread hand([&] {
    for (std::uint64_t i = 1; !ends; ++i) {
      v1::ToolPose pose;
      tests::set(*pose.mutable_position_m(), 0.05, 0.056, 0.05);
      pose.set_session(7), pose.set_client_id(7), pose.set_sequence(i), pose.set_valid_for_s(0.2);
      (void)runner->submit_pose(i % 2 == 0 ? "probe" : "second", pose);
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
  });
  std::thread reader([&] {
    v1::Frame frame;
    std::vector<v1::ToolFeedback> felt;
    v1::SceneEvents events;
    while (!ends) {
      if (runner->take_frame(frame)) {
        EXPECT_LE(frame.tools_size(), 2);
      }
      if (runner->take_feedback(felt)) {
        EXPECT_LE(felt.size(), 2u);
      }
      (void)runner->take_events(events);
      (void)runner->status();
      (void)runner->metrics();
    }
  });
  for (int i = 0; i < 8; ++i) {
    edit(*runner, add(probe("second", 0.07, 0.07, 0.05)));
    edit(*runner, removal(i % 2 == 0 ? "second" : "probe"));
    edit(*runner, i % 2 == 0 ? add(probe("third", 0, 1, 0)) : add(probe("probe", 0.05, 0.07, 0.05)));
    edit(*runner, removal(i % 2 == 0 ? "third" : "second"));
  }
  ends = true;
  hand.join();
  reader.join();
  EXPECT_EQ(runner->status().tools_size(), 1);
  EXPECT_NE(runner->status().state(), v1::SceneStatus::STATE_FAULTED) << runner->status().fault();
}

}  // namespace
}  // namespace tensormass::world
