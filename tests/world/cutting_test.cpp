#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <map>
#include <memory>
#include <random>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "support/editing.h"
#include "support/on_runner.h"
#include "support/recorded.h"
#include "support/refused.h"
#include "world/runner.h"

/// Bodies that are cut while their scene steps: EditScene, what clients see of it, recordings, snapshots, refusals.
namespace tensormass::world {
namespace {

using Eigen::Vector3d;
using Blade = std::vector<Vector3d>;

v1::Scene beam(bool in_double = true, v1::Quadrature quadrature = v1::QUADRATURE_FULL) {
  v1::Scene scene = tests::edited_beam({.quadrature = quadrature, .double_precision = in_double, .threads = 1});
  scene.mutable_editing()->mutable_cutting();
  scene.mutable_streams()->set_frame_rate_hz(60);
  scene.mutable_solver()->set_cg_max_iterations(40);
  tests::add_probe(scene, "probe", 0.02, 0.15, 0.106, 0.05).set_friction_coefficient(0.3);
  return scene;
}

v1::SceneEdit cut(const std::vector<Blade>& blade, const std::string& body = "beam") {
  v1::SceneEdit edit;
  v1::Cut& out = *edit.add_cuts();
  out.set_body(body);
  for (const Blade& position : blade) {
    v1::BladePosition& at = *out.add_blade();
    for (const Vector3d& point : position) at.mutable_points_m()->Add(point.begin(), point.end());
  }
  return edit;
}
/// A blade across the beam (0.2 × 0.09 × 0.1 m) at x, from y above to y below.
v1::SceneEdit cut_at(double x, double from, double to) {
  return cut({{{x, from, -1}, {x, from, 1}}, {{x + 0.01, to, -1}, {x + 0.01, to, 1}}});
}
v1::SceneEdit random_cut(std::mt19937& random) {
  std::uniform_real_distribution<double> uniform(-0.2, 1.2);
  const auto point = [&] { return Vector3d(0.2 * uniform(random), 0.09 * uniform(random), 0.1 * uniform(random)); };
  const Blade before{point(), point(), point()};
  return cut({before, {point(), point(), point()}});
}

template <class T>
std::vector<T> items(const std::string& bytes) {
  std::vector<T> out(bytes.size() / sizeof(T));
  if (!out.empty()) std::memcpy(out.data(), bytes.data(), bytes.size());
  return out;
}

/// What a viewer has of a body: its topology, and the changes since.
struct View {
  std::vector<std::array<std::uint32_t, 3>> triangles;
  std::vector<Vector3d> vertices;

  View(const v1::Topology& topology, const v1::SurfaceChanges& changes, const v1::Frame& frame) {
    const v1::BodySurface& body = topology.bodies(0);
    triangles = items<std::array<std::uint32_t, 3>>(body.triangles());
    const auto positions = items<std::array<float, 3>>(frame.positions());
    const auto at = [&](std::size_t place) {
      return Vector3d(positions[place][0], positions[place][1], positions[place][2]);
    };
    for (std::uint32_t v = 0; v < body.vertex_count(); ++v) vertices.push_back(at(body.first_vertex() + v));
    if (changes.bodies_size() == 0) return;
    const v1::BodyChanges& of_body = changes.bodies(0);
    for (const std::uint32_t place : items<std::uint32_t>(of_body.appended_vertices())) vertices.push_back(at(place));
    const auto appended = items<std::array<std::uint32_t, 3>>(of_body.appended_triangles());
    triangles.insert(triangles.end(), appended.begin(), appended.end());
    const auto dead = items<std::uint32_t>(of_body.dead_triangles());
    for (auto t = dead.rbegin(); t != dead.rend(); ++t) triangles.erase(triangles.begin() + *t);
  }
  double volume_m3() const {
    double sum = 0;
    for (const auto& [a, b, c] : triangles) sum += vertices[a].dot(vertices[b].cross(vertices[c])) / 6;
    return sum;
  }
  /// Each edge has as many triangles in one direction as in the other.
  bool is_closed() const {
    std::map<std::pair<std::uint32_t, std::uint32_t>, int> edges;
    for (const auto& triangle : triangles) {
      for (std::size_t i = 0; i < 3; ++i) {
        const std::uint32_t from = triangle[i], to = triangle[(i + 1) % 3];
        edges[std::minmax(from, to)] += from < to ? 1 : -1;
      }
    }
    return std::all_of(edges.begin(), edges.end(), [](const auto& edge) { return edge.second == 0; });
  }
};

class Cutting : public tests::OnRunner {
 protected:
  static View view_of(Runner& runner) {
    v1::SurfaceChanges changes;
    (void)runner.changes(changes);
    const auto frame = runner.frame();
    EXPECT_TRUE(frame);
    EXPECT_EQ(frame->revision(), changes.revision());
    return View(*runner.topology(), changes, *frame);
  }
};
TM_ON_EACH_BACKEND(Cutting);

TEST_P(Cutting, GoesOnFromWhereTheSceneIs) {
  for (const v1::Quadrature quadrature : {v1::QUADRATURE_FULL, v1::QUADRATURE_SELECTIVE}) {
    const auto runner = load(beam(true, quadrature));
    ASSERT_TRUE(runner->step(10));
    const auto before = runner->positions("beam");
    const double whole = view_of(*runner).volume_m3();
    const auto status = runner->edit(cut_at(0.1, 1, 0.04));
    ASSERT_TRUE(status) << status.error().message;
    EXPECT_EQ(status->step(), 10u);
    EXPECT_EQ(runner->positions("beam")->positions(), before->positions()) << "nothing moves at the cut itself";
    const View opened = view_of(*runner);
    EXPECT_TRUE(opened.is_closed());
    EXPECT_NEAR(opened.volume_m3(), whole, 1e-4 * whole) << "both faces of a cut lie on each other";
    ASSERT_TRUE(runner->step(10));
    EXPECT_TRUE(view_of(*runner).is_closed());
    v1::SceneEvents events;
    ASSERT_TRUE(runner->take_events(events));
    const v1::SceneEvent& last = events.events(events.events_size() - 1);
    EXPECT_EQ(last.kind(), v1::SceneEvent::KIND_CUT);
    EXPECT_NEAR(last.value(), 0.05 * 0.1, 0.002) << "the blade went through 5 cm of 10 cm";
    EXPECT_FALSE(last.text().empty());
  }
}

/// A piece that is cut off falls as far as it does, and the scene goes on.
TEST_P(Cutting, LetsAPieceFall) {
  v1::Scene scene = beam(true, v1::QUADRATURE_FULL);
  scene.clear_tools();
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  const auto runner = load(scene);
  ASSERT_TRUE(runner->edit(cut_at(0.1, 1, -1)));
  const auto fallen = runner->step(static_cast<std::uint64_t>(std::lround(1.5 / scene.stepping().dt_s())));
  ASSERT_TRUE(fallen) << fallen.error().message;
  const std::vector<float> positions = items<float>(runner->frame()->positions());
  float lowest_m = 0;
  for (std::size_t i = 1; i < positions.size(); i += 3) lowest_m = std::min(lowest_m, positions[i]);
  EXPECT_LT(lowest_m, -5);
}

TEST_P(Cutting, OnlyAppendsToWhatViewersHave) {
  const auto runner = load(beam());
  std::mt19937 random(4);
  v1::SurfaceChanges before;
  int made = 0;
  for (int i = 0; i < 12; ++i) {
    if (!runner->edit(random_cut(random))) continue;  // it missed the beam
    ++made;
    v1::SurfaceChanges after;
    ASSERT_TRUE(runner->changes(after));
    EXPECT_GT(after.revision(), before.revision());
    EXPECT_GE(after.appended_vertex_count(), before.appended_vertex_count());
    if (before.bodies_size() > 0) {
      const v1::BodyChanges &old = before.bodies(0), &now = after.bodies(0);
      EXPECT_EQ(now.appended_vertices().substr(0, old.appended_vertices().size()), old.appended_vertices());
      EXPECT_EQ(now.appended_triangles().substr(0, old.appended_triangles().size()), old.appended_triangles());
      EXPECT_EQ(now.appended_kinds().substr(0, old.appended_kinds().size()), old.appended_kinds());
      const auto dead = items<std::uint32_t>(now.dead_triangles());
      for (const std::uint32_t triangle : items<std::uint32_t>(old.dead_triangles())) {
        EXPECT_TRUE(std::binary_search(dead.begin(), dead.end(), triangle));
      }
    }
    before = after;
    ASSERT_TRUE(runner->step(2));
    EXPECT_TRUE(view_of(*runner).is_closed());
  }
  EXPECT_GT(made, 5);
}

TEST_P(Cutting, IsHealedByAReset) {
  const auto runner = load(beam());
  const auto fresh = load(beam());
  ASSERT_TRUE(runner->step(4));
  ASSERT_TRUE(runner->edit(cut_at(0.1, 1, -1)));
  ASSERT_TRUE(runner->step(4));
  const View parted = view_of(*runner);
  ASSERT_TRUE(runner->reset());
  const View healed = view_of(*runner), whole = view_of(*fresh);
  EXPECT_GT(parted.triangles.size(), whole.triangles.size());
  EXPECT_EQ(std::set(healed.triangles.begin(), healed.triangles.end()),
            std::set(whole.triangles.begin(), whole.triangles.end()));
  ASSERT_TRUE(runner->step(8));
  ASSERT_TRUE(fresh->step(8));
  EXPECT_EQ(runner->positions("beam")->positions(), fresh->positions("beam")->positions());
}

TEST_P(Cutting, IsRecordedAndRepeatedToTheLastBit) {
  for (const bool in_double : {true, false}) {
    const auto runner = load(beam(in_double));
    ASSERT_TRUE(runner->step(3));
    ASSERT_TRUE(runner->edit(cut_at(0.05, 1, 0.06)));
    const auto started = runner->record({.check_every_steps = 1, .reset = false, .room_for_checks = 64});
    ASSERT_TRUE(started) << started.error().message;
    std::mt19937 random(9);
    for (int i = 0; i < 12; ++i) {
      (void)runner->edit(random_cut(random));
      if (i == 4) {
        ASSERT_TRUE(runner->reset());
      }
      if (i == 8) {
        v1::SceneAdjustments values;
        values.add_bodies()->set_body("beam");
        values.mutable_bodies(0)->set_stiffness_factor(1.5);
        const auto adjusted = runner->adjust(values);
        ASSERT_TRUE(adjusted) << adjusted.error().message;
        EXPECT_FALSE(adjusted->adjustments().bodies(0).cuts().edges().empty()) << "an adjustment keeps the cuts";
      }
      ASSERT_TRUE(runner->step(2));
    }
    const tests::Recorded recorded = tests::take_recorded(*started);
    ASSERT_EQ(recorded.checks.size(), 24u);
    const auto other = load(beam(in_double));
    ASSERT_NO_FATAL_FAILURE(tests::expect_repeats(*other, *started, recorded));
  }
}

TEST_P(Cutting, IsInASnapshot) {
  const auto runner = load(beam());
  ASSERT_TRUE(runner->edit(cut_at(0.1, 1, 0.04)));
  ASSERT_TRUE(runner->step(5));
  const auto snapshot = runner->snapshot();
  ASSERT_TRUE(snapshot);
  ASSERT_TRUE(runner->step(5));
  const std::string later = runner->positions("beam")->positions();
  const auto other = load(beam());
  EXPECT_REFUSED(other->restore(snapshot->snapshot()), ErrorCode::kFailedPrecondition, "of other values");
  ASSERT_TRUE(other->adjust(snapshot->adjustments()));
  ASSERT_TRUE(other->restore(snapshot->snapshot()));
  ASSERT_TRUE(other->step(5));
  EXPECT_EQ(other->positions("beam")->positions(), later);
}

TEST_P(Cutting, RefusesInWords) {
  constexpr double kNan = std::numeric_limits<double>::quiet_NaN();
  const auto runner = load(beam());
  ASSERT_TRUE(runner->edit(cut_at(0.1, 1, 0.04)));
  ASSERT_TRUE(runner->step(1));
  const std::string before = runner->positions("beam")->positions();
  EXPECT_REFUSED(runner->edit(cut_at(0.1, 1, 0.04)), ErrorCode::kInvalidArgument, "crosses no edge of body 'beam'");
  EXPECT_REFUSED(runner->edit(cut({{{0, 0, 0}, {0, 0, 1}}})), ErrorCode::kInvalidArgument, "1 positions; give 2");
  EXPECT_REFUSED(runner->edit(cut({{{0, 0, 0}}, {{1, 0, 0}}})), ErrorCode::kInvalidArgument,
                 "3 numbers; give 3 for each");
  EXPECT_REFUSED(runner->edit(cut({{{0, 0, 0}, {0, 0, 1}}, {{1, 0, 0}, {1, 0, 1}, {1, 0, 2}}})),
                 ErrorCode::kInvalidArgument, "a blade keeps its points");
  EXPECT_REFUSED(runner->edit(cut({{{kNan, 0, 0}, {0, 0, 1}}, {{1, 0, 0}, {1, 0, 1}}})), ErrorCode::kInvalidArgument,
                 "edit.cuts[0].blade[1]");
  EXPECT_REFUSED(runner->edit(cut({{{0.1, 1, -1}, {0.1, 1, 1}}, {{0.1, -1, -1}, {0.1, -1, 1}}}, "liver")),
                 ErrorCode::kNotFound, "no body 'liver'; it has: beam");
  v1::SceneEdit both = cut_at(0.05, 1, -1);
  both.add_ablations()->set_body("beam");
  EXPECT_REFUSED(runner->edit(both), ErrorCode::kInvalidArgument, "alone in their edit");
  v1::SceneEdit ablation;
  ablation.add_ablations()->set_body("beam");
  ablation.mutable_ablations(0)->add_elements(3);
  EXPECT_REFUSED(runner->edit(ablation), ErrorCode::kFailedPrecondition, "cannot ablate yet");
  EXPECT_EQ(runner->positions("beam")->positions(), before);

  v1::Scene plain = beam();
  plain.clear_editing();
  EXPECT_REFUSED(load(plain)->edit(cut_at(0.1, 1, -1)), ErrorCode::kFailedPrecondition, "scene.editing.cutting");
  v1::Scene small = beam();
  small.mutable_editing()->set_max_new_vertices(5);
  const auto full = load(small);
  EXPECT_REFUSED(full->edit(cut_at(0.1, 1, -1)), ErrorCode::kResourceExhausted, "raise max_new_vertices");
  ASSERT_TRUE(full->step(1)) << "it goes on";
}

/// Values from a client that made them up.
TEST_P(Cutting, RefusesMadeUpCuts) {
  const auto runner = load(beam());
  ASSERT_TRUE(runner->edit(cut_at(0.1, 1, 0.04)));
  v1::SceneAdjustments present;
  {
    const auto same = runner->adjust({});
    ASSERT_TRUE(same);
    present = same->adjustments();
  }
  const auto with = [&](const auto& change) {
    v1::SceneAdjustments values = present;
    change(*values.mutable_bodies(0)->mutable_cuts());
    return runner->adjust(values);
  };
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) { cuts.Clear(); }), ErrorCode::kFailedPrecondition, "reset it first");
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) { cuts.mutable_edges()->pop_back(); }), ErrorCode::kInvalidArgument,
                 "not whole numbers");
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) { cuts.mutable_edges()->resize(8); }), ErrorCode::kInvalidArgument,
                 "do not fit");
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) { (*cuts.mutable_edges())[3] = '\x7F'; }), ErrorCode::kInvalidArgument,
                 "no edge from node");
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) {
                   const double crossing = std::numeric_limits<double>::quiet_NaN();
                   std::memcpy(cuts.mutable_crossings()->data(), &crossing, sizeof crossing);
                 }),
                 ErrorCode::kInvalidArgument, "is not from 0 to 1");
  EXPECT_REFUSED(with([](v1::MeshCuts& cuts) { cuts.mutable_counts()->assign(4, '\xFF'); }),
                 ErrorCode::kInvalidArgument, "do not fit");
  std::mt19937 random(1);
  for (int i = 0; i < 200; ++i) {
    (void)with([&](v1::MeshCuts& cuts) {
      std::string* const all[] = {cuts.mutable_edges(), cuts.mutable_crossings(), cuts.mutable_counts(),
                                  cuts.mutable_orders()};
      std::string& bytes = *all[random() % 4];
      bytes[random() % bytes.size()] = static_cast<char>(random());
    });
  }
  ASSERT_TRUE(runner->step(2)) << "it goes on";
  EXPECT_TRUE(view_of(*runner).is_closed());
}

}  // namespace
}  // namespace tensormass::world
