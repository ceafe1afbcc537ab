#include <cmath>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/blades.h"
#include "support/eventually.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"

/// What a scalpel sweeps becomes a cut, that recordings repeat and resets heal.
namespace tensormass::world {
namespace {

using tests::BladeScene;

class BladeCuts : public tests::OnRunner {
 protected:
  static v1::ToolPose pose_at(const v1::Scene& scene, std::uint64_t sequence, double x_m) {
    v1::ToolPose pose;
    pose.set_sequence(sequence);
    *pose.mutable_position_m() = scene.tools(0).position_m();
    pose.mutable_position_m()->set_x(x_m);
    *pose.mutable_orientation() = scene.tools(0).orientation();
    return pose;
  }
  /// Pushes the blade from before the block to x in steps of a millimetre.
  static void push(Runner& runner, const v1::Scene& scene, int steps) {
    for (int i = 1; i <= steps; ++i) {
      const auto taken = runner.submit_pose("scalpel", pose_at(scene, static_cast<std::uint64_t>(i), -1e-3 + 1e-3 * i));
      ASSERT_TRUE(taken) << taken.error().message;
      const auto status = runner.step(1);
      ASSERT_TRUE(status) << status.error().message;
    }
  }
  static v1::Scene block(double threads = 1) {
    v1::Scene scene = tests::block_with_scalpel(
        {.young_modulus_pa = 100e3, .dt_s = 1.0 / 60, .threads = static_cast<std::uint32_t>(threads)});
    scene.mutable_streams()->set_frame_rate_hz(60);
    return scene;
  }
  static double cut_m2(Runner& runner) {
    v1::SceneEvents events;
    double sum = 0;
    if (!runner.take_events(events)) return 0;
    for (const v1::SceneEvent& event : events.events()) {
      if (event.kind() == v1::SceneEvent::KIND_CUT) sum += event.value();
    }
    return sum;
  }
};
TM_ON_EACH_BACKEND(BladeCuts);

TEST_P(BladeCuts, OpenTheTissueBehindTheBlade) {
  const v1::Scene scene = block();
  const auto runner = load(scene);
  push(*runner, scene, 30);
  // Anchors lag behind the blade by what the block bulges, and the last cut is up to a tenth of a second old.
  const double area_m2 = cut_m2(*runner);
  EXPECT_GT(area_m2, 0.018 * 0.01);
  EXPECT_LT(area_m2, 0.031 * 0.01);
  v1::SurfaceChanges changes;
  ASSERT_TRUE(runner->changes(changes));
  EXPECT_GT(changes.bodies(0).appended_triangles().size(), 0u);
  EXPECT_GT(changes.bodies(0).dead_triangles().size(), 0u) << "the cut divides the block's surface";
}

TEST_P(BladeCuts, RepeatToTheLastBit) {
  for (const std::uint32_t threads : {1u, 2u}) {
    const v1::Scene scene = block(threads);
    const auto first = load(scene);
    const auto started = first->record({.check_every_steps = 1, .reset = false, .room_for_checks = 64});
    ASSERT_TRUE(started) << started.error().message;
    push(*first, scene, 25);  // a step after the last cut, because edits are repeated before steps
    const auto second = load(scene);
    push(*second, scene, 25);
    const auto expected = first->positions("beam");
    EXPECT_EQ(second->positions("beam")->positions(), expected->positions()) << "another run of the same poses";
    const double area_m2 = cut_m2(*first);
    EXPECT_GT(area_m2, 1e-5);
    EXPECT_EQ(cut_m2(*second), area_m2);

    const auto [request, checks] = tests::take_recorded(*started);
    EXPECT_GT(request.edits_size(), 1) << "cuts are edits of the recording";
    const auto other = load(scene);
    const auto replayed = other->replay(request);
    ASSERT_TRUE(replayed) << replayed.error().message;
    tests::expect_repeated(*replayed, checks);
    EXPECT_EQ(cut_m2(*other), area_m2) << "a replay cuts once";
  }
}

TEST_P(BladeCuts, GoOnFromASnapshotWithTheBladeInTheTissue) {
  const v1::Scene scene = block();
  const auto runner = load(scene);
  push(*runner, scene, 18);
  const auto saved = runner->snapshot();
  ASSERT_TRUE(saved) << saved.error().message;
  const auto other = load(scene);
  if (saved->has_adjustments()) {
    const auto adjusted = other->adjust(saved->adjustments());
    ASSERT_TRUE(adjusted) << adjusted.error().message;
  }
  const auto restored = other->restore(saved->snapshot());
  ASSERT_TRUE(restored) << restored.error().message;
  EXPECT_EQ(other->feedback("scalpel")->force_n().x(), runner->feedback("scalpel")->force_n().x());
  ASSERT_LT(other->feedback("scalpel")->force_n().x(), -0.1);
  ASSERT_TRUE(runner->step(4));
  ASSERT_TRUE(other->step(4));
  EXPECT_EQ(other->positions("beam")->positions(), runner->positions("beam")->positions());
}

TEST_P(BladeCuts, HealAtAReset) {
  const v1::Scene scene = block();
  const auto runner = load(scene), fresh = load(scene);
  push(*runner, scene, 24);
  ASSERT_TRUE(runner->reset());
  ASSERT_TRUE(runner->step(4));
  ASSERT_TRUE(fresh->step(4));
  EXPECT_EQ(runner->positions("beam")->positions(), fresh->positions("beam")->positions());
  EXPECT_EQ(runner->feedback("scalpel")->force_n().x(), 0);
}

TEST_P(BladeCuts, CutBesideASceneThatRunsByTheClock) {
  v1::Scene scene = block();
  scene.mutable_stepping()->set_lockstep(false);
  const auto runner = load(scene);
  std::uint64_t sequence = 0;
  double x_m = -1e-3;
  const bool cut = tests::eventually(
      [&] {
        x_m = std::min(x_m + 0.5e-3, 0.03);
        EXPECT_TRUE(runner->submit_pose("scalpel", pose_at(scene, ++sequence, x_m)));
        v1::SurfaceChanges changes;
        return runner->changes(changes) && changes.bodies_size() > 0;
      },
      std::chrono::seconds(60));
  EXPECT_TRUE(cut);
  EXPECT_EQ(runner->status().state(), v1::SceneStatus::STATE_RUNNING);
}

TEST_P(BladeCuts, RefuseInWords) {
  const auto refuses = [&](const std::function<void(v1::Scene&)>& change, const std::string& why,
                           ErrorCode code = ErrorCode::kInvalidArgument) {
    v1::Scene scene = block();
    change(scene);
    EXPECT_REFUSED(Runner::start(scene, {BackendChoice::kCpu, 1}), code, why);
  };
  const auto scalpel = [](v1::Scene& scene) -> v1::Scalpel& { return *scene.mutable_tools(0)->mutable_scalpel(); };
  for (const double wrong :
       {-1e-3, 0.0, 5.0, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    refuses([&](v1::Scene& scene) { scalpel(scene).set_length_m(wrong); }, "length_m");
    refuses([&](v1::Scene& scene) { scalpel(scene).set_thickness_m(wrong); }, "thickness_m");
    refuses([&](v1::Scene& scene) { scalpel(scene).set_spacing_m(wrong); }, "spacing_m");
  }
  for (const double wrong : {-1.0, 0.0, 1e9, std::numeric_limits<double>::quiet_NaN()}) {
    refuses([&](v1::Scene& scene) { scene.mutable_bodies(0)->set_fracture_toughness_j_per_m2(wrong); },
            "fracture_toughness_j_per_m2");
  }
  refuses([&](v1::Scene& scene) { scalpel(scene).set_spacing_m(scalpel(scene).length_m() / 33); }, "kMaxBladePoints");
  refuses([&](v1::Scene& scene) { scene.mutable_editing()->clear_cutting(); }, "editing.cutting",
          ErrorCode::kFailedPrecondition);
  refuses([&](v1::Scene& scene) { scene.clear_editing(); }, "editing.cutting", ErrorCode::kFailedPrecondition);
  refuses([&](v1::Scene& scene) { scene.mutable_tools(0)->set_mass_kg(0.1); }, "mass_kg");
  refuses([&](v1::Scene& scene) { scene.add_body_contacts()->set_body("beam"); }, "body_contacts");
  refuses(
      [&](v1::Scene& scene) {
        v1::Load& load = *scene.mutable_bodies(0)->add_loads();
        tests::set(*load.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
        load.set_pressure_pa(1);
      },
      "a load on its surface");
  refuses(
      [&](v1::Scene& scene) {
        v1::PronyTerm& term = *scene.mutable_bodies(0)->mutable_law()->add_prony();
        term.set_share(0.5);
        term.set_relaxation_time_s(1);
        scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
      },
      "viscoelasticity");
  refuses([&](v1::Scene& scene) { scene.mutable_tools(0)->set_fixed(true); }, "fixed");
  refuses(
      [&](v1::Scene& scene) {
        scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_HEXAHEDRON);
      },
      "linear tetrahedra only");
  refuses(
      [&](v1::Scene& scene) {
        for (int i = 0; i < 4; ++i) {
          v1::Tool& more = *scene.add_tools();
          more = scene.tools(0);
          more.set_name("more" + std::to_string(i));
        }
      },
      "kMaxBlades", ErrorCode::kResourceExhausted);
}

}  // namespace
}  // namespace tensormass::world
