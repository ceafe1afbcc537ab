#include <cmath>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "support/scissors.h"

/// What scissors close on becomes a cut, with events that say when it began and ended, and which pieces are free.
namespace tensormass::world {
namespace {

using tests::ScissorsScene;

class ScissorsCuts : public tests::OnRunner {
 protected:
  static constexpr double kOpenRad = 0.9, kShutRad = 0.08, kStepRad = 0.02;

  static v1::ToolPose pose_at(const v1::Scene& scene, std::uint64_t sequence, double opening_rad) {
    v1::ToolPose pose;
    pose.set_sequence(sequence);
    *pose.mutable_position_m() = scene.tools(0).position_m();
    *pose.mutable_orientation() = scene.tools(0).orientation();
    pose.add_joint_values(opening_rad);
    return pose;
  }
  /// Closes the scissors in steps, to an opening. Returns the last sequence.
  static std::uint64_t close(Runner& runner, const v1::Scene& scene, double to_rad) {
    std::uint64_t sequence = 0;
    for (double opening_rad = kOpenRad; opening_rad > to_rad; opening_rad -= kStepRad) {
      const auto taken = runner.submit_pose("scissors", pose_at(scene, ++sequence, opening_rad));
      EXPECT_TRUE(taken) << taken.error().message;
      const auto status = runner.step(1);
      EXPECT_TRUE(status) << status.error().message;
    }
    return sequence;
  }
  /// A block 20 mm long, held at one side of the blades' plane.
  static v1::Scene block(std::uint32_t threads = 1) {
    v1::Scene scene = tests::sheet_with_scissors(
        {.young_modulus_pa = 2e6, .length_m = 20e-3, .dt_s = 1.0 / 60, .opening_rad = kOpenRad, .threads = threads});
    v1::Box& clamp = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
    tests::set(*clamp.mutable_min_m(), -1, -1, -1);
    tests::set(*clamp.mutable_max_m(), 1, 1e-6, 1);
    scene.mutable_streams()->set_frame_rate_hz(60);
    return scene;
  }
  static std::vector<v1::SceneEvent> events_of(Runner& runner, v1::SceneEvent::Kind kind) {
    v1::SceneEvents events;
    std::vector<v1::SceneEvent> out;
    if (!runner.take_events(events)) return out;
    for (const v1::SceneEvent& event : events.events()) {
      if (event.kind() == kind) out.push_back(event);
    }
    return out;
  }
};
TM_ON_EACH_BACKEND(ScissorsCuts);

TEST_P(ScissorsCuts, FreeAPieceAndTellOfIt) {
  const v1::Scene scene = block();
  const auto runner = load(scene);
  close(*runner, scene, kShutRad);
  ASSERT_TRUE(runner->step(30));  // half a second in which nothing is cut
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  std::vector<v1::SceneEvent> begun, ended, freed;
  std::string texts;
  for (const v1::SceneEvent& event : events.events()) {
    texts += std::to_string(event.step()) + ": " + event.text() + "\n";
    if (event.kind() == v1::SceneEvent::KIND_CUT_BEGUN) begun.push_back(event);
    if (event.kind() == v1::SceneEvent::KIND_CUT_ENDED) ended.push_back(event);
    if (event.kind() == v1::SceneEvent::KIND_PIECE_FREE) freed.push_back(event);
  }
  const double face_m2 = 20e-3 * 6e-3;
  ASSERT_EQ(begun.size(), 1u);
  ASSERT_EQ(ended.size(), 1u);
  EXPECT_EQ(freed.size(), 1u) << texts;
  ASSERT_FALSE(freed.empty());
  EXPECT_LT(begun[0].step(), freed[0].step());
  EXPECT_EQ(ended[0].tool(), "scissors");
  EXPECT_EQ(ended[0].body(), "beam");
  EXPECT_NEAR(ended[0].value(), face_m2, 0.1 * face_m2);
  EXPECT_NEAR(ended[0].work_j(), 20 * face_m2, 0.15 * 20 * face_m2);
  EXPECT_NE(ended[0].text().find("mJ"), std::string::npos) << ended[0].text();
  const double volume_m3 = face_m2 * (20e-3 - 10.3e-3);
  EXPECT_NEAR(freed[0].value(), volume_m3, 0.01 * volume_m3);
  const v1::SceneStatus status = runner->status();
  EXPECT_NEAR(status.cut_area_m2(), face_m2, 0.01 * face_m2);
  EXPECT_NEAR(status.fracture_energy_j(), ended[0].work_j(), 1e-12);
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->status().cut_area_m2(), 0);
  EXPECT_EQ(runner->status().fracture_energy_j(), 0);
}

TEST_P(ScissorsCuts, RepeatToTheLastBit) {
  for (const std::uint32_t threads : {1u, 2u}) {
    const v1::Scene scene = block(threads);
    const auto first = load(scene);
    const auto started = first->record({.check_every_steps = 1, .reset = false, .room_for_checks = 64});
    ASSERT_TRUE(started) << started.error().message;
    close(*first, scene, kShutRad);
    const auto second = load(scene);
    close(*second, scene, kShutRad);
    const auto expected = first->positions("beam");
    EXPECT_EQ(second->positions("beam")->positions(), expected->positions()) << "another run of the same poses";
    const auto [request, checks] = tests::take_recorded(*started);
    EXPECT_GT(request.edits_size(), 1) << "cuts are edits of the recording";
    const auto other = load(scene);
    const auto replayed = other->replay(request);
    ASSERT_TRUE(replayed) << replayed.error().message;
    tests::expect_repeated(*replayed, checks);
  }
}

TEST_P(ScissorsCuts, GoOnFromASnapshotInTheMiddleOfACut) {
  const v1::Scene scene = block();
  const auto runner = load(scene);
  std::uint64_t sequence = close(*runner, scene, 0.25);
  const auto saved = runner->snapshot();
  ASSERT_TRUE(saved) << saved.error().message;
  const auto other = load(scene);
  if (saved->has_adjustments()) {
    const auto adjusted = other->adjust(saved->adjustments());
    ASSERT_TRUE(adjusted) << adjusted.error().message;
  }
  const auto restored = other->restore(saved->snapshot());
  ASSERT_TRUE(restored) << restored.error().message;
  ASSERT_GT(runner->feedback("scissors")->joint_loads(0), 1e-4);
  EXPECT_EQ(other->feedback("scissors")->joint_loads(0), runner->feedback("scissors")->joint_loads(0));
  for (Runner* one : {runner.get(), other.get()}) {
    ASSERT_TRUE(one->submit_pose("scissors", pose_at(scene, sequence + 1, 0.24)));
    ASSERT_TRUE(one->step(1));
  }
  EXPECT_EQ(other->positions("beam")->positions(), runner->positions("beam")->positions());
}

TEST_P(ScissorsCuts, RefuseInWords) {
  const auto refuses = [&](const std::function<void(v1::Scene&)>& change, const std::string& why,
                           ErrorCode code = ErrorCode::kInvalidArgument) {
    v1::Scene scene = block();
    change(scene);
    EXPECT_REFUSED(Runner::start(scene, {BackendChoice::kCpu, 1}), code, why);
  };
  const auto scissors = [](v1::Scene& scene) -> v1::Scissors& { return *scene.mutable_tools(0)->mutable_scissors(); };
  for (const double wrong :
       {-1e-3, 0.0, 5.0, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    refuses([&](v1::Scene& scene) { scissors(scene).set_blade_length_m(wrong); }, "blade_length_m");
    refuses([&](v1::Scene& scene) { scissors(scene).set_thickness_m(wrong); }, "thickness_m");
    refuses([&](v1::Scene& scene) { scissors(scene).set_spacing_m(wrong); }, "spacing_m");
    refuses([&](v1::Scene& scene) { scissors(scene).set_edge_offset_m(wrong); }, "edge_offset_m");
  }
  refuses([&](v1::Scene& scene) { scissors(scene).set_radius_m(0); }, "radius_m");
  refuses([&](v1::Scene& scene) { scissors(scene).set_edge_offset_m(41e-3); }, "half of blade_length_m");
  refuses([&](v1::Scene& scene) { scissors(scene).set_spacing_m(1e-3); }, "kMaxBladePoints");
  refuses([&](v1::Scene& scene) { scene.mutable_tools(0)->set_joint_values(0, 3); }, "opening_rad");
  refuses([&](v1::Scene& scene) { scene.mutable_tools(0)->set_mass_kg(0.1); }, "mass_kg");
  refuses([&](v1::Scene& scene) { scene.mutable_tools(0)->set_fixed(true); }, "fixed");
  refuses([&](v1::Scene& scene) { scene.clear_editing(); }, "editing.cutting", ErrorCode::kFailedPrecondition);
  refuses(
      [&](v1::Scene& scene) {
        for (int i = 0; i < 2; ++i) {
          v1::Tool& more = *scene.add_tools();
          more = scene.tools(0);
          more.set_name("more" + std::to_string(i));
        }
      },
      "scissors have two", ErrorCode::kResourceExhausted);
}

}  // namespace
}  // namespace tensormass::world
