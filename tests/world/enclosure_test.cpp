#include <cmath>
#include <random>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"
#include "support/tools.h"
#include "world/enclosure.h"
#include "world/world.h"

/// Tools that tissue encloses: how they are found, and how a scene takes them out.
namespace tensormass::world {
namespace {

using Outcome = GuardEvent::Outcome;

constexpr double kDtS = 0.01;
/// Middle of the block of block_with_probe, which is 0.1 m × 0.05 m × 0.1 m and held below.
const Vec3<double> kMiddle{0.05, 0.025, 0.05};

v1::Scene block(std::uint32_t cells = 4) {
  v1::Scene scene = tests::block_with_probe(true, cells);
  scene.mutable_stepping()->set_dt_s(kDtS);
  return scene;
}

Pose at(const Vec3<double>& place) { return {place, {1, 0, 0, 0}, {}}; }

/// Whether a point is in the block at rest.
bool in_block(const Vec3<double>& p) {
  return p.x() > 0 && p.x() < 0.1 && p.y() > 0 && p.y() < 0.05 && p.z() > 0 && p.z() < 0.1;
}

class Enclosed : public tests::OnBackend {};

TEST_P(Enclosed, ARandomPointIsInsideWhereTheBlockIs) {
  const auto world = start(block());
  Enclosure enclosure(world->model());
  ASSERT_FALSE(enclosure.empty());
  enclosure.update(world->visible_positions());
  const model::ToolModel& probe = world->model().tools[0];
  std::mt19937 random(1);
  std::uniform_real_distribution<double> within(-0.02, 0.12);
  int inside = 0;
  for (int i = 0; i < 2000; ++i) {
    const Vec3<double> p{within(random), within(random), within(random)};
    EXPECT_EQ(enclosure.is_outside(probe, at(p)), !in_block(p)) << p.transpose();
    inside += in_block(p);
  }
  EXPECT_GT(inside, 200);
  // Points of the mesh lie on lines through corners and along edges.
  for (const double x : {0.025, 0.05, 0.075}) {
    for (const double z : {0.025, 0.05, 0.075}) EXPECT_FALSE(enclosure.is_outside(probe, at({x, 0.025, z})));
  }
}

TEST_P(Enclosed, HalfARadiusOfTissueIsAroundIt) {
  const auto world = start(block());
  Enclosure enclosure(world->model());
  enclosure.update(world->visible_positions());
  const model::ToolModel& probe = world->model().tools[0];
  ASSERT_EQ(probe.radius_m, 0.01);
  EXPECT_TRUE(enclosure.encloses(probe, at({0.05, 0.0445, 0.05})));
  EXPECT_FALSE(enclosure.encloses(probe, at({0.05, 0.0455, 0.05})));
  EXPECT_FALSE(enclosure.encloses(probe, at({0.05, 0.07, 0.05})));
}

/// A look tests only triangles near the tool. The answer is that of all triangles: the points around a core are inside.
TEST_P(Enclosed, ALookFindsWhatAllTrianglesSay) {
  const auto world = start(block(6));
  Enclosure enclosure(world->model());
  enclosure.update(world->visible_positions());
  const model::ToolModel& probe = world->model().tools[0];
  std::mt19937 random(2);
  std::uniform_real_distribution<double> within(-0.01, 0.11);
  int enclosed = 0;
  for (int i = 0; i < 500; ++i) {
    const Vec3<double> p{within(random), within(random), within(random)};
    bool expected = !enclosure.is_outside(probe, at(p));
    for (int side = 0; side < 6; ++side) {
      const Vec3<double> way = (side % 2 == 0 ? 0.5 : -0.5) * probe.radius_m * Vec3<double>::Unit(side / 2);
      expected = expected && !enclosure.is_outside(probe, at(p + way));
    }
    EXPECT_EQ(enclosure.encloses(probe, at(p)), expected) << p.transpose();
    enclosed += expected;
  }
  EXPECT_GT(enclosed, 50);
}

TEST_P(Enclosed, TheWayOutIsTheShortestAlongAnAxis) {
  const auto world = start(block());
  Enclosure enclosure(world->model());
  enclosure.update(world->visible_positions());
  const model::ToolModel& probe = world->model().tools[0];
  struct Case {
    Vec3<double> from, way;
  };
  const double beside_m = 2 * probe.radius_m;
  for (const auto& [from, way] :
       {Case{{0.05, 0.04, 0.05}, {0, 0.01 + beside_m, 0}}, Case{{0.008, 0.025, 0.05}, {-0.008 - beside_m, 0, 0}},
        Case{{0.05, 0.025, 0.093}, {0, 0, 0.007 + beside_m}}}) {
    const auto out = enclosure.way_out(probe, at(from));
    ASSERT_TRUE(out);
    EXPECT_LT((*out - way).norm(), 1e-6) << out->transpose();
  }
}

TEST_P(Enclosed, AnOpenSurfaceEnclosesNothing) {
  v1::Scene scene = block();
  std::vector<double> vertices;
  for (const double x : {0.02, 0.08}) {
    for (const double z : {0.02, 0.08}) vertices.insert(vertices.end(), {x, 0.04, z});
  }
  const std::vector<std::uint32_t> triangles{0, 1, 2, 1, 3, 2};
  v1::PackedTriangles& skin = *scene.mutable_bodies(0)->mutable_skin()->mutable_packed();
  skin.set_vertex_positions(vertices.data(), vertices.size() * sizeof(double));
  skin.set_triangles(triangles.data(), triangles.size() * sizeof(std::uint32_t));
  EXPECT_TRUE(Enclosure(start(scene)->model()).empty());
}

/// The hand stays in the middle. The tool comes in from outside, and its force grows gently to what the hand presses.
TEST_P(Enclosed, AToolThatBeginsInsideIsTakenOut) {
  for (const std::string& kind : tests::thin_tool_kinds()) {
    SCOPED_TRACE(kind);
    v1::Scene scene = block();
    scene.clear_gravity_m_per_s2();
    scene.clear_tools();
    v1::Tool& tool = tests::add_tool(scene, kind, 0.004, kMiddle.x(), 0.03, kMiddle.z(), 2e6);
    tool.set_max_force_n(0.3);
    tool.set_max_torque_n_m(0.05);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    ASSERT_NE(world->guard_event(), nullptr);
    EXPECT_EQ(world->guard_event()->outcome, Outcome::kTakenOut);
    EXPECT_NE(to_text(*world->guard_event(), world->model()).find("'tool' was inside tissue"), std::string::npos);
    EXPECT_TRUE(world->recovering());
    Enclosure enclosure(world->model());
    double force_n = 0;
    for (int i = 0; i < 150; ++i) {
      ASSERT_TRUE(world->step(false)) << i;
      const ToolReading& reading = world->readings()[0];
      EXPECT_LE(reading.force_n.norm(), 0.3) << i;
      EXPECT_FALSE(reading.retired);
      force_n = reading.force_n.norm();
      world->gather_visible();
      enclosure.update(world->visible_positions());
      EXPECT_FALSE(enclosure.encloses(world->model().tools[0], reading.pose)) << i;
    }
    EXPECT_GT(force_n, 0.05) << "it presses from outside";
    world->set_tool_target(0, at({0.05, 0.3, 0.05}));
    for (int i = 0; i < 300; ++i) ASSERT_TRUE(world->step(false)) << i;
    double away_m = 0;
    for (const double u : world->state().displacement) away_m = std::max(away_m, std::abs(u));
    EXPECT_LT(away_m, 1e-3);
  }
}

/// A scene in which nobody asked to go on keeps its tool where it is.
TEST_P(Enclosed, ASceneThatStopsTakesNothingOut) {
  v1::Scene scene = block();
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), kMiddle.x(), kMiddle.y(), kMiddle.z());
  scene.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_STOP);
  const auto world = start(scene);
  world->step(false);
  EXPECT_FALSE(world->recovering());
  EXPECT_EQ(world->readings()[0].pose.position_m, kMiddle);
}

/// A tool that is pressed in, and then found inside, fades out where it is before it comes back. What it does next is
/// part of the saved state.
TEST_P(Enclosed, AToolThatFeelsTissueFadesOutFirst) {
  v1::Scene scene = block(8);
  v1::IsotropicElastic& law = *scene.mutable_bodies(0)->mutable_law()->mutable_stable_neo_hookean();
  law.set_young_modulus_pa(5e3);
  law.set_poisson_ratio(0.3);
  const Pose inside = at({0.05, 0.03, 0.05});
  const auto run = [&](bool saves) {
    auto world = start(scene);
    world->set_tool_target(0, at({0.05, 0.054, 0.05}));
    for (int i = 0; i < 20; ++i) EXPECT_TRUE(world->step(false));
    World::Saved saved = world->save();
    EXPECT_GT(saved.tools[0].force.force_n.norm(), 0.01);
    saved.tools[0].motion.pose = saved.tools[0].motion.target = inside;
    world->restore(saved);
    std::vector<Vec3<double>> places;
    for (int i = 0; i < 40; ++i) {
      EXPECT_TRUE(world->step(false));
      EXPECT_EQ(world->recovering(), i == 0) << i;
      EXPECT_FALSE(world->readings()[0].retired);
      places.push_back(world->readings()[0].pose.position_m);
      if (!saves || i % 3 != 0) continue;
      const World::Saved now = world->save();
      world = start(scene);
      world->restore(now);
    }
    return places;
  };
  const std::vector<Vec3<double>> places = run(false);
  for (int i = 0; i < 9; ++i) EXPECT_LT((places[i] - inside.position_m).norm(), 1e-3) << i;
  EXPECT_GT(places[12].y(), 0.06);
  EXPECT_EQ(places, run(true));
}

TM_ON_EACH_BACKEND(Enclosed);

}  // namespace
}  // namespace tensormass::world
