#include "contact/solid.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "contact/staged_tool.h"
#include "mesh/random_mesh.h"
#include "support/backends.h"
#include "support/dense_system.h"
#include "support/solids.h"
#include "support/tools.h"

/// Solid tools: their distances, contact in one step, and whole scenes against mechanics.
namespace tensormass::contact {
namespace {

using tests::add_solid;
using tests::StagedScene;

constexpr double kPenalty = 4e6;  // Pa/m

/// A staged scene with its tool at its initial pose.
struct Staged : StagedScene<double> {
  explicit Staged(const v1::Scene& scene, std::uint32_t patches = 1) : StagedScene(scene, patches) {
    place(*this, model.tools[0].initial_pose);
  }
};

/// Calls a function with the kind of a scene's tool.
template <class Call>
void with_kind(const Staged& staged, const Call& call) {
  physics::with_tool(staged.model.tools[0].kind, [&](auto tag) {
    using Kind = typename decltype(tag)::Type;
    if constexpr (Kind::kIsSolid) call(Kind{}, staged.view.contact.tools[0]);
  });
}

class EverySolid : public testing::TestWithParam<std::string> {
 protected:
  /// A block of 1 m that cannot move, with a slab of 0.5 m thickness whose lower face is at y = 1 − depth.
  static v1::Scene rigid_block(double depth_m) {
    v1::Scene scene = tests::rigid_block("spherical_probe", kPenalty);
    scene.clear_tools();
    add_solid(scene, GetParam(), {4, 0.5, 4}, {0.5, 1.25 - depth_m, 0.5}, kPenalty);
    return scene;
  }
};

/// The gradient is a unit vector and the derivative of the distance. The grid of a mesh rounds the edges of the box.
TEST_P(EverySolid, HasTheDistanceOfASlabAndItsGradient) {
  Staged staged(rigid_block(0.1));  // from y = 0.9 to 1.4
  with_kind(staged, [](auto kind, physics::PlacedTool<double> tool) {
    using Kind = decltype(kind);
    const double slack = GetParam() == "mesh" ? 1e-6 : 1e-12;
    for (const double y : {0.75, 0.85, 0.91, 1.1}) {
      const Vec3<double> x(0.31, y, 0.77);
      EXPECT_NEAR(Kind::distance(tool, x), 0.9 - y, slack);
      EXPECT_LT((Kind::gradient(tool, x) - Vec3<double>(0, -1, 0)).norm(), slack);
    }
    if (GetParam() == "plane") return;
    // A point beside an edge of the slab. Outside of the grid of a mesh the distance is a lower bound.
    const double beside = Kind::distance(tool, Vec3<double>(2.5, 0.5, 3.5)), exact = std::sqrt(0.4 * 0.4 + 1);
    EXPECT_LT(beside, exact + slack);
    EXPECT_GT(beside, GetParam() == "mesh" ? 0.8 * exact : exact - slack);
    std::mt19937 random(3);
    std::uniform_real_distribution<double> uniform(-3, 4);
    for (int i = 0; i < 200; ++i) {
      const Vec3<double> x(uniform(random), uniform(random), uniform(random));
      EXPECT_NEAR(Kind::gradient(tool, x).norm(), 1, 1e-9);
      // A distance changes by at most the way, which the broad phase of contact relies on.
      const Vec3<double> y = x + Vec3<double>(uniform(random), uniform(random), uniform(random)) / 8;
      EXPECT_LE(Kind::distance(tool, x) - Kind::distance(tool, y), 1.02 * (x - y).norm());
    }
  });
}

/// Only the top touches: the sides stand on edge.
TEST_P(EverySolid, FeelsStiffnessTimesDepthTimesArea) {
  for (const double depth : {1e-3, 1e-2, 0.1}) {
    Staged staged(rigid_block(depth));
    staged.step();
    const backend::ToolForce tool = measured(staged);
    const double expected = kPenalty * depth;
    EXPECT_NEAR(tool.force_n[1], expected, 1e-3 * expected) << depth;
    EXPECT_LT(std::hypot(tool.force_n[0], tool.force_n[2]), 1e-3 * expected);
    EXPECT_LT(tool.torque_n_m.norm(), 1e-3 * expected);
  }
}

/// The default contact hardens with depth, up to a bound; that of a plane does not.
TEST_P(EverySolid, HardensUnlessItsStiffnessIsGiven) {
  const double doubles_at = kDoublesAt * 0.5, radius = GetParam() == "plane" ? 0.1 * std::sqrt(3.0) : 0.25;
  const double modulus = tests::Beam{}.young_modulus_pa, stiffness = 20 * modulus / radius;
  const double steepest = kStiffest * modulus / stiffness;  // triangles have legs of 1 m
  for (const double depth : {1e-3, 1e-2, 0.1}) {
    v1::Scene scene = rigid_block(depth);
    v1::Tool& tool = *scene.mutable_tools(0);
    if (tool.has_box()) tool.mutable_box()->clear_penalty_stiffness_pa_per_m();
    if (tool.has_mesh()) tool.mutable_mesh()->clear_penalty_stiffness_pa_per_m();
    if (tool.has_plane()) tool.mutable_plane()->clear_penalty_stiffness_pa_per_m();
    Staged staged(scene);
    staged.step();
    double expected = stiffness * depth;
    if (GetParam() != "plane") {
      const double begun = std::min(depth, (steepest - 1) * doubles_at);
      expected += stiffness * begun * (depth - begun / 2) / doubles_at;
    }
    EXPECT_NEAR(measured(staged).force_n[1], expected, 1e-3 * expected) << depth;
  }
}

/// The tissue gains the momentum and the angular momentum that the reported load of the tool gives.
TEST_P(EverySolid, ActsOnTheTissueAsTheTissueOnIt) {
  const mesh::Mesh mesh = mesh::testing::random_mesh(8, 4, 1.0);
  for (const std::uint32_t patches : {1u, 3u}) {
    for (const double friction : {0.0, 0.5}) {
      v1::Scene scene = tests::packed_scene(mesh, true);
      v1::Tool& tool = add_solid(scene, GetParam(), {0.7, 0.5, 0.6}, {0.5, 1.15, 0.45}, kPenalty);
      tool.set_friction_coefficient(friction);
      scene.mutable_solver()->set_cg_max_iterations(3000);
      scene.mutable_solver()->set_cg_tolerance(1e-13);
      Staged staged(scene, patches);
      Vec3<double> momentum = Vec3<double>::Zero(), angular = Vec3<double>::Zero();
      for (int i = 0; i < 2; ++i) staged.step();
      const Eigen::VectorXd before = staged.by_node(staged.view.state.velocity);
      const Eigen::VectorXd u = staged.by_node(staged.view.state.displacement);
      staged.step();
      const Eigen::VectorXd gained = staged.by_node(staged.view.state.velocity) - before;
      const Vec3<double> origin = staged.model.tools[0].initial_pose.position_m;
      for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
        const Vec3<double> mv = staged.model.inertia[4 * std::size_t{staged.row(node)}] * gained.segment<3>(3 * node);
        momentum += mv;
        angular += (mesh.nodes[node] + u.segment<3>(3 * node) - origin).cross(mv);
      }
      const backend::ToolForce load = measured(staged);
      ASSERT_GT(load.force_n[1], 100);
      const double dt = staged.model.dt_s;
      EXPECT_LT((momentum + dt * load.force_n).norm(), 1e-8 * momentum.norm());
      // Elastic forces turn the body as it deforms; only the forces of the tool are at the start of the step.
      EXPECT_LT((angular + dt * load.torque_n_m).norm(), 0.05 * momentum.norm());
    }
  }
}

/// A solid that pokes between the corners of a triangle is felt.
TEST_P(EverySolid, TouchesBetweenTheCorners) {
  if (GetParam() == "plane") GTEST_SKIP() << "a plane has neither edges nor tips";
  v1::Scene scene = tests::rigid_block("spherical_probe", kPenalty);
  scene.clear_tools();
  add_solid(scene, GetParam(), {0.1, 0.5, 0.1}, {1.0 / 3, 1.24, 2.0 / 3}, kPenalty);  // over a centroid
  Staged staged(scene);
  staged.step();
  EXPECT_NEAR(measured(staged).force_n[1], kPenalty * 0.5 / 4 * 0.01, 0.01 * kPenalty * 0.5 / 4 * 0.01);
}

INSTANTIATE_TEST_SUITE_P(Tools, EverySolid, testing::ValuesIn(tests::solid_kinds()),
                         [](const auto& one) { return one.param; });

/// Steepest descent finds a point of the triangle that is nearly as deep as the deepest of many.
TEST(NearestToMiddle, IsNearlyTheDeepest) {
  v1::Scene scene = tests::rigid_block("spherical_probe", kPenalty);
  scene.clear_tools();
  add_solid(scene, "box", {0.6, 0.4, 0.5}, {0, 0, 0}, kPenalty);
  Staged staged(scene);
  const physics::PlacedTool<double> tool = staged.view.contact.tools[0];
  std::mt19937 random(5);
  std::uniform_real_distribution<double> uniform(-0.8, 0.8);
  int touching = 0, missed = 0;
  for (int trial = 0; trial < 1000; ++trial) {
    Corners<double> corners;
    for (auto& x : corners.x) x = {uniform(random), uniform(random), uniform(random)};
    double deepest = 0;
    constexpr int kSamples = 40;
    for (int i = 0; i <= kSamples; ++i) {
      for (int j = 0; i + j <= kSamples; ++j) {
        const Vec3<double> weights(double(i) / kSamples, double(j) / kSamples, double(kSamples - i - j) / kSamples);
        deepest = std::max(deepest, -physics::BoxSolid::distance(tool, corners.at(weights)));
      }
    }
    if (deepest < 0.02) continue;
    ++touching;
    double found = -physics::BoxSolid::distance(tool, corners.at(nearest_to_middle<physics::BoxSolid>(tool, corners)));
    for (const Vec3<double>& corner : corners.x) found = std::max(found, -physics::BoxSolid::distance(tool, corner));
    missed += found < 0.5 * deepest ? 1 : 0;
  }
  EXPECT_GT(touching, 300);
  EXPECT_LT(missed, 0.08 * touching);
}

/// Whole scenes.
class SolidScene : public tests::OnBackend {
 protected:
  /// A free block of 4 × 4 × 4 cm and Young's modulus 1e5 Pa, without gravity.
  static v1::Scene free_block(double poisson_ratio) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 4,
                                         .cells_z = 4,
                                         .size_x_m = 0.04,
                                         .size_y_m = 0.04,
                                         .size_z_m = 0.04,
                                         .double_precision = true,
                                         .young_modulus_pa = 1e5,
                                         .poisson_ratio = poisson_ratio,
                                         .dt_s = 0.002,
                                         .cg_max_iterations = 500,
                                         .cg_tolerance = 1e-10});
    scene.mutable_bodies(0)->clear_fixed();
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(20);
    scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.002);
    scene.clear_gravity_m_per_s2();
    return scene;
  }
  /// Mean displacement and velocity along x, and the largest speed of a node.
  struct Motion {
    double x_m = 0, v_m_per_s = 0, fastest_m_per_s = 0;
  };
  static Motion motion_of(world::World& world) {
    const backend::RowState now = world.state();
    const auto& mass = world.model().row_mass;
    Motion out;
    double all = 0;
    for (std::size_t row = 0; row < mass.size(); ++row) {
      out.x_m += mass[row] * now.displacement[4 * row];
      out.v_m_per_s += mass[row] * now.velocity[4 * row];
      all += mass[row];
      for (std::size_t c = 0; c < 3; ++c) {
        out.fastest_m_per_s = std::max(out.fastest_m_per_s, std::abs(now.velocity[4 * row + c]));
      }
    }
    out.x_m /= all;
    out.v_m_per_s /= all;
    return out;
  }
};

class ByMethod : public SolidScene {
 protected:
  /// Presses a block between a table and a platen. It is compressed uniformly: F = E A ε, and both feel the same force.
  ///
  ///   gives_way_m_per_n   by which each of the two contacts gives way
  void compress(v1::ContactMethod method, double penalty_pa_per_m, double gives_way_m_per_n);
};

void ByMethod::compress(v1::ContactMethod method, double penalty_pa_per_m, double gives_way_m_per_n) {
  constexpr double kAreaM2 = 0.04 * 0.04, kYoungPa = 1e5, kPressM = 1e-3;
  for (const char* platen : {"box", "plane", "mesh"}) {
    v1::Scene scene = free_block(0);
    scene.mutable_bodies(0)->mutable_law()->mutable_hooke()->set_young_modulus_pa(kYoungPa);
    add_solid(scene, "plane", {1, 0.02, 1}, {0.02, -0.01, 0.02}, penalty_pa_per_m, true).set_name("table");
    add_solid(scene, platen, {0.1, 0.02, 0.1}, {0.02, 0.05 - kPressM, 0.02}, penalty_pa_per_m).set_name("platen");
    for (v1::Tool& tool : *scene.mutable_tools()) tool.set_contact_method(method);
    const auto world = start(scene);
    for (int i = 0; i < 500; ++i) ASSERT_TRUE(world->step(false));
    const auto& readings = world->readings();
    const double spring = kYoungPa * kAreaM2 / 0.04;
    const double expected = kPressM / (1 / spring + 2 * gives_way_m_per_n);
    const double slack = std::string(platen) == "mesh" ? 2e-3 : 1e-4;
    EXPECT_NEAR(readings[1].force_n[1], expected, slack * expected) << platen;
    EXPECT_NEAR(readings[0].force_n[1], -expected, slack * expected) << platen;
    const auto positions = world->positions(world->model().bodies[0]);
    for (std::size_t i = 0; i < positions.size(); i += 3) {
      const double rest = world->model().rest[4 * world->model().layout.row_of_node[i / 3] + 1];
      const double share = expected * gives_way_m_per_n;  // by which the block sinks into the table
      EXPECT_NEAR(positions[i + 1], -share + rest * (1 - expected / (kYoungPa * kAreaM2)), 1e-2 * kPressM);
    }
  }
}

TEST_P(ByMethod, APenaltyGivesWayByItsStiffness) {
  constexpr double kStiffPenalty = 1e9, kAreaM2 = 0.04 * 0.04;
  compress(v1::CONTACT_METHOD_PENALTY, kStiffPenalty, 1 / (kStiffPenalty * kAreaM2));
}

/// With a penalty that would give way by 40 % of the motion.
TEST_P(ByMethod, AKeptForceGivesNoWay) { compress(v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN, 1e7, 0); }

TM_ON_EACH_BACKEND(ByMethod);

/// A block on a tilted table rests if μ is larger than the slope; else it slides with g (sin θ − μ cos θ).
TEST_P(SolidScene, ABlockOnATableRestsOrSlides) {
  constexpr double kSlope = 0.25, kGravity = 9.81;
  const double angle = std::atan(kSlope);
  for (const char* table : {"plane", "box"}) {
    for (const double coefficient : {0.15, 0.4}) {
      v1::Scene scene = free_block(0.3);
      scene.mutable_bodies(0)->set_rayleigh_mass_per_s(0);
      tests::set(*scene.mutable_gravity_m_per_s2(), kGravity * std::sin(angle), -kGravity * std::cos(angle), 0);
      add_solid(scene, table, {1, 0.02, 1}, {0.02, -0.01, 0.02}, 1e7, true).set_friction_coefficient(coefficient);
      const auto world = start(scene);
      for (int i = 0; i < 200; ++i) ASSERT_TRUE(world->step(false));
      const Motion first = motion_of(*world);
      for (int i = 0; i < 100; ++i) ASSERT_TRUE(world->step(false));
      const Motion last = motion_of(*world);
      if (coefficient > kSlope) {
        EXPECT_LT(std::abs(last.x_m - first.x_m), 1e-7) << table << ": rests";
        EXPECT_LT(last.fastest_m_per_s, 1e-6) << table << ": rests";
      } else {
        const double acceleration = kGravity * (std::sin(angle) - coefficient * std::cos(angle));
        EXPECT_NEAR((last.v_m_per_s - first.v_m_per_s) / 0.2, acceleration, 0.02 * acceleration) << table << ": slides";
      }
    }
  }
}

/// Soft tissue comes nearly to rest under a sharp box that is hardly wider than an element, and its load is that of the
/// table below. With the gradient of the distance instead of its mean over a stencil the force goes on changing by 4 %.
TEST_P(SolidScene, TissueComesToRestUnderABox) {
  for (const char* kind : {"box", "mesh"}) {
    v1::Scene scene = free_block(0.45);
    v1::IsotropicElastic& law = *scene.mutable_bodies(0)->mutable_law()->mutable_stable_neo_hookean();
    law.set_young_modulus_pa(5e3);
    law.set_poisson_ratio(0.45);
    add_solid(scene, "plane", {1, 0.02, 1}, {0.02, -0.01, 0.02}, 1.5e7, true).set_friction_coefficient(0.5);
    v1::Tool& box = add_solid(scene, kind, {0.013, 0.02, 0.1}, {0.023, 0.05, 0.02}, 1.5e7);
    box.set_name("box");
    const auto world = start(scene);
    world->set_tool_target(1, {{0.023, 0.046, 0.02}, {1, 0, 0, 0}});
    for (int i = 0; i < 1000; ++i) ASSERT_TRUE(world->step(false));
    const Vec3<double> held = world->readings()[1].force_n;
    ASSERT_GT(held[1], 0.05);
    EXPECT_LT((held + world->readings()[0].force_n).norm(), 0.01 * held.norm());
    for (int i = 0; i < 50; ++i) {
      ASSERT_TRUE(world->step(false));
      EXPECT_LT((world->readings()[1].force_n - held).norm(), 0.005 * held.norm()) << kind << ", step " << i;
    }
  }
}

TM_ON_EACH_BACKEND(SolidScene);

}  // namespace
}  // namespace tensormass::contact
