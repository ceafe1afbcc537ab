#include "contact/links.h"

#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "support/backends.h"
#include "support/dense_system.h"
#include "support/momentum.h"
#include "support/staged_scene.h"

/// Bodies that touch each other and bodies that are attached to each other, against mechanics.
namespace tensormass::contact {
namespace {

using tests::momentum_of;

constexpr double kYoungPa = 5e3, kSizeM = 0.1;

/// Adds a cube of soft tissue with its lowest corner at `corner_m`. The cubes of a scene have different meshes.
v1::Body& add_cube(v1::Scene& scene, const std::string& name, const Vec3<double>& corner_m, std::uint32_t cells,
                   const Vec3<double>& size_m = Vec3<double>::Constant(kSizeM)) {
  v1::Body& body = *scene.add_bodies();
  body.set_name(name);
  v1::Grid& grid = *body.mutable_mesh()->mutable_grid();
  tests::set(*grid.mutable_size_m(), size_m[0], size_m[1], size_m[2]);
  grid.set_cells_x(cells);
  grid.set_cells_y(cells);
  grid.set_cells_z(cells);
  tests::set(*body.mutable_mesh()->mutable_translation_m(), corner_m[0], corner_m[1], corner_m[2]);
  v1::IsotropicElastic& law = *body.mutable_law()->mutable_stable_neo_hookean();
  law.set_young_modulus_pa(kYoungPa);
  law.set_poisson_ratio(0);  // a column under pressure then has one strain everywhere
  body.set_density_kg_per_m3(1000);
  return body;
}

/// A scene without bodies whose solves are exact.
v1::Scene empty_scene(double dt_s) {
  v1::Scene scene = tests::beam_scene({.double_precision = true, .dt_s = dt_s, .cg_max_iterations = 2000});
  scene.set_name("links");
  scene.clear_bodies();
  scene.clear_gravity_m_per_s2();
  scene.mutable_solver()->set_cg_tolerance(1e-10);
  return scene;
}

v1::BodyContact& let_touch(v1::Scene& scene, const std::string& body, const std::string& other, double distance_m = 0) {
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body(body);
  contact.set_other(other);
  contact.set_distance_m(distance_m);
  return contact;
}

/// Selects the nodes of a plane y = height.
void set_layer(v1::Region& region, double height_m) {
  tests::set(*region.mutable_box()->mutable_min_m(), -1, height_m - 1e-6, -1);
  tests::set(*region.mutable_box()->mutable_max_m(), 1, height_m + 1e-6, 1);
}

/// Returns the mean position of the nodes of a body that rest at this height [m].
Vec3<double> mean_of_layer(world::World& world, std::size_t body, double height_m) {
  const model::Model& m = world.model();
  const std::vector<double> x = world.positions(m.bodies[body]);
  Vec3<double> sum = Vec3<double>::Zero();
  int count = 0;
  for (std::uint32_t node = 0; node < m.bodies[body].node_count; ++node) {
    const std::size_t row = m.layout.row_of_node[m.bodies[body].node_begin + node];
    if (std::abs(m.rest[4 * row + 1] - height_m) > 1e-6) continue;
    sum += Vec3<double>(x[3 * node], x[3 * node + 1], x[3 * node + 2]);
    ++count;
  }
  return sum / count;
}

class Bodies : public tests::OnBackend {};

/// Two equal blocks, one on the other, pressed together by 20 % of their height. Their meshes do not match. Friction
/// holds their rims, which would slip past each other without it.
TEST_P(Bodies, PressedTogetherShareTheCompression) {
  v1::Scene scene = empty_scene(1);
  v1::Body& lower = add_cube(scene, "lower", {0, 0, 0}, 4);
  v1::Body& upper = add_cube(scene, "upper", {0, kSizeM, 0}, 5);
  set_layer(*lower.add_fixed(), 0);
  v1::PrescribedDisplacement& press = *upper.add_prescribed();
  set_layer(*press.mutable_region(), 2 * kSizeM);
  press.set_x_m(0);
  press.set_y_m(-0.2 * 2 * kSizeM);
  press.set_z_m(0);
  press.mutable_schedule()->mutable_time_s()->Add(0);
  press.mutable_schedule()->mutable_factor()->Add(0);
  press.mutable_schedule()->mutable_time_s()->Add(20);
  press.mutable_schedule()->mutable_factor()->Add(1);
  v1::BodyContact& contact = let_touch(scene, "upper", "lower");
  contact.clear_distance_m();
  contact.set_friction_coefficient(0.5);
  const auto world = start(scene);
  for (int i = 0; i < 40; ++i) ASSERT_TRUE(world->step(false));
  const double of_lower = kSizeM - mean_of_layer(*world, 0, kSizeM)[1];
  const double of_upper = kSizeM - (1.6 * kSizeM - mean_of_layer(*world, 1, kSizeM)[1]);
  EXPECT_GT(of_lower, 0.19 * kSizeM);
  EXPECT_NEAR(of_lower, of_upper, 0.01 * of_upper);
  EXPECT_EQ(world->last().touching_nodes, 25u + 36u) << "every node of the two faces";
}

/// A free block meets another in flight. Neither passes through the other, and their momentum stays.
TEST_P(Bodies, KeepTheirMomentumWhenTheyCollide) {
  constexpr double kSpeed = 0.5;
  v1::Scene scene = empty_scene(1e-3);
  add_cube(scene, "target", {0, 0, 0}, 3);
  v1::Body& bullet = add_cube(scene, "bullet", {0.021, kSizeM + 0.004, 0.013}, 4);
  std::vector<double> velocity;
  for (int i = 0; i < 125; ++i) velocity.insert(velocity.end(), {0.03, -kSpeed, 0.02});
  bullet.set_initial_velocity_m_per_s(
      std::string(reinterpret_cast<const char*>(velocity.data()), velocity.size() * sizeof(double)));
  let_touch(scene, "target", "bullet", 0.001);
  const auto world = start(scene);
  const Vec3<double> before = momentum_of(*world);
  ASSERT_NEAR(before[1], -kSpeed, 1e-9);  // a kilogram
  std::uint32_t touching = 0;
  for (int i = 0; i < 200; ++i) {
    ASSERT_TRUE(world->step(false));
    touching = std::max(touching, world->last().touching_nodes);
    EXPECT_LT((momentum_of(*world) - before).norm(), 1e-6 * before.norm()) << "step " << i;
  }
  EXPECT_GT(touching, 5u);
  const double gap = mean_of_layer(*world, 1, kSizeM + 0.004)[1] - mean_of_layer(*world, 0, kSizeM)[1];
  EXPECT_GT(gap, 0);
  EXPECT_EQ(world->last().touching_nodes, 0u) << "they fly apart";
}

/// What a link takes from one free body it gives to the other, whatever the tolerance of the solve: three blocks meet
/// in flight.
TEST_P(Bodies, GiveEachOtherWhatTheyTakeWhateverTheTolerance) {
  for (const bool precise : {true, false}) {
    for (const double friction : {0.0, 0.5}) {
      SCOPED_TRACE(std::string(precise ? "double" : "float") + ", friction " + std::to_string(friction));
      v1::Scene scene = empty_scene(1.0 / 240);
      scene.clear_solver();
      scene.mutable_solver()->set_precision(precise ? v1::Solver::PRECISION_DOUBLE : v1::Solver::PRECISION_FLOAT);
      add_cube(scene, "a", {0, 0, 0}, 3);
      add_cube(scene, "b", {0.01, kSizeM + 0.006, 0.013}, 4);
      add_cube(scene, "c", {0.03, 2 * kSizeM + 0.012, -0.02}, 3);
      const double velocities[3][3] = {{0, 0.4, 0}, {0.03, 0, 0.02}, {-0.1, -0.5, 0.05}};
      for (int body = 0; body < 3; ++body) {
        const int nodes = body == 1 ? 125 : 64;
        std::vector<double> velocity;
        for (int i = 0; i < nodes; ++i) velocity.insert(velocity.end(), velocities[body], velocities[body] + 3);
        scene.mutable_bodies(body)->set_initial_velocity_m_per_s(
            std::string(reinterpret_cast<const char*>(velocity.data()), velocity.size() * sizeof(double)));
        scene.mutable_bodies(body)->set_rayleigh_stiffness_s(0.002);
      }
      let_touch(scene, "a", "b", 0.001).set_friction_coefficient(friction);
      let_touch(scene, "c", "b", 0.001).set_friction_coefficient(friction);
      const auto world = start(scene);
      const Vec3<double> before = momentum_of(*world);
      std::uint32_t touching = 0;
      double worst = 0;
      for (int i = 0; i < 120; ++i) {
        ASSERT_TRUE(world->step(false));
        touching = std::max(touching, world->last().touching_nodes);
        worst = std::max(worst, (momentum_of(*world) - before).norm());
      }
      EXPECT_GT(touching, 10u);
      constexpr double kOfOneBlock = 0.5;  // a kilogram at the speed of the fastest [kg m/s]
      EXPECT_LT(worst, (precise ? 1e-10 : 2e-5) * kOfOneBlock);
    }
  }
}

/// Three blocks on each other under gravity come to rest, and each carries those above it. Ten times softer, the stack
/// would buckle under its own weight: ρ g A H³ / (E I) = 16, and 7.8 is critical.
TEST_P(Bodies, StackedRest) {
  v1::Scene scene = empty_scene(1.0 / 60);
  set_layer(*add_cube(scene, "a", {0, 0, 0}, 3).add_fixed(), 0);
  add_cube(scene, "b", {0, kSizeM, 0}, 4);
  add_cube(scene, "c", {0, 2 * kSizeM, 0}, 3);
  for (v1::Body& body : *scene.mutable_bodies()) {
    body.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(40 * kYoungPa);
    body.set_rayleigh_mass_per_s(5);
  }
  let_touch(scene, "b", "a").set_friction_coefficient(0.5);
  let_touch(scene, "c", "b").set_friction_coefficient(0.5);
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  const auto world = start(scene);
  for (int i = 0; i < 400; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_LT(world->last().max_speed_m_per_s, 1e-5);
  // A column of weight ρ g x above a point is compressed by ρ g x / E there, to first order.
  const double weight_pa = 1000 * 9.81 * kSizeM, compression = weight_pa * 2.5 / (40 * kYoungPa) * kSizeM;
  EXPECT_NEAR(kSizeM - mean_of_layer(*world, 0, kSizeM)[1], compression, 0.02 * compression);
  const Vec3<double> top = mean_of_layer(*world, 2, 3 * kSizeM);
  for (int i = 0; i < 200; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_LT((mean_of_layer(*world, 2, 3 * kSizeM) - top).norm(), 1e-6);
}

/// A block on a tilted one stays while tan θ < μ, and slides with g (sin θ − μ cos θ) beyond. Gravity is tilted
/// instead.
TEST_P(Bodies, StickAndSlideByCoulombsLaw) {
  constexpr double kTilt = 0.3, kGravity = 9.81;
  for (const double friction : {0.4, 0.2}) {
    v1::Scene scene = empty_scene(2e-3);
    v1::Body& ground = add_cube(scene, "ground", {0, 0, 0}, 4, {0.3, 0.05, 0.1});
    add_cube(scene, "block", {0.02, 0.05, 0.025}, 2, Vec3<double>::Constant(0.05));
    for (v1::Body& body : *scene.mutable_bodies()) {
      body.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(1e6);
      body.set_rayleigh_stiffness_s(0.002);
    }
    tests::set(*ground.add_fixed()->mutable_box()->mutable_min_m(), -1, -1, -1);
    tests::set(*ground.mutable_fixed(0)->mutable_box()->mutable_max_m(), 1, 1, 1);
    let_touch(scene, "block", "ground").set_friction_coefficient(friction);
    tests::set(*scene.mutable_gravity_m_per_s2(), kGravity * std::sin(kTilt), -kGravity * std::cos(kTilt), 0);
    const auto world = start(scene);
    for (int i = 0; i < 200; ++i) ASSERT_TRUE(world->step(false));
    const double before = mean_of_layer(*world, 1, 0.05)[0], speed = momentum_of(*world)[0] / 0.125;
    for (int i = 0; i < 50; ++i) ASSERT_TRUE(world->step(false));
    const double moved = mean_of_layer(*world, 1, 0.05)[0] - before, gained = momentum_of(*world)[0] / 0.125 - speed;
    if (friction > std::tan(kTilt)) {
      EXPECT_LT(std::abs(moved), 1e-6);
    } else {
      const double expected = kGravity * (std::sin(kTilt) - friction * std::cos(kTilt)) * 0.1;
      EXPECT_NEAR(gained, expected, 0.02 * expected);
    }
  }
}

/// One body of two parts. Its upper part falls on its lower one, and only self-contact stops it.
TEST_P(Bodies, TouchThemselves) {
  constexpr double kStart = 0.045;
  for (const bool touches : {false, true}) {
    mesh::Mesh mesh = mesh::make_grid({0, 0, 0}, {0.1, 0.03, 0.1}, 4, 2, 4).value();
    const auto nodes = static_cast<std::uint32_t>(mesh.nodes.size());
    for (std::uint32_t i = 0; i < nodes; ++i) {
      mesh.nodes.push_back(0.5 * mesh.nodes[i] + Eigen::Vector3d(0.023, kStart, 0.019));
    }
    const std::size_t entries = mesh.blocks[0].nodes.size();
    for (std::size_t i = 0; i < entries; ++i) mesh.blocks[0].nodes.push_back(mesh.blocks[0].nodes[i] + nodes);
    v1::Scene scene = tests::packed_scene(mesh, false);
    scene.mutable_bodies(0)->mutable_law()->mutable_st_venant_kirchhoff()->set_young_modulus_pa(kYoungPa);
    scene.mutable_stepping()->set_dt_s(1.0 / 200);
    scene.mutable_solver()->set_cg_max_iterations(500);
    scene.mutable_solver()->set_cg_tolerance(1e-8);
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(5);
    set_layer(*scene.mutable_bodies(0)->add_fixed(), 0);
    tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
    if (touches) let_touch(scene, "beam", "", 0.001).set_reach_m(0.006);
    const auto world = start(scene);
    for (int i = 0; i < (touches ? 400 : 60); ++i) ASSERT_TRUE(world->step(false));
    const double lowest = mean_of_layer(*world, 0, kStart)[1];
    if (touches) {
      EXPECT_GT(lowest, 0.02);
      EXPECT_LT(lowest, 0.032);
      EXPECT_GT(world->last().touching_nodes, 10u);
    } else {
      EXPECT_LT(lowest, -0.1);
    }
  }
}

/// A sheet that is folded over itself. Its upper half sinks on the lower one and rests there, without passing through.
TEST_P(Bodies, FoldedSheetRests) {
  constexpr double kThick = 0.005, kRadius = 0.0075, kHalf = 0.06;  // m; the halves are 10 mm apart
  const double length = 2 * kHalf + std::numbers::pi * kRadius;
  mesh::Mesh mesh = mesh::make_grid({0, -kThick / 2, 0}, {length, kThick, 0.04}, 36, 2, 8).value();
  for (Eigen::Vector3d& x : mesh.nodes) {
    const double along = x[0] - kHalf, out = x[1];
    if (along <= 0) continue;  // the lower half
    const double angle = std::min(along / kRadius, std::numbers::pi), rest = along - angle * kRadius;
    // Around the fold's axis at x = kHalf, y = kRadius. The sheet's upper side turns inward.
    x[0] = kHalf + (kRadius - out) * std::sin(angle) - rest;
    x[1] = kRadius - (kRadius - out) * std::cos(angle);
  }
  v1::Scene scene = tests::packed_scene(mesh, false);
  v1::Body& sheet = *scene.mutable_bodies(0);
  sheet.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(2e3);
  sheet.mutable_law()->mutable_stable_neo_hookean()->set_poisson_ratio(0.3);
  sheet.set_quadrature(v1::QUADRATURE_SELECTIVE);
  sheet.set_rayleigh_mass_per_s(5);
  set_layer(*sheet.add_fixed(), -kThick / 2);
  scene.mutable_stepping()->set_dt_s(1.0 / 120);
  scene.mutable_solver()->set_cg_max_iterations(1000);
  scene.mutable_solver()->set_cg_tolerance(1e-8);
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  let_touch(scene, "beam", "", 0.001).set_reach_m(0.004);
  scene.mutable_body_contacts(0)->set_friction_coefficient(0.3);
  const auto world = start(scene);
  for (int i = 0; i < 400; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_GT(world->last().touching_nodes, 20u);
  EXPECT_LT(world->last().deepest_contact_m, 0.002);
  EXPECT_LT(world->last().max_speed_m_per_s, 1e-5);
  const double upper = 2 * kRadius - kThick / 2;  // lower side of the upper half, at rest
  EXPECT_LT(mean_of_layer(*world, 0, upper)[1], upper - 0.002);
  EXPECT_GT(mean_of_layer(*world, 0, upper)[1], kThick / 2);
}

/// A tool has pressed a node of the surface so deep that it is near the other side, or beyond. That side does not hold
/// it: the node comes back as it does in a body that does not touch itself.
TEST_P(Bodies, LetGoOfANodeThatCameFromWithin) {
  for (const bool double_precision : {true, false}) {
    for (const double left_m : {0.02, 0.002, -0.005}) {  // height of the node
      SCOPED_TRACE(left_m);
      v1::Scene scene = empty_scene(0.01);
      v1::Body& cube = add_cube(scene, "cube", Vec3<double>::Zero(), 4);
      cube.set_rayleigh_mass_per_s(5);
      cube.set_rayleigh_stiffness_s(0.01);
      set_layer(*cube.add_fixed(), 0);
      scene.mutable_solver()->set_precision(double_precision ? v1::Solver::PRECISION_DOUBLE
                                                             : v1::Solver::PRECISION_FLOAT);
      scene.mutable_solver()->set_cg_tolerance(1e-5);
      let_touch(scene, "cube", "", 0.001);
      const auto world = start(scene);
      ASSERT_TRUE(world->step(false));
      const model::Model& m = world->model();
      world::World::Saved saved = world->save();
      std::size_t pressed = 0;
      for (std::size_t row = 0; row < m.layout.row_count; ++row) {
        const Vec3<double> rest(m.rest[4 * row], m.rest[4 * row + 1], m.rest[4 * row + 2]);
        if ((rest - Vec3<double>(0.05, kSizeM, 0.05)).norm() < 1e-6) pressed = row;
      }
      saved.tissue.displacement[3 * m.layout.node_of_row[pressed] + 1] = left_m - kSizeM;
      world->take_over(saved);  // its energy counts from here
      std::uint32_t touching = 0;
      for (int i = 0; i < 300; ++i) {
        ASSERT_TRUE(world->step(false)) << i;
        touching = std::max(touching, world->last().touching_nodes);
      }
      EXPECT_NEAR(world->state().displacement[4 * pressed + 1], 0, 1e-4);
      EXPECT_EQ(world->last().touching_nodes, 0u);
      if (left_m > 0) {
        EXPECT_EQ(touching, 0u) << "a side that it comes to from within";
      }
    }
  }
}

/// A block hangs from another by a ligament: the ligament stretches by weight / stiffness, and tears at its force.
TEST_P(Bodies, HangFromAttachmentsThatTear) {
  constexpr double kStiffness = 2000, kWeightN = 9.81;  // a kilogram
  v1::Scene scene = empty_scene(1.0 / 60);
  v1::Body& upper = add_cube(scene, "upper", {0, 0.15, 0}, 3);
  v1::Body& lower = add_cube(scene, "lower", {0, 0, 0}, 3);
  tests::set(*upper.add_fixed()->mutable_box()->mutable_min_m(), -1, -1, -1);
  tests::set(*upper.mutable_fixed(0)->mutable_box()->mutable_max_m(), 1, 1, 1);
  lower.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(1e6);  // so that all springs are pulled alike
  lower.set_rayleigh_mass_per_s(10);
  v1::Attachment& ligament = *scene.add_attachments();
  ligament.set_name("ligament");
  ligament.set_body("lower");
  set_layer(*ligament.mutable_region(), kSizeM);
  ligament.set_other("upper");
  set_layer(*ligament.mutable_other_region(), 0.15);
  ligament.set_stiffness_n_per_m(kStiffness);
  ligament.set_breaking_force_n(2 * kWeightN);
  tests::set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  const auto world = start(scene);
  for (int i = 0; i < 300; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_NEAR(kSizeM - mean_of_layer(*world, 1, kSizeM)[1], kWeightN / kStiffness, 1e-3 * kWeightN / kStiffness);
  EXPECT_EQ(world->last().broken_springs, 0u);

  // As good as its force: 1.5 times the weight is too much for a ligament that tears at 1.2 times.
  scene.mutable_attachments(0)->set_breaking_force_n(0.8 * kWeightN);
  const auto torn = start(scene);
  for (int i = 0; i < 120; ++i) ASSERT_TRUE(torn->step(false));
  EXPECT_EQ(torn->last().broken_springs, 16u);
  EXPECT_LT(mean_of_layer(*torn, 1, kSizeM)[1], -1) << "it falls";
  torn->reset();
  ASSERT_TRUE(torn->step(false));
  EXPECT_EQ(torn->last().broken_springs, 0u) << "a reset mends it";
}

/// Newton's method finds the same rest as one linearized solve a step, in float as in double, but for what friction
/// keeps of the way there: a few percent of what the upper block sinks by.
TEST_P(Bodies, RestAlikeWithEverySolver) {
  std::vector<double> heights;
  for (const bool newton : {false, true}) {
    for (const bool is_double : {false, true}) {
      v1::Scene scene = empty_scene(1.0 / 60);
      set_layer(*add_cube(scene, "lower", {0, 0, 0}, 3).add_fixed(), 0);
      add_cube(scene, "upper", {0.02, kSizeM + 0.001, 0.03}, 3).set_rayleigh_mass_per_s(5);
      for (v1::Body& body : *scene.mutable_bodies()) {
        body.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(10 * kYoungPa);
      }
      let_touch(scene, "upper", "lower", 0.002).set_friction_coefficient(0.5);
      tests::set(*scene.mutable_gravity_m_per_s2(), 0, -2, 0);
      scene.mutable_solver()->set_precision(is_double ? v1::Solver::PRECISION_DOUBLE : v1::Solver::PRECISION_FLOAT);
      if (newton) scene.mutable_solver()->set_newton_max_iterations(5);
      if (newton) scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_BDF2);
      scene.mutable_solver()->set_cg_tolerance(is_double ? 1e-9 : 1e-5);
      const auto world = start(scene);
      for (int i = 0; i < 300; ++i) ASSERT_TRUE(world->step(false));
      heights.push_back(mean_of_layer(*world, 1, 2 * kSizeM + 0.001)[1]);
    }
  }
  const double sinks_m = 2 * kSizeM + 0.001 - heights.front();
  for (const double height : heights) EXPECT_NEAR(height, heights.front(), 0.07 * sinks_m);
}

TM_ON_EACH_BACKEND(Bodies);

/// Two blocks that overlap by a little, at random velocities: 3 patches, float64.
v1::Scene overlapping() {
  v1::Scene scene = empty_scene(0.01);
  set_layer(*add_cube(scene, "lower", {0, 0, 0}, 2).add_fixed(), 0);
  add_cube(scene, "upper", {0.01, kSizeM - 0.002, 0.02}, 3);
  let_touch(scene, "lower", "upper", 0.001).set_friction_coefficient(0.3);
  v1::Attachment& spring = *scene.add_attachments();
  spring.set_name("spring");
  spring.set_body("upper");
  set_layer(*spring.mutable_region(), 2 * kSizeM - 0.002);
  spring.set_other("lower");
  set_layer(*spring.mutable_other_region(), 0.05);
  spring.set_stiffness_n_per_m(100);
  return scene;
}

using tests::StagedScene;

/// Solves with links, and compares with the dense matrix of the same system: that of the tissue with its diagonal, and
/// the blocks of each link between its rows.
TEST(Links, SolveTheSystemWithTheirBlocksBetweenBodies) {
  for (const matrix::Storage storage : {matrix::Storage::kEdges, matrix::Storage::kRows}) {
    StagedScene<double> staged(overlapping(), 3, storage);
    staged.put(staged.view.state.velocity, tests::random_field(3 * staged.node_count(), 0.1, 5));
    // Springs that are stretched: the displacement pulls the bodies apart a little.
    staged.put(staged.view.state.displacement, tests::random_field(3 * staged.node_count(), 0.001, 6));
    staged.run_through(step::StageKind::kMeasureResidual);
    Eigen::MatrixXd a = staged.matrix();
    const Eigen::VectorXd b = staged.by_node(staged.view.matrix.rhs);
    const view::LinksView<double>& links = staged.view.links;
    int active = 0;
    for (std::uint32_t t = 0; t < links.count(); ++t) {
      const view::Link<double>& link = links.links[t];
      if (!(link.stiffness > 0)) continue;
      ++active;
      const Vec3<double> n(link.normal[0], link.normal[1], link.normal[2]);
      const Mat3<double> s =
          link.across * (Mat3<double>::Identity() - n * n.transpose()) + link.stiffness * n * n.transpose();
      for (int r = 0; r < 4; ++r) {
        for (int q = 0; q < 4; ++q) {
          if (q == r || link.weight[q] == 0 || link.weight[r] == 0) continue;
          a.block<3, 3>(3 * staged.model.layout.node_of_row[link.rows[r]],
                        3 * staged.model.layout.node_of_row[link.rows[q]]) +=
              1e-4 * link.weight[r] * link.weight[q] * s;  // h²
        }
      }
    }
    ASSERT_GT(active, 20);
    EXPECT_LT((a - a.transpose()).norm(), 1e-12 * a.norm());
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      if (!staged.is_fixed(node)) continue;
      a.middleRows<3>(3 * node).setZero();
      a.middleCols<3>(3 * node).setZero();
      a.block<3, 3>(3 * node, 3 * node).setIdentity();
    }
    Eigen::VectorXd free_b = b;
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      if (staged.is_fixed(node)) free_b.segment<3>(3 * node).setZero();
    }
    const Eigen::VectorXd expected = a.ldlt().solve(free_b);
    const Eigen::VectorXd before = staged.by_node(staged.view.state.velocity);
    for (const step::StageKind kind : {step::StageKind::kFactorize, step::StageKind::kScaleEdges,
                                       step::StageKind::kSolve, step::StageKind::kAdvance}) {
      staged.run(kind);
    }
    Eigen::VectorXd change = staged.by_node(staged.view.state.velocity) - before;
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      if (staged.is_fixed(node)) change.segment<3>(3 * node).setZero();
    }
    EXPECT_LT((change - expected).norm(), 1e-7 * expected.norm());
  }
}

/// The brute-force nearest triangle of every node is what the boxes find.
TEST(Links, FindTheNearestTriangle) {
  StagedScene<double> staged(overlapping(), 3);
  staged.put(staged.view.state.displacement, tests::random_field(3 * staged.node_count(), 0.004, 7));
  staged.run(step::StageKind::kBeginLinks);
  const auto& s = staged.view;
  int found = 0;
  for (std::uint32_t i = 0; i < s.links.candidate_count; ++i) {
    const std::uint32_t vertex = s.links.candidates[2 * i], row = s.contact.surface_rows[vertex];
    constexpr double kReach = 0.04;
    const auto nearest = nearest_points(s.state, s.contact, s.links, vertex,
                                        s.links.side_groups + 3 * s.links.candidates[2 * i + 1], kReach);
    const bool of_lower = staged.model.layout.node_of_row[row] < staged.model.bodies[1].node_begin;
    double best = kReach * kReach;
    std::uint32_t triangle = view::kNoTriangle;
    for (std::uint32_t t = 0; t < s.contact.triangle_count; ++t) {
      const std::uint32_t node = staged.model.layout.node_of_row[s.contact.triangle_rows[3 * t]];
      if ((node < staged.model.bodies[1].node_begin) == of_lower) continue;
      const auto corners = corners_of(s.state, s.contact, t);
      const Vec3<double> x = view::position(s.state, row);
      const auto closest = physics::closest_point_on_triangle(x, corners.x[0], corners.x[1], corners.x[2]);
      const double squared = (x - corners.at(closest.weights)).squaredNorm();
      if (squared < best) triangle = t, best = squared;
    }
    ASSERT_EQ(nearest.any.triangle == view::kNoTriangle, triangle == view::kNoTriangle);
    if (triangle == view::kNoTriangle) continue;
    ++found;
    EXPECT_NEAR(nearest.any.way.squaredNorm(), best, 1e-15);
  }
  EXPECT_GT(found, 30);
}

}  // namespace
}  // namespace tensormass::contact
