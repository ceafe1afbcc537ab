#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <utility>
#include <vector>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "support/backends.h"
#include "support/dense_system.h"

/// A probe pressed into tissue, step after step, through the whole of World.
namespace tensormass::contact {
namespace {

/// A hand that goes through a sheet of 10 × 10 cm, 2 mm thick and held at two edges.
struct Stab {
  double dt_s, hand_m_per_s, radius_m;
};

class Press : public tests::OnBackend {
 protected:
  double stab(const Stab& hand, bool limits_speed) const;
};

/// A deep block of linear tissue, 12 × 6 × 12 cm, with its bottom clamped. Elements grow from 0.6 mm at the point of
/// contact to centimetres at the rim.
v1::Scene half_space(double young_modulus_pa, double poisson_ratio) {
  mesh::Mesh mesh = mesh::make_grid({-1, -1, -1}, {2, 1, 2}, 20, 10, 20).value();
  for (Eigen::Vector3d& x : mesh.nodes) {
    for (double& c : x) c = 0.06 * (0.1 * c + 0.9 * std::copysign(std::pow(c, 4), c));
  }
  v1::Scene scene = tests::packed_scene(mesh, true);
  v1::IsotropicElastic& law = *scene.mutable_bodies(0)->mutable_law()->mutable_hooke();
  law.set_young_modulus_pa(young_modulus_pa);
  law.set_poisson_ratio(poisson_ratio);
  v1::Box& bottom = *scene.mutable_bodies(0)->add_fixed()->mutable_box();
  tests::set(*bottom.mutable_min_m(), -1, -1, -1);
  tests::set(*bottom.mutable_max_m(), 1, -0.0599, 1);
  scene.mutable_stepping()->set_dt_s(1);  // long enough that inertia does not matter
  scene.mutable_solver()->set_cg_max_iterations(2000);
  scene.mutable_solver()->set_cg_tolerance(1e-6);
  return scene;
}

/// Hertz: F = 4/3 E* √R d^1.5 on a half-space of linear tissue.
///
/// The tolerance is 18 % for two reasons. A triangle carries its whole area at the depth of its deepest point, and
/// linear tetrahedra are too stiff. Together they give 9 to 13 % too much with 4 to 6 elements across the contact
/// circle; 28 cells a side instead of 20 leave 2 % at 0.5 mm. The clamp at 6 cm and the compliance of the penalty add a
/// few percent of opposite signs.
TEST_P(Press, FollowsHertz) {
  constexpr double kYoungPa = 5e3, kPoisson = 0.3, kRadiusM = 0.01;
  v1::Scene scene = half_space(kYoungPa, kPoisson);
  tests::add_probe(scene, "probe", kRadiusM, 0, kRadiusM, 0);
  const auto world = start(scene);
  double before = 0;
  for (const double depth_m : {0.5e-3, 1e-3, 1.5e-3}) {
    world->set_tool_target(0, {{0, kRadiusM - depth_m, 0}, {1, 0, 0, 0}});
    for (int i = 0; i < 15; ++i) ASSERT_TRUE(world->step(false));
    const world::ToolReading& reading = world->readings()[0];
    const double hertz_n =
        4.0 / 3 * kYoungPa / (1 - kPoisson * kPoisson) * std::sqrt(kRadiusM) * std::pow(depth_m, 1.5);
    EXPECT_NEAR(reading.force_n[1], hertz_n, 0.18 * hertz_n) << "at a depth of " << depth_m << " m";
    EXPECT_LT(std::hypot(reading.force_n[0], reading.force_n[2]), 0.02 * hertz_n);
    EXPECT_GT(reading.force_n[1], before);
    before = reading.force_n[1];

    // The local model that a haptic client closes its loop on goes with the cube root of the force: 18 % become 6.
    const double tangent = 2 * kYoungPa / (1 - kPoisson * kPoisson) * std::sqrt(kRadiusM * depth_m);
    EXPECT_NEAR(reading.stiffness_n_per_m(1, 1), tangent, 0.06 * tangent);
    EXPECT_LT(reading.torque_n_m.norm(), 1e-9 * hertz_n * kRadiusM) << "frictionless: no torque about the centre";
  }
}

/// A block of soft tissue, 6 × 3 × 6 cm, fixed at its bottom, with a probe of 12 mm radius that touches its top.
v1::Scene soft_block(std::uint32_t cells) {
  v1::Scene scene = tests::beam_scene({.cells_x = cells,
                                       .cells_y = cells / 2,
                                       .cells_z = cells,
                                       .size_x_m = 0.06,
                                       .size_y_m = 0.03,
                                       .size_z_m = 0.06,
                                       .double_precision = true,
                                       .dt_s = 1.0 / 60,
                                       .cg_max_iterations = 1000,
                                       .cg_tolerance = 1e-8});
  v1::Body& body = *scene.mutable_bodies(0);
  v1::IsotropicElastic& law = *body.mutable_law()->mutable_stable_neo_hookean();
  law.set_young_modulus_pa(5e3);
  law.set_poisson_ratio(0.45);
  body.set_rayleigh_stiffness_s(0.01);
  v1::Box& bottom = *body.mutable_fixed(0)->mutable_box();
  tests::set(*bottom.mutable_min_m(), -1, -1, -1);
  tests::set(*bottom.mutable_max_m(), 1, 1e-6, 1);
  tests::add_probe(scene, "probe", 0.012, 0.031, 0.042, 0.029);
  scene.mutable_tools(0)->set_max_speed_m_per_s(1);
  return scene;
}

/// Soft tissue comes to rest under a tool that holds still. Without the stiffness of tilt (contact/tilt.h) the force
/// goes on changing by 14 % at 4 mm, and by 3 % at 6 mm.
TEST_P(Press, TissueComesToRestUnderAToolThatHoldsStill) {
  v1::Scene scene = soft_block(12);
  scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
  const auto world = start(scene);
  for (const double depth_m : {4e-3, 6e-3}) {
    world->set_tool_target(0, {{0.031, 0.042 - depth_m, 0.029}, {1, 0, 0, 0}});
    for (int i = 0; i < 120; ++i) ASSERT_TRUE(world->step(false));
    const Vec3<double> held_n = world->readings()[0].force_n;
    ASSERT_GT(held_n[1], 0.2);
    for (int i = 0; i < 20; ++i) {
      ASSERT_TRUE(world->step(false));
      EXPECT_LT((world->readings()[0].force_n - held_n).norm(), 1e-5 * held_n.norm()) << depth_m << " m, step " << i;
    }
  }
}

/// Newton's method converges in every step in which a probe is pressed into a block, by half a millimetre each time.
/// Without the stiffness of tilt it does not in one of these steps without friction, and in one with it.
TEST_P(Press, NewtonConvergesInEveryStep) {
  for (const double friction : {0.0, 0.3}) {
    v1::Scene scene = soft_block(9);
    scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_HEXAHEDRON);
    scene.mutable_bodies(0)->mutable_law()->mutable_neo_hookean()->set_young_modulus_pa(5e3);
    scene.mutable_bodies(0)->mutable_law()->mutable_neo_hookean()->set_poisson_ratio(0.45);
    scene.clear_gravity_m_per_s2();
    scene.mutable_tools(0)->set_friction_coefficient(friction);
    v1::Solver& solver = *scene.mutable_solver();
    solver.set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
    solver.set_newton_max_iterations(100);
    solver.set_newton_tolerance(1e-6);
    solver.set_allow_unconverged(true);
    const auto world = start(scene);
    for (int i = 1; i <= 16; ++i) {
      world->set_tool_target(0, {{0.031, 0.042 - 5e-4 * i, 0.029}, {1, 0, 0, 0}});
      ASSERT_TRUE(world->step(false));
      EXPECT_TRUE(world->last().converged)
          << "friction " << friction << ", step " << i << ", residual " << world->last().newton_residual;
    }
  }
}

/// With the augmented Lagrangian method the force does not depend on the penalty, and ends when the tool leaves.
TEST_P(Press, AKeptForceNeedsNoStiffPenalty) {
  const auto held_n = [&](v1::ContactMethod method, double penalty_pa_per_m) {
    v1::Scene scene = soft_block(9);
    v1::Tool& tool = *scene.mutable_tools(0);
    tool.set_contact_method(method);
    tool.mutable_spherical_probe()->set_penalty_stiffness_pa_per_m(penalty_pa_per_m);
    const auto world = start(scene);
    world->set_tool_target(0, {{0.031, 0.037, 0.029}, {1, 0, 0, 0}});
    for (int i = 0; i < 300; ++i) EXPECT_TRUE(world->step(false));
    const double held = world->readings()[0].force_n[1];
    world->set_tool_target(0, {{0.031, 0.044, 0.029}, {1, 0, 0, 0}});
    for (int i = 0; i < 60; ++i) EXPECT_TRUE(world->step(false));
    EXPECT_EQ(world->readings()[0].force_n, Vec3<double>(0, 0, 0)) << "nothing holds the tissue to the tool";
    return held;
  };
  const double soft = 2e6, stiff = 2e8;  // the default is 8e6
  const double exact = held_n(v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN, stiff);
  EXPECT_NEAR(held_n(v1::CONTACT_METHOD_AUGMENTED_LAGRANGIAN, soft), exact, 1e-3 * exact);
  EXPECT_LT(held_n(v1::CONTACT_METHOD_PENALTY, soft), 0.9 * exact);
}

/// The torque is about the tool's own origin: lever × force.
TEST_P(Press, TorqueIsAboutTheToolsPosition) {
  v1::Scene scene = tests::block_with_probe(true, 6);
  tests::set(*scene.mutable_tools(0)->mutable_spherical_probe()->mutable_tip_offset_m(), 0, 0, 0.1);
  // Turned by 90° about y, the offset along z points along x: the origin stands 0.1 m beside the sphere.
  const double h = std::sqrt(0.5);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05 - 0.1, 0.056, 0.05);
  v1::Quaternion& q = *scene.mutable_tools(0)->mutable_orientation();
  q.set_w(h);
  q.set_y(h);
  const auto world = start(scene);
  for (int i = 0; i < 30; ++i) ASSERT_TRUE(world->step(false));
  const world::ToolReading& reading = world->readings()[0];
  ASSERT_GT(reading.force_n[1], 0.05);
  const Vec3<double> expected = Vec3<double>(0.1, 0, 0).cross(reading.force_n);
  EXPECT_LT((reading.torque_n_m - expected).norm(), 1e-9 * expected.norm());
}

/// A tool that moved into the tissue faster than the tissue could follow is pushed out: the surface ends up outside of
/// the sphere.
TEST_P(Press, TissueClosesAroundAToolThatStartedInside) {
  v1::Scene scene = tests::block_with_probe(true, 8);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.05, 0.047, 0.05);  // centre 3 mm below the surface
  const auto world = start(scene);
  for (int i = 0; i < 100; ++i) ASSERT_TRUE(world->step(false));
  EXPECT_GT(world->readings()[0].force_n[1], 0.1);
  const auto positions = world->positions(world->model().bodies[0]);
  double lowest = 1;
  for (std::size_t i = 0; i < positions.size(); i += 3) {
    const Vec3<double> x(positions[i], positions[i + 1], positions[i + 2]);
    if (std::abs(world->model().rest[4 * world->model().layout.row_of_node[i / 3] + 1] - 0.05) > 1e-9) continue;
    lowest = std::min(lowest, (x - Vec3<double>(0.05, 0.047, 0.05)).norm());
  }
  EXPECT_GT(lowest, 0.007) << "no node of the top is deep inside the sphere";
}

/// Returns by how much the probe's centre stays above all nodes of the sheet near its axis [m]; negative: some are
/// above it. limits_speed: the scene leaves the tool's speed to the server.
double Press::stab(const Stab& hand, bool limits_speed) const {
  constexpr double kThicknessM = 0.002, kDeepM = -0.03, kNearM = 0.004;
  const mesh::Mesh mesh = mesh::make_grid({0, 0, 0}, {0.1, kThicknessM, 0.1}, 25, 1, 25).value();
  v1::Scene scene = tests::packed_scene(mesh, false);
  v1::Body& sheet = *scene.mutable_bodies(0);
  v1::IsotropicElastic& law = *sheet.mutable_law()->mutable_stable_neo_hookean();
  law.set_young_modulus_pa(2e4);
  law.set_poisson_ratio(0.45);
  sheet.set_rayleigh_mass_per_s(5);
  sheet.set_rayleigh_stiffness_s(0.005);
  for (const double edge_m : {0.0, 0.1}) {
    v1::Box& held = *sheet.add_fixed()->mutable_box();
    tests::set(*held.mutable_min_m(), edge_m - 1e-6, -1, -1);
    tests::set(*held.mutable_max_m(), edge_m + 1e-6, 1, 1);
  }
  scene.mutable_stepping()->set_dt_s(hand.dt_s);
  constexpr double kXM = 0.0507, kZM = 0.0493;  // above no node and no edge
  Vec3<double> tip_m(kXM, kThicknessM + hand.radius_m + 0.004, kZM);
  v1::Tool& probe = tests::add_probe(scene, "probe", hand.radius_m, tip_m[0], tip_m[1], tip_m[2]);
  if (!limits_speed) probe.set_max_speed_m_per_s(2);
  const auto world = start(scene);
  for (int i = 0; i < 1500; ++i) {
    tip_m[1] = std::max(kDeepM, tip_m[1] - hand.hand_m_per_s * hand.dt_s);
    world->set_tool_target(0, {tip_m, {1, 0, 0, 0}});
    if (!world->step(false)) throw std::runtime_error("a guard stopped the scene");
    if (world->readings()[0].pose.position_m[1] <= kDeepM) break;
  }
  double highest_m = -1;
  const std::vector<double> positions = world->positions(world->model().bodies[0]);
  for (std::size_t i = 0; i < positions.size(); i += 3) {
    if (std::hypot(positions[i] - kXM, positions[i + 2] - kZM) < kNearM) {
      highest_m = std::max(highest_m, positions[i + 1]);
    }
  }
  return world->readings()[0].pose.position_m[1] - highest_m;
}

TEST_P(Press, AFastToolDoesNotPassThroughAThinSheet) {
  for (const auto& [dt_s, hand_m_per_s] : {std::pair(1.0 / 60, 0.3), std::pair(1e-3, 1.0)}) {
    for (const double radius_m : {0.012, 0.006, 0.003}) {
      SCOPED_TRACE(testing::Message() << radius_m << " m at " << 1 / dt_s << " Hz");
      EXPECT_GT(stab({dt_s, hand_m_per_s, radius_m}, true), radius_m / 2);
    }
  }
}

/// The test above sees a tool that passes through: here one that may move by two radii in a step.
TEST_P(Press, AToolWithoutThatLimitPassesThrough) { EXPECT_LT(stab({1.0 / 60, 0.3, 0.003}, false), 0); }

TM_ON_EACH_BACKEND(Press);

}  // namespace
}  // namespace tensormass::contact
