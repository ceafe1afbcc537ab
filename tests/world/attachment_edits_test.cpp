#include <atomic>
#include <chrono>
#include <cmath>
#include <cstring>
#include <limits>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>

#include "support/editing.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "support/scenes.h"
#include "world/edits.h"
#include "world/runner.h"

/// Attachments that are added to a scene that steps, such as clips, and removed from it.
namespace tensormass::world {
namespace {

v1::Attachment attachment(const std::string& name, const std::string& body, const std::vector<std::uint32_t>& nodes,
                          const std::string& other, const std::vector<std::uint32_t>& others,
                          double stiffness_n_per_m) {
  v1::Attachment out;
  out.set_name(name);
  out.set_body(body);
  out.mutable_region()->mutable_nodes()->mutable_indices()->Assign(nodes.begin(), nodes.end());
  out.set_other(other);
  out.mutable_other_region()->mutable_nodes()->mutable_indices()->Assign(others.begin(), others.end());
  out.set_stiffness_n_per_m(stiffness_n_per_m);
  return out;
}

v1::SceneEdit add(const v1::Attachment& attachment) {
  v1::SceneEdit edit;
  *edit.add_add_attachments() = attachment;
  return edit;
}

v1::SceneEdit removal(const std::string& name) {
  v1::SceneEdit edit;
  edit.add_remove_attachments(name);
  return edit;
}

class AttachmentEdits : public tests::OnRunner {
 protected:
  /// Two beams that are fixed at x = 0, one behind the other, joined by springs.
  static v1::Scene scene(bool in_double = true) {
    v1::Scene scene = tests::edited_beam({.double_precision = in_double, .cells = 2, .threads = 1});
    scene.mutable_streams()->set_frame_rate_hz(60);
    scene.mutable_solver()->set_cg_max_iterations(60);
    v1::Body& other = *scene.add_bodies();
    other = scene.bodies(0);
    other.set_name("other");
    other.set_density_kg_per_m3(500);
    tests::set(*other.mutable_mesh()->mutable_translation_m(), 0, 0, 0.12);
    tests::attach_every_second(scene, "strings", "beam", "other", 0, 20);
    return scene;
  }
  /// A clip that holds the free ends of the beams together.
  static v1::Attachment clip(const std::string& name = "clip") {
    v1::Attachment out = attachment(name, "beam", {}, "other", {}, 200);
    for (v1::Region* region : {out.mutable_region(), out.mutable_other_region()}) {
      tests::set(*region->mutable_box()->mutable_min_m(), 0.19, -1, -1);
      tests::set(*region->mutable_box()->mutable_max_m(), 0.21, 1, 1);
    }
    return out;
  }

  static std::vector<double> positions(Runner& runner, const std::string& body) {
    const std::string bytes = runner.positions(body).value().positions();
    std::vector<double> out(bytes.size() / sizeof(double));
    std::memcpy(out.data(), bytes.data(), bytes.size());
    return out;
  }
  static std::string both(Runner& runner) {
    return runner.positions("beam").value().positions() + runner.positions("other").value().positions();
  }
  static void edit(Runner& runner, const v1::SceneEdit& change) {
    const auto done = runner.edit(change);
    ASSERT_TRUE(done) << done.error().message;
  }
  /// Returns the sum over all springs of an attachment of their tension [N], each of two nodes of a body.
  static double tension_n(const std::vector<double>& x, const v1::Attachment& of,
                          const std::vector<std::uint32_t>& nodes, const std::vector<std::uint32_t>& others) {
    double sum = 0;
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      double squared = 0;
      for (std::size_t c = 0; c < 3; ++c) squared += std::pow(x[3 * nodes[i] + c] - x[3 * others[i] + c], 2);
      sum += of.stiffness_n_per_m() / static_cast<double>(nodes.size()) *
             (std::sqrt(squared) - of.rest_lengths_m(static_cast<int>(i)));
    }
    return sum;
  }
};
TM_ON_EACH_BACKEND(AttachmentEdits);

/// A scene goes on as if the attachment had been there from the start, and as if one that is gone had never been.
TEST_P(AttachmentEdits, AreThoseOfALoadedScene) {
  for (const bool in_double : {true, false}) {
    v1::Scene with = scene(in_double);
    *with.add_attachments() = clip();
    const auto loaded = load(with), added = load(scene(in_double)), never = load(scene(in_double));
    edit(*added, add(clip()));  // at rest, so its lengths are those of the mesh
    EXPECT_EQ(added->topology()->attachments(1).SerializeAsString(),
              loaded->topology()->attachments(1).SerializeAsString());
    for (Runner* runner : {loaded.get(), added.get()}) ASSERT_TRUE(runner->step(20));
    EXPECT_EQ(both(*added), both(*loaded));

    edit(*added, removal("clip"));
    const auto saved = added->snapshot();
    ASSERT_TRUE(saved);
    EXPECT_FALSE(saved->has_adjustments()) << "the values are those of the load";
    ASSERT_TRUE(never->restore(saved->snapshot()));
    for (Runner* runner : {added.get(), never.get()}) ASSERT_TRUE(runner->step(10));
    EXPECT_EQ(both(*added), both(*never));
    ASSERT_TRUE(loaded->step(10));
    EXPECT_NE(both(*added), both(*loaded));
  }
}

/// A block hangs on n springs in parallel: statics say k x = m g, whatever the number of springs.
TEST_P(AttachmentEdits, CarryTheWeightOfABlock) {
  constexpr double kStiffness = 400, kSide = 0.05, kDensity = 1000, kGravity = 9.81;
  for (const std::size_t springs : {4u, 8u}) {
    v1::Scene scene = tests::edited_beam({.double_precision = true, .cells = 1, .threads = 1});
    scene.mutable_solver()->set_cg_max_iterations(200);
    for (int b = 0; b < 2; ++b) {
      if (b == 1) *scene.add_bodies() = scene.bodies(0);
      v1::Body& body = *scene.mutable_bodies(b);
      body.set_name(b == 0 ? "above" : "below");
      *body.mutable_law() = tests::law("hooke", 1e8, 0.3);  // stiff: the springs stretch, and not the blocks
      body.set_density_kg_per_m3(kDensity);
      body.set_rayleigh_mass_per_s(20);
      v1::Grid& grid = *body.mutable_mesh()->mutable_grid();
      tests::set(*grid.mutable_size_m(), kSide, kSide, kSide);
      grid.set_cells_x(1), grid.set_cells_y(1), grid.set_cells_z(1);
      tests::set(*body.mutable_mesh()->mutable_translation_m(), 0, b == 0 ? 0 : -2 * kSide, 0);
      v1::Box& all = *body.mutable_fixed(0)->mutable_box();
      tests::set(*all.mutable_min_m(), -1, -1, -1);
      tests::set(*all.mutable_max_m(), 1, 1, 1);
    }
    scene.mutable_bodies(1)->clear_fixed();
    const auto runner = load(scene);
    // The lower four nodes of the block above, the upper four of the one below, once or twice.
    v1::SceneEdit change;
    for (std::size_t i = 0; i < springs / 4; ++i) {
      v1::Attachment part = attachment(fmt::format("part{}", i), "below", {}, "above", {}, kStiffness * 4 / springs);
      v1::Box &top = *part.mutable_region()->mutable_box(), &bottom = *part.mutable_other_region()->mutable_box();
      tests::set(*top.mutable_min_m(), -1, -kSide - 1e-6, -1);
      tests::set(*top.mutable_max_m(), 1, -kSide + 1e-6, 1);
      tests::set(*bottom.mutable_min_m(), -1, -1e-6, -1);
      tests::set(*bottom.mutable_max_m(), 1, 1e-6, 1);
      *change.add_add_attachments() = part;
    }
    edit(*runner, change);
    const double before = positions(*runner, "below")[1];
    ASSERT_TRUE(runner->step(1000));
    const double weight_n = kDensity * kSide * kSide * kSide * kGravity;
    EXPECT_NEAR(before - positions(*runner, "below")[1], weight_n / kStiffness, 0.01 * weight_n / kStiffness);
  }
}

/// A clip whose length is given closes: it pulls from its first step on.
TEST_P(AttachmentEdits, ClosesAGap) {
  const auto open = load(scene()), closed = load(scene());
  for (Runner* runner : {open.get(), closed.get()}) ASSERT_TRUE(runner->step(10));
  const auto gap = [](Runner& runner) {
    const std::vector<double> beam = positions(runner, "beam"), other = positions(runner, "other");
    return other[other.size() - 1] - beam[beam.size() - 1];  // z of the last node, at the free end
  };
  v1::Attachment tight = clip();
  tight.add_rest_lengths_m(0);
  tight.set_stiffness_n_per_m(1e9);
  EXPECT_REFUSED(closed->edit(add(tight)), ErrorCode::kFailedPrecondition,
                 "more than limits::kMaxAttachmentEnergyJ = 100; give larger rest_lengths_m or less stiffness");
  tight.set_stiffness_n_per_m(200);
  edit(*closed, add(tight));
  EXPECT_EQ(closed->topology()->attachments(1).stiffness_n_per_m(), 200.0 / 9) << "one of 9 springs";
  for (Runner* runner : {open.get(), closed.get()}) ASSERT_TRUE(runner->step(60));
  EXPECT_LT(gap(*closed), gap(*open) - 0.005);
  EXPECT_EQ(closed->status().guard_events(), 0u) << "guards know the energy that the springs brought";
  const auto saved = closed->snapshot();
  ASSERT_TRUE(saved);
  // Three springs each are 2, 7 and 12 cm long at rest: 200 N/m · (0.02² + 0.07² + 0.12²) m² / 6.
  EXPECT_NEAR(saved->adjustments().attachments().energies_j(0), 0.657, 0.02);
}

/// Without a length, the springs have those of the moment at which they come: tissue that is held does not move.
TEST_P(AttachmentEdits, StartWithoutAForce) {
  for (const bool in_double : {true, false}) {
    v1::Scene damped = scene(in_double);
    for (v1::Body& body : *damped.mutable_bodies()) body.set_rayleigh_mass_per_s(30);
    const auto runner = load(damped), never = load(damped);
    for (Runner* of : {runner.get(), never.get()})
      ASSERT_TRUE(of->step(300));  // comes to rest, far from where it began
    const std::string before = both(*runner);
    v1::Attachment stiff = clip();
    stiff.set_stiffness_n_per_m(1e5);
    edit(*runner, add(stiff));
    EXPECT_EQ(both(*runner), before) << "the edit itself moves nothing";
    for (Runner* of : {runner.get(), never.get()}) ASSERT_TRUE(of->step(5));
    for (const std::string body : {"beam", "other"}) {
      const std::vector<double> with = positions(*runner, body), without = positions(*never, body);
      for (std::size_t i = 0; i < with.size(); ++i) ASSERT_NEAR(with[i], without[i], in_double ? 2e-7 : 2e-6);
    }
  }
}

/// A bar that is cut through hangs on its clip alone, which carries the whole load. A half-cut one gets stiffer.
TEST_P(AttachmentEdits, HoldACutTogether) {
  v1::Scene scene = tests::edited_beam({.double_precision = true, .cells = 3, .threads = 1});
  scene.mutable_editing()->mutable_cutting();
  scene.clear_gravity_m_per_s2();
  scene.mutable_solver()->set_cg_max_iterations(300);
  v1::Body& beam = *scene.mutable_bodies(0);
  beam.set_rayleigh_mass_per_s(40);
  constexpr double kLoad = 0.5, kStiffness = 300;
  v1::Load& load_at_end = *beam.add_loads();
  v1::Box& end = *load_at_end.mutable_region()->mutable_box();
  tests::set(*end.mutable_min_m(), 0.199, -1, -1);
  tests::set(*end.mutable_max_m(), 0.201, 1, 1);
  tests::set(*load_at_end.mutable_force_n(), kLoad, 0, 0);

  // Across the middle of the fourth of six cells, from above to `to`; a clip from one node plane to the next.
  const auto cut_to = [](double to) {
    v1::SceneEdit edit;
    v1::Cut& cut = *edit.add_cuts();
    cut.set_body("beam");
    for (const double y : {0.2, to}) {
      v1::BladePosition& at = *cut.add_blade();
      for (const double x : {0.117, y, -1.0, 0.117, y, 1.0}) at.add_points_m(x);
    }
    return edit;
  };
  std::vector<std::uint32_t> left, right;
  const auto reference = load(scene);
  const std::vector<double> rest = positions(*reference, "beam");
  const auto at = [&](double x, double y, double z) {
    for (std::uint32_t node = 0; node < rest.size() / 3; ++node) {
      if (std::hypot(rest[3 * node] - x, rest[3 * node + 1] - y, rest[3 * node + 2] - z) < 1e-6) return node;
    }
    ADD_FAILURE() << "no node at " << x << " " << y << " " << z;
    return 0u;
  };
  for (int j = 0; j < 4; ++j) {
    for (int k = 0; k < 4; ++k) {
      left.push_back(at(0.1, 0.03 * j, 0.1 / 3 * k));
      right.push_back(at(0.4 / 3, 0.03 * j, 0.1 / 3 * k));
    }
  }
  const auto stretch = [&](double to, bool clipped, double stiffness) {
    const auto runner = load(scene);
    if (to < 0.2) edit(*runner, cut_to(to));
    if (clipped) edit(*runner, add(attachment("clip", "beam", left, "beam", right, stiffness)));
    EXPECT_TRUE(runner->step(1500));
    const std::vector<double> x = positions(*runner, "beam");
    if (to < 0) {
      const auto values = runner->snapshot();
      EXPECT_NEAR(tension_n(x, values->adjustments().attachments().attachments(0), left, right), kLoad, 0.01 * kLoad);
    }
    const std::uint32_t last = at(0.2, 0.09, 0);
    return x[3 * last] - rest[3 * last];
  };
  (void)stretch(-1, true, kStiffness);  // checks the tension
  const double whole = stretch(0.2, false, 0), half = stretch(0.04, false, 0), held = stretch(0.04, true, 3e4);
  EXPECT_GT(half, 1.2 * whole);
  EXPECT_LT(held, whole + 0.3 * (half - whole)) << "whole " << whole << ", half " << half;
}

TEST_P(AttachmentEdits, BreakAndAreSevered) {
  const auto runner = load(scene());
  ASSERT_TRUE(runner->step(5));
  v1::Attachment weak = clip("weak"), pulled = clip("pulled");
  pulled.add_rest_lengths_m(0);
  pulled.set_breaking_force_n(1e-3);
  v1::SceneEdit both_of;
  *both_of.add_add_attachments() = weak;
  *both_of.add_add_attachments() = pulled;
  edit(*runner, both_of);
  ASSERT_TRUE(runner->step(3));
  EXPECT_EQ(runner->status().broken_springs(), 9u) << "all of 'pulled' at once";
  v1::SceneEdit severing;
  severing.add_severings()->set_attachment("weak");
  severing.mutable_severings(0)->add_springs(2);
  edit(*runner, severing);
  EXPECT_EQ(runner->status().broken_springs(), 10u);
  v1::Frame frame = runner->frame().value();
  EXPECT_EQ(frame.broken_springs(), std::string("\x00\x10\xf8\x0f", 4)) << "bits 12, and 19 to 27, behind 10 strings";
  edit(*runner, removal("pulled"));
  EXPECT_EQ(runner->status().broken_springs(), 1u);
  frame = runner->frame().value();
  EXPECT_EQ(frame.broken_springs(), std::string("\x00\x10\x00", 3)) << "those that stay keep what they are";
  edit(*runner, add(pulled));
  EXPECT_EQ(runner->status().broken_springs(), 1u) << "a new one is whole";
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  std::vector<std::string> texts;
  for (const v1::SceneEvent& event : events.events()) texts.push_back(event.text());
  EXPECT_EQ(texts, (std::vector<std::string>{
                       "attachment 'weak' was added: 9 springs", "attachment 'pulled' was added: 9 springs",
                       "9 springs of attachment 'pulled' broke", "1 spring of attachment 'weak' severed",
                       "attachment 'pulled' was removed: 9 springs", "attachment 'pulled' was added: 9 springs"}));
  EXPECT_EQ(events.events(2).attachment(), "pulled") << "its name, although it was gone";
}

TEST_P(AttachmentEdits, AreToldToClients) {
  const auto runner = load(scene());
  const std::shared_ptr<const v1::Topology> before = runner->topology();
  ASSERT_TRUE(runner->step(3));
  edit(*runner, add(clip()));
  const std::shared_ptr<const v1::Topology> after = runner->topology();
  EXPECT_GT(after->version(), before->version());
  ASSERT_EQ(after->attachments_size(), 2);
  EXPECT_EQ(after->attachments(0).SerializeAsString(), before->attachments(0).SerializeAsString());
  EXPECT_EQ(after->attachments(1).name(), "clip");
  EXPECT_EQ(after->attachment_point_count(), before->attachment_point_count() + 10) << "springs share points";
  EXPECT_EQ(after->bodies(0).SerializeAsString(), before->bodies(0).SerializeAsString());
  v1::Frame frame;
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.topology_version(), after->version());
  EXPECT_EQ(frame.attachment_points().size(), 12 * std::size_t{after->attachment_point_count()});
  EXPECT_EQ(frame.step(), 3u);

  ASSERT_TRUE(runner->reset());
  EXPECT_EQ(runner->topology()->attachments_size(), 1) << "a reset takes out what was added";
  ASSERT_TRUE(runner->take_frame(frame));
  EXPECT_EQ(frame.topology_version(), runner->topology()->version());
  EXPECT_EQ(frame.attachment_points().size(), 12 * std::size_t{before->attachment_point_count()});
  v1::SceneEvents events;
  ASSERT_TRUE(runner->take_events(events));
  ASSERT_EQ(events.events_size(), 3);
  EXPECT_EQ(events.events(0).kind(), v1::SceneEvent::KIND_ATTACHMENT_ADDED);
  EXPECT_EQ(events.events(0).attachment(), "clip");
  EXPECT_EQ(events.events(0).value(), 9);
  EXPECT_EQ(events.events(1).kind(), v1::SceneEvent::KIND_ATTACHMENT_REMOVED);
  EXPECT_EQ(events.events(2).kind(), v1::SceneEvent::KIND_RESET);
  const auto fresh = load(scene());
  for (Runner* of : {runner.get(), fresh.get()}) ASSERT_TRUE(of->step(10));
  EXPECT_EQ(both(*runner), both(*fresh));
}

TEST_P(AttachmentEdits, RefuseInWords) {
  const auto runner = load(scene());
  ASSERT_TRUE(runner->step(5));
  const std::string before = both(*runner);
  const std::uint64_t version = runner->topology()->version();
  using Code = ErrorCode;
  const auto refuse = [&](const auto& change, Code code, const std::string& text) {
    v1::Attachment bad = clip();
    change(bad);
    EXPECT_REFUSED(runner->edit(add(bad)), code, text);
  };
  EXPECT_REFUSED(runner->edit(removal("clip")), Code::kNotFound,
                 "edit.remove_attachments[0]: no attachment 'clip' was added to the scene; these were: none");
  EXPECT_REFUSED(
      runner->edit(removal("strings")), Code::kFailedPrecondition,
      "edit.remove_attachments[0]: attachment 'strings' was loaded with the scene; sever its springs instead");
  refuse([](auto& a) { a.set_name("strings"); }, Code::kAlreadyExists,
         "edit.add_attachments[0]: the scene has an attachment 'strings' already");
  refuse([](auto& a) { a.set_name("a b"); }, Code::kInvalidArgument, "edit.add_attachments[0].name");
  refuse([](auto& a) { a.set_body("spleen"); }, Code::kInvalidArgument,
         "attachment 'clip'.body: no body has the name 'spleen'");
  refuse([](auto& a) { a.clear_other(); }, Code::kInvalidArgument, "attachment 'clip'.other: no body has the name ''");
  refuse([](auto& a) { tests::set(*a.mutable_region()->mutable_box()->mutable_min_m(), 0.205, 0, 0); },
         Code::kInvalidArgument, "attachment 'clip'.region: no node of the body lies in it");
  refuse([](auto& a) { a.mutable_other_region()->mutable_nodes()->add_indices(999); }, Code::kInvalidArgument,
         "attachment 'clip'.other_region.nodes: node 999 does not exist");
  refuse([](auto& a) { a.clear_region(); }, Code::kInvalidArgument, "give box, sphere, nodes or set");
  refuse([](auto& a) { a.set_other("beam"); }, Code::kInvalidArgument, "is in both regions");
  const double nan = std::nan(""), infinite = std::numeric_limits<double>::infinity();
  for (const double bad : {0.0, -1.0, nan, infinite}) {
    refuse([&](auto& a) { a.set_stiffness_n_per_m(bad); }, Code::kInvalidArgument,
           "attachment 'clip'.stiffness_n_per_m");
    refuse([&](auto& a) { a.set_breaking_force_n(bad); }, Code::kInvalidArgument, "attachment 'clip'.breaking_force_n");
  }
  for (const double bad : {-1e-3, nan, infinite}) {
    refuse([&](auto& a) { a.add_rest_lengths_m(bad); }, Code::kInvalidArgument, "attachment 'clip'.rest_lengths_m[0]");
  }
  refuse([](auto& a) { a.add_rest_lengths_m(0), a.add_rest_lengths_m(0); }, Code::kInvalidArgument,
         "attachment 'clip'.rest_lengths_m: 2 lengths for 9 springs; give one for each, one for all, or none");
  v1::SceneEdit twice = add(clip());
  *twice.add_add_attachments() = clip();
  EXPECT_REFUSED(runner->edit(twice), Code::kAlreadyExists, "edit.add_attachments[1]");
  v1::SceneEdit mixed = add(clip());
  mixed.add_ablations()->set_body("beam");
  EXPECT_REFUSED(runner->edit(mixed), Code::kInvalidArgument, "make two edits of it");
  mixed = add(clip());
  mixed.add_remove_tools("probe");
  EXPECT_REFUSED(runner->edit(mixed), Code::kInvalidArgument, "make two edits of it");
  v1::SceneEdit many;
  for (int i = 0; i < 256; ++i) *many.add_add_attachments() = clip(fmt::format("c{}", i));
  EXPECT_REFUSED(runner->edit(many), Code::kResourceExhausted,
                 "257 attachments, more than limits::kMaxAttachments = 256; remove some first");
  many.clear_add_attachments();
  for (int i = 0; i < 100; ++i) {
    v1::Attachment wide = clip(fmt::format("w{}", i));
    tests::set(*wide.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    *many.add_add_attachments() = wide;
  }
  EXPECT_REFUSED(runner->edit(many), Code::kResourceExhausted,
                 "4500 springs, more than limits::kMaxAddedSprings = 4096");
  EXPECT_EQ(both(*runner), before);
  EXPECT_EQ(runner->topology()->version(), version);
  v1::SceneEvents events;
  EXPECT_FALSE(runner->take_events(events)) << "nothing happened";

  edit(*runner, add(clip()));
  EXPECT_REFUSED(runner->edit(add(clip())), Code::kAlreadyExists, "the scene has an attachment 'clip' already");
  v1::SceneEdit again = removal("clip");
  *again.add_add_attachments() = clip();
  EXPECT_REFUSED(runner->edit(again), Code::kInvalidArgument, "the edit removes an attachment 'clip', too");
  again = removal("clip");
  again.add_remove_attachments("clip");
  EXPECT_REFUSED(runner->edit(again), Code::kInvalidArgument, "'clip' is named twice");
  EXPECT_EQ(runner->topology()->attachments_size(), 2);
  ASSERT_TRUE(runner->step(1));

  v1::Scene still = scene();
  still.clear_editing();
  const auto without = load(still);
  EXPECT_REFUSED(without->edit(add(clip())), Code::kFailedPrecondition, "load it with scene.editing");
  v1::SceneAdjustments values;
  *values.mutable_attachments()->add_attachments() = clip();
  EXPECT_REFUSED(without->adjust(values), Code::kFailedPrecondition, "load it with scene.editing");
}

/// Springs on tissue that is burnt away break; none is added to it.
TEST_P(AttachmentEdits, NeedMaterial) {
  v1::Scene coarse = scene();
  const auto runner = load(coarse);
  ASSERT_TRUE(runner->step(2));
  edit(*runner, add(clip("first")));
  // All elements at the free end of the beam: the last of four cells along x, 2 × 2 of them, 6 tetrahedra each.
  const model::ReadBodies bodies = tests::bodies_of(coarse);
  v1::SceneEdit burning;
  v1::Ablation& ablation = *burning.add_ablations();
  ablation.set_body("beam");
  const mesh::Mesh& mesh = bodies.bodies[0].mesh;
  mesh::for_each_element(mesh, [&](std::uint32_t element, const mesh::Topology&, std::span<const std::uint32_t> of) {
    double x = 0;
    for (const std::uint32_t node : of) x += mesh.nodes[node].x() / static_cast<double>(of.size());
    if (x > 0.15) ablation.add_elements(element);
  });
  edit(*runner, burning);
  EXPECT_EQ(runner->status().broken_springs(), 11u) << "and two strings";
  EXPECT_REFUSED(runner->edit(add(clip())), ErrorCode::kFailedPrecondition, "of body 'beam' has no material any more");
  v1::Attachment tight = clip();
  tight.add_rest_lengths_m(0);
  EXPECT_REFUSED(runner->edit(add(tight)), ErrorCode::kFailedPrecondition, "has no material any more");
  v1::Attachment nearer = clip();
  for (v1::Region* region : {nearer.mutable_region(), nearer.mutable_other_region()}) {
    tests::set(*region->mutable_box()->mutable_min_m(), 0.09, -1, -1);
    tests::set(*region->mutable_box()->mutable_max_m(), 0.11, 1, 1);
  }
  edit(*runner, add(nearer));
  EXPECT_EQ(runner->status().broken_springs(), 11u);
  ASSERT_TRUE(runner->step(5));
  EXPECT_GT(runner->status().removed_mass_kg(), 0);
}

TEST_P(AttachmentEdits, AreRecordedAndRepeatedToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const auto runner = load(scene(in_double));
    ASSERT_TRUE(runner->step(4));
    edit(*runner, add(clip("first")));
    const auto started = runner->record({.check_every_steps = 3});
    ASSERT_TRUE(started) << started.error().message;
    EXPECT_EQ(started->start.adjustments().attachments().attachments_size(), 1) << "those at its start";
    EXPECT_EQ(started->start.adjustments().attachments().attachments(0).rest_lengths_m_size(), 9);
    ASSERT_TRUE(runner->step(6));
    edit(*runner, add(clip("second")));
    ASSERT_TRUE(runner->step(5));
    v1::SceneEdit severing;
    severing.add_severings()->set_attachment("first");
    edit(*runner, severing);
    // Removed and added again between two steps: another attachment, with other lengths, whole.
    edit(*runner, removal("first"));
    edit(*runner, add(clip("first")));
    v1::SceneAdjustments softer;
    softer.add_bodies()->set_body("beam");
    softer.mutable_bodies(0)->set_stiffness_factor(0.9);
    ASSERT_TRUE(runner->adjust(softer));
    ASSERT_TRUE(runner->step(6));
    edit(*runner, removal("second"));
    ASSERT_TRUE(runner->step(2));
    ASSERT_TRUE(runner->reset());
    ASSERT_TRUE(runner->step(4));
    edit(*runner, add(clip("third")));
    ASSERT_TRUE(runner->step(4));
    const tests::Recorded recorded = tests::take_recorded(*started);
    ASSERT_EQ(recorded.checks.size(), 8u);

    const auto other = load(scene(in_double));
    ASSERT_NO_FATAL_FAILURE(tests::expect_repeats(*other, *started, recorded));
    EXPECT_EQ(other->topology()->attachments_size(), 2);
    EXPECT_EQ(both(*other), both(*runner));
  }
}

TEST_P(AttachmentEdits, AreInASnapshot) {
  const auto runner = load(scene());
  const auto early = runner->snapshot();
  ASSERT_TRUE(runner->step(5));
  edit(*runner, add(clip()));
  v1::SceneEdit severing;
  severing.add_severings()->set_attachment("clip");
  severing.mutable_severings(0)->add_springs(8);
  edit(*runner, severing);
  ASSERT_TRUE(runner->step(5));
  const auto late = runner->snapshot();
  ASSERT_TRUE(early && late);
  const std::string there = both(*runner);
  EXPECT_REFUSED(runner->restore(early->snapshot()), ErrorCode::kFailedPrecondition, "or of other values");
  const auto other = load(scene());
  ASSERT_TRUE(other->adjust(late->adjustments()));
  ASSERT_TRUE(other->restore(late->snapshot()));
  EXPECT_EQ(both(*other), there);
  EXPECT_EQ(other->status().broken_springs(), 1u);
  for (Runner* of : {runner.get(), other.get()}) ASSERT_TRUE(of->step(4));
  EXPECT_EQ(both(*runner), both(*other));
  // Back to before the clip: without it, the values are those of the early snapshot.
  edit(*runner, removal("clip"));
  ASSERT_TRUE(runner->restore(early->snapshot()));
  ASSERT_TRUE(runner->adjust(late->adjustments()));
  ASSERT_TRUE(runner->restore(late->snapshot()));
  EXPECT_EQ(both(*runner), there);
}

/// Edits of two clients, poses, readers and a recording that starts, of a scene that runs by the clock.
TEST_P(AttachmentEdits, GoWithReadersAndOtherClients) {
  v1::Scene running = scene(false);
  running.mutable_stepping()->set_lockstep(false);
  const auto runner = load(running);
  std::atomic<bool> ends{false};
  std::thread reader([&] {
    v1::Frame frame;
    v1::SceneEvents events;
    while (!ends) {
      if (runner->take_frame(frame)) {
        const std::shared_ptr<const v1::Topology> topology = runner->topology();
        if (frame.topology_version() == topology->version()) {
          EXPECT_EQ(frame.attachment_points().size(), 12 * std::size_t{topology->attachment_point_count()});
        }
      }
      (void)runner->take_events(events);
      (void)runner->status();
      if (const auto started = runner->record({.check_every_steps = 0, .reset = false})) {
        runner->stop_recording(started->recording);
      }
    }
  });
  std::atomic<int> added{0};
  const auto client = [&](const std::string& own) {
    for (int i = 0; i < 6; ++i) {
      edit(*runner, add(clip(own)));
      if (runner->edit(add(clip("shared")))) ++added;
      if (runner->edit(removal("shared"))) --added;
      edit(*runner, removal(own));
    }
  };
  std::thread first([&] { client("first"); }), second([&] { client("second"); });
  first.join();
  second.join();
  ends = true;
  reader.join();
  EXPECT_EQ(runner->topology()->attachments_size(), 1 + added.load());
  EXPECT_NE(runner->status().state(), v1::SceneStatus::STATE_FAULTED) << runner->status().fault();
}

}  // namespace
}  // namespace tensormass::world
