#include <memory>
#include <random>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/editing.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "world/runner.h"

/// EditScene: a call, its refusals, and a recording that repeats it to the last bit.
namespace tensormass::world {
namespace {

v1::SceneEdit burning(std::vector<std::uint32_t> elements, std::vector<double> kept = {}) {
  v1::SceneEdit edit;
  v1::Ablation& ablation = *edit.add_ablations();
  ablation.set_body("beam");
  ablation.mutable_elements()->Add(elements.begin(), elements.end());
  ablation.mutable_kept()->Add(kept.begin(), kept.end());
  return edit;
}

v1::Scene probed_beam(bool in_double) {
  v1::Scene scene = tests::edited_beam({.double_precision = in_double, .threads = 1});
  scene.mutable_streams()->set_frame_rate_hz(60);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.106, 0.05).set_friction_coefficient(0.3);
  scene.mutable_solver()->set_cg_max_iterations(40);
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
  return scene;
}

class EditScene : public tests::OnRunner {};
TM_ON_EACH_BACKEND(EditScene);

TEST_P(EditScene, IsRecordedAndRepeatedToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const auto runner = load(probed_beam(in_double));
    ASSERT_TRUE(runner->step(5));
    ASSERT_TRUE(runner->edit(burning({17})));
    const auto started = runner->record({.check_every_steps = 1, .reset = false});
    ASSERT_TRUE(started) << started.error().message;
    EXPECT_FALSE(started->start.snapshot().empty());
    std::mt19937 random(9);
    for (int i = 0; i < 30; ++i) {
      std::vector<std::uint32_t> elements;
      for (int n = 0; n < 3; ++n) elements.push_back(static_cast<std::uint32_t>(random() % 324));
      (void)runner->edit(burning(elements, {i % 3 == 0 ? 0.4 : 0}));  // some are gone already
      if (i % 4 == 1) (void)runner->edit(burning({static_cast<std::uint32_t>(random() % 324)}));
      if (i == 12) {
        ASSERT_TRUE(runner->reset());
      }
      if (i == 20) {
        v1::SceneAdjustments values;
        values.add_bodies()->set_body("beam");
        values.mutable_bodies(0)->set_stiffness_factor(1.5);
        const auto adjusted = runner->adjust(values);
        ASSERT_TRUE(adjusted) << adjusted.error().message;
        EXPECT_GT(adjusted->status().removed_mass_kg(), 0) << "an adjustment keeps what edits have done";
      }
      ASSERT_TRUE(runner->step(2));
    }
    const auto [request, checks] = tests::take_recorded(*started);
    EXPECT_EQ(request.steps_size(), 60);
    EXPECT_GT(request.edits_size(), 20);
    ASSERT_FALSE(checks.empty());
    const auto other = load(probed_beam(in_double));
    const auto restored = other->restore(started->start.snapshot());
    ASSERT_TRUE(restored) << restored.error().message;
    EXPECT_GT(restored->removed_mass_kg(), 0) << "a snapshot has what edits left";
    const auto replayed = other->replay(request);
    ASSERT_TRUE(replayed) << replayed.error().message;
    tests::expect_repeated(*replayed, checks);
    EXPECT_EQ(replayed->status().removed_mass_kg(), runner->status().removed_mass_kg());
  }
}

TEST_P(EditScene, RefusesInWords) {
  const auto runner = load(probed_beam(true));
  ASSERT_TRUE(runner->edit(burning({3})));
  const double before = runner->status().removed_mass_kg();
  EXPECT_GT(before, 0);
  EXPECT_REFUSED(runner->edit({}), ErrorCode::kInvalidArgument, "edit: is empty");
  EXPECT_REFUSED(runner->edit(burning({4, 324})), ErrorCode::kNotFound, "edit.ablations[0].elements[1]");
  EXPECT_REFUSED(runner->edit(burning({4, 5, 6}, {0, 0})), ErrorCode::kInvalidArgument, "2 shares for 3 elements");
  EXPECT_REFUSED(runner->edit(burning({4, 3})), ErrorCode::kFailedPrecondition, "is gone already");
  v1::SceneEdit unknown = burning({4});
  unknown.mutable_ablations(0)->set_body("liver");
  EXPECT_REFUSED(runner->edit(unknown), ErrorCode::kNotFound, "no body 'liver'");
  v1::SceneEdit severing = burning({4});
  severing.add_severings()->set_attachment("ligament");
  EXPECT_REFUSED(runner->edit(severing), ErrorCode::kNotFound, "no attachment 'ligament'");
  EXPECT_EQ(runner->status().removed_mass_kg(), before) << "nothing half done";
  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->status().removed_mass_kg(), 0);
}

TEST_P(EditScene, SeversByName) {
  const auto runner = load(tests::hanging_block());
  v1::SceneEdit edit;
  edit.add_severings()->set_attachment("strong");
  edit.mutable_severings(0)->add_springs(2);
  ASSERT_TRUE(runner->edit(edit));
  EXPECT_REFUSED(runner->edit(edit), ErrorCode::kFailedPrecondition, "spring 2 is broken already");
  edit.mutable_severings(0)->set_springs(0, 8);
  EXPECT_REFUSED(runner->edit(edit), ErrorCode::kNotFound, "attachment 'strong' has 8 springs");
  edit.mutable_severings(0)->clear_springs();
  ASSERT_TRUE(runner->edit(edit)) << "all seven that are whole";
  const auto frame = runner->frame();
  ASSERT_TRUE(frame);
  EXPECT_EQ(static_cast<unsigned char>(frame->broken_springs()[0]), 0xFF);
}

}  // namespace
}  // namespace tensormass::world
