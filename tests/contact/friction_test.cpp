#include "contact/friction.h"

#include <cmath>
#include <functional>
#include <vector>

#include <gtest/gtest.h>

#include "contact/staged_tool.h"
#include "support/backends.h"
#include "support/tools.h"

/// Coulomb friction: one contact against its formulas, and whole scenes against mechanics.
namespace tensormass::contact {
namespace {

using Pose = physics::Pose;

/// A tool that touches one triangle of a rigid block.
class OneContact : public testing::TestWithParam<std::string> {
 public:
  static constexpr double kPenalty = 4e6, kRadiusM = 0.05, kDepthM = 1e-3, kFriction = 0.5;
  static constexpr double kStiffness = kPenalty * 0.5;  // a triangle has half the area of the top

  static v1::Scene scene(const std::string& kind) {
    v1::Scene scene = tests::rigid_block(kind, kPenalty);
    scene.mutable_tools(0)->set_friction_coefficient(kFriction);
    return scene;
  }

 protected:
  /// Steps while the tool moves from where it was.
  backend::ToolForce step_to(const Pose& pose) {
    place(staged_, pose, pose_);
    pose_ = pose;
    staged_.step();
    return measured(staged_);
  }
  /// Steps while it moves to a point above the block, `x` along it.
  backend::ToolForce step_to(double x, double depth_m = kDepthM) {
    Pose pose = pose_;
    pose.position_m = {0.3 + x, 1 + kRadiusM - depth_m, 0.7};
    return step_to(pose);
  }

  tests::StagedScene<double> staged_{scene(GetParam())};
  Pose pose_ = [this] {
    Pose above = staged_.model.tools[0].initial_pose;
    above.position_m = {0.3, 5, 0.7};
    return above;
  }();
};

TEST_P(OneContact, IsASpringUpToTheConeAndThenSlides) {
  const double normal_n = kStiffness * kDepthM, slides_at_m = kFriction * kDepthM;
  step_to(0);
  step_to(0);  // friction knows the normal force of the step before
  const auto expect = [&](double x, double stretch_m) {
    const backend::ToolForce force = step_to(x);
    EXPECT_NEAR(force.friction_n[0], -kStiffness * stretch_m, 1e-9 * normal_n) << "at " << x;
    EXPECT_NEAR(force.friction_n.tail<2>().norm(), 0, 1e-9 * normal_n) << "at " << x;
    EXPECT_NEAR((force.force_n - force.friction_n - Vec3<double>(0, normal_n, 0)).norm(), 0, 1e-9 * normal_n);
    // About the tool's origin, from the contact point a radius below it.
    EXPECT_NEAR(force.torque_n_m[2], -(kRadiusM - kDepthM) * kStiffness * stretch_m, 1e-9 * normal_n);
  };
  expect(0.4 * slides_at_m, 0.4 * slides_at_m);
  expect(0.8 * slides_at_m, 0.8 * slides_at_m);
  expect(0.8 * slides_at_m, 0.8 * slides_at_m);  // it holds
  expect(1.5 * slides_at_m, slides_at_m);
  expect(9 * slides_at_m, slides_at_m);
  expect(8.5 * slides_at_m, 0.5 * slides_at_m);  // back: it sticks again
  expect(6 * slides_at_m, -slides_at_m);
}

TEST_P(OneContact, IsForgottenWhenTheToolLeaves) {
  step_to(0);
  step_to(0);
  ASSERT_LT(step_to(1e-4).friction_n[0], 0);
  step_to(1e-4, -1e-3);
  step_to(1e-4);
  EXPECT_LT(step_to(1e-4).friction_n.norm(), 1e-9);
}

/// The stretch belongs to the tool: it turns with it about the normal.
TEST_P(OneContact, StretchTurnsWithTheTool) {
  step_to(0);
  step_to(0);
  const double held_n = step_to(1e-4).friction_n[0];
  ASSERT_LT(held_n, 0);
  const Eigen::Quaterniond quarter(Eigen::AngleAxisd(M_PI / 2, Vec3<double>::UnitY()));
  const Eigen::Quaterniond turned = quarter * physics::rotation(pose_);
  const backend::ToolForce force =
      step_to({pose_.position_m, {turned.w(), turned.x(), turned.y(), turned.z()}, pose_.joint_values});
  EXPECT_NEAR(force.friction_n[2], -held_n, 1e-6 * std::abs(held_n));  // x turns to −z about y
}

INSTANTIATE_TEST_SUITE_P(Tools, OneContact, testing::ValuesIn(tests::thin_tool_kinds()));

/// Whole scenes.
class Friction : public tests::OnBackend {
 protected:
  static constexpr double kFriction = 0.3;

  static double share(const world::ToolReading& reading) {
    return reading.friction_n.norm() / (reading.force_n - reading.friction_n).norm();
  }
  static void set_friction(v1::Scene& scene, double coefficient) {
    scene.mutable_tools(0)->set_friction_coefficient(coefficient);
  }
};

/// A large ball drawn over a block slides with μ times the normal force. Its surface is nearly flat where it touches,
/// so that the friction of all triangles has nearly one direction.
TEST_P(Friction, ABallDrawnOverTissueFeelsMuTimesTheNormalForce) {
  struct Scheme {
    const char* name;
    std::function<void(v1::Solver&)> set;
    double most_off;  // error of a step. Without Newton the force that the tissue received is the secant's.
  };
  const std::vector<Scheme> schemes{
      {"implicit Euler", [](v1::Solver&) {}, 0.04},
      {"BDF2", [](v1::Solver& s) { s.set_integrator(v1::Solver::INTEGRATOR_BDF2); }, 0.04},
      {"Newton", [](v1::Solver& s) { s.set_newton_max_iterations(20); }, 0.003},
  };
  for (const auto& [name, set, most_off] : schemes) {
    v1::Scene scene = tests::block_with_probe(true, 8);
    scene.mutable_bodies(0)->set_rayleigh_mass_per_s(20);
    scene.mutable_tools(0)->mutable_spherical_probe()->set_radius_m(0.06);
    scene.mutable_tools(0)->mutable_position_m()->set_y(0.12);
    set_friction(scene, kFriction);
    set(*scene.mutable_solver());
    const auto world = start(scene);
    world->set_tool_target(0, {{0.04, 0.107, 0.05}, {1, 0, 0, 0}});
    for (int i = 0; i < 40; ++i) ASSERT_TRUE(world->step(false)) << name;
    double mean = 0;
    for (int i = 1; i <= 50; ++i) {  // 40 mm/s
      world->set_tool_target(0, {{0.04 + 4e-4 * i, 0.107, 0.05}, {1, 0, 0, 0}});
      ASSERT_TRUE(world->step(false)) << name;
      ASSERT_TRUE(world->last().converged) << name << ", step " << i;
      if (i <= 30) continue;
      const world::ToolReading& reading = world->readings()[0];
      mean += share(reading) / 20;
      EXPECT_NEAR(share(reading), kFriction, most_off * kFriction) << name << ", step " << i;
      EXPECT_LT(reading.friction_n[0], -0.98 * reading.friction_n.norm()) << "against the motion";
    }
    EXPECT_NEAR(mean, kFriction, 0.02 * kFriction) << name;
  }
}

/// The midpoint rule solves for the middle of a step, but contact and its friction are those of the end.
TEST_P(Friction, TheMidpointRuleStretchesTheSpringByTheWholeStep) {
  v1::Scene scene = OneContact::scene("spherical_probe");
  scene.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0.3, 1.05 - OneContact::kDepthM, 0.7);
  const auto world = start(scene);
  const auto step_at = [&](double x) {
    world->set_tool_target(0, {{x, 1.05 - OneContact::kDepthM, 0.7}, {1, 0, 0, 0}});
    ASSERT_TRUE(world->step(false));
  };
  for (int i = 0; i < 3; ++i) step_at(0.3);
  constexpr double kMovedM = 1e-4;
  step_at(0.3 + kMovedM);
  EXPECT_NEAR(world->readings()[0].friction_n[0], -OneContact::kStiffness * kMovedM, 4);
  step_at(0.3 + kMovedM);
  EXPECT_NEAR(world->readings()[0].friction_n[0], -OneContact::kStiffness * kMovedM, 4) << "2 %: its normal has turned";
}

/// A tool that sticks does not creep, and draws the tissue along.
TEST_P(Friction, HoldsWithoutCreep) {
  v1::Scene scene = tests::block_with_probe(true, 6);
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(20);
  set_friction(scene, 1);
  const auto world = start(scene);
  const auto step_at = [&](double x, double y) {
    world->set_tool_target(0, {{x, y, 0.05}, {1, 0, 0, 0}});
    ASSERT_TRUE(world->step(false));
  };
  for (int i = 1; i <= 40; ++i) step_at(0.05, 0.06 - 1e-4 * i);
  for (int i = 1; i <= 20; ++i) step_at(0.05 + 2.5e-5 * i, 0.056);
  for (int i = 0; i < 100; ++i) step_at(0.0505, 0.056);
  const double held_n = world->readings()[0].friction_n[0];
  EXPECT_LT(held_n, -0.05 * world->readings()[0].force_n[1]);
  EXPECT_LT(share(world->readings()[0]), 0.9);
  for (int i = 0; i < 1000; ++i) step_at(0.0505, 0.056);
  EXPECT_NEAR(world->readings()[0].friction_n[0], held_n, 1e-3 * std::abs(held_n));
}

/// A block on an incline: a ball of 100 m radius under it, and gravity tilted against it. It rests if μ is larger than
/// the slope; else it slides with g (sin θ − μ cos θ).
TEST_P(Friction, ABlockOnAnInclineRestsOrSlides) {
  constexpr double kSlope = 0.25, kGravity = 9.81;
  const double angle = std::atan(kSlope);
  for (const double coefficient : {0.15, 0.4}) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 2,
                                         .cells_z = 4,
                                         .size_x_m = 0.04,
                                         .size_y_m = 0.02,
                                         .size_z_m = 0.04,
                                         .double_precision = true,
                                         .young_modulus_pa = 1e5,
                                         .poisson_ratio = 0.3,
                                         .dt_s = 0.002,
                                         .cg_max_iterations = 500,
                                         .cg_tolerance = 1e-10});
    scene.mutable_bodies(0)->clear_fixed();
    scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0.002);
    tests::set(*scene.mutable_gravity_m_per_s2(), kGravity * std::sin(angle), -kGravity * std::cos(angle), 0);
    v1::Tool& ground = tests::add_probe(scene, "ground", 100, 0.02, -100, 0.02);
    ground.mutable_spherical_probe()->set_penalty_stiffness_pa_per_m(1e7);
    ground.set_friction_coefficient(coefficient);
    const auto world = start(scene);
    const auto state = [&] {
      const backend::RowState now = world->state();
      const auto& mass = world->model().row_mass;
      double x = 0, v = 0, all = 0;
      for (std::size_t row = 0; row < mass.size(); ++row) {
        x += mass[row] * now.displacement[4 * row];
        v += mass[row] * now.velocity[4 * row];
        all += mass[row];
      }
      return std::pair(x / all, v / all);
    };
    for (int i = 0; i < 300; ++i) ASSERT_TRUE(world->step(false));
    const auto [x0, v0] = state();
    for (int i = 0; i < 100; ++i) ASSERT_TRUE(world->step(false));
    const auto [x1, v1] = state();
    if (coefficient > kSlope) {
      // The deepest point of a triangle on a thin tool jumps, and its friction with it. On a solid nothing moves.
      EXPECT_LT(std::abs(x1 - x0), 5e-6) << "rests";
    } else {
      const double acceleration = kGravity * (std::sin(angle) - coefficient * std::cos(angle));
      EXPECT_NEAR((v1 - v0) / 0.2, acceleration, 0.03 * acceleration) << "slides";
    }
  }
}

/// A ball that spins on tissue feels a torque against its turn. The forces along the surface nearly cancel, as the mesh
/// is nearly symmetric.
TEST_P(Friction, ABallThatSpinsFeelsTorque) {
  v1::Scene scene = tests::block_with_probe(true, 14);
  set_friction(scene, kFriction);
  const auto world = start(scene);
  for (int i = 0; i < 60; ++i) {
    const double angle = 0.05 * i;
    world->set_tool_target(0, {{0.05, 0.053, 0.05}, {std::cos(angle / 2), 0, std::sin(angle / 2), 0}});
    ASSERT_TRUE(world->step(false));
  }
  const world::ToolReading& reading = world->readings()[0];
  EXPECT_LT(reading.torque_n_m[1], -kFriction * reading.force_n[1] * 0.001) << "an arm of some millimetres";
  EXPECT_LT(std::hypot(reading.friction_n[0], reading.friction_n[2]), 0.5 * kFriction * reading.force_n[1]);
}

TM_ON_EACH_BACKEND(Friction);

}  // namespace
}  // namespace tensormass::contact
