#include "world/world.h"

#include <cmath>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "mesh/surface.h"
#include "support/backends.h"
#include "support/dense_system.h"
#include "support/tools.h"

/// Whole steps compared with analytical mechanics.
namespace tensormass::world {
namespace {

class Mechanics : public tests::OnBackend {
 protected:
  static Eigen::MatrixX3d positions(World& world, std::size_t body = 0) {
    const std::vector<double> flat = world.positions(world.model().bodies[body]);
    return Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>>(
        flat.data(), static_cast<Eigen::Index>(flat.size() / 3), 3);
  }
  void run(World& world, int steps) {
    for (int i = 0; i < steps; ++i)
      ASSERT_TRUE(world.step(false)) << (world.guard_event() != nullptr ? to_text(*world.guard_event(), world.model())
                                                                        : "")
                                     << ", step " << i;
  }
};

/// A free body falls as implicit Euler says: v_n = n g dt, u_n = g dt² n (n + 1) / 2.
TEST_P(Mechanics, FreeFallIsExact) {
  for (const bool linear : {true, false}) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 2,
                                         .cells_z = 2,
                                         .linear = linear,
                                         .double_precision = true,
                                         .cg_max_iterations = 500,
                                         .cg_tolerance = 1e-14});
    scene.mutable_bodies(0)->clear_fixed();
    const auto world = start(scene);
    const Eigen::MatrixX3d rest = positions(*world);
    constexpr int kSteps = 25;
    run(*world, kSteps);
    const double dt = 0.01, fall = -9.81 * dt * dt * kSteps * (kSteps + 1) / 2;
    const Eigen::MatrixX3d moved = positions(*world) - rest;
    EXPECT_LT((moved.col(1).array() - fall).abs().maxCoeff(), 1e-10 * std::abs(fall));
    EXPECT_LT(moved.col(0).cwiseAbs().maxCoeff() + moved.col(2).cwiseAbs().maxCoeff(), 1e-10 * std::abs(fall));
    EXPECT_NEAR(world->simulated_time_s(), kSteps * dt, 1e-12);
    EXPECT_NEAR(world->last().max_speed_m_per_s, 9.81 * dt * kSteps, 1e-9);
  }
}

TEST_P(Mechanics, AStoppedSceneMakesNoStep) {
  for (const std::uint32_t iterations : {1u, 20u}) {
    v1::Scene scene = tests::beam_scene();
    scene.mutable_solver()->set_newton_max_iterations(iterations);
    const auto world = start(scene);
    ASSERT_TRUE(world->step(false));
    world->stop();
    EXPECT_THROW(world->step(false), backend::StepStopped);
  }
}

/// Without loads, element forces are rounding errors, and Newton's method must not try to reduce them. Every step
/// converges and the body keeps its velocity.
TEST_P(Mechanics, NewtonsMethodLetsAFreeBodyFly) {
  for (const bool double_precision : {false, true}) {
    for (const v1::Shape shape : {v1::SHAPE_TETRAHEDRON, v1::SHAPE_HEXAHEDRON}) {
      v1::Scene scene = tests::beam_scene(
          {.cells_x = 3, .cells_y = 2, .cells_z = 2, .double_precision = double_precision, .dt_s = 1e-3});
      v1::Body& body = *scene.mutable_bodies(0);
      body.mutable_mesh()->mutable_grid()->set_shape(shape);
      body.clear_fixed();
      scene.clear_gravity_m_per_s2();
      scene.mutable_solver()->set_newton_max_iterations(20);
      scene.mutable_solver()->set_newton_tolerance(1e-6);
      const Eigen::RowVector3d velocity(0.3, 0.2, 0.1);
      const Eigen::MatrixX3d rest = positions(*start(scene));
      const Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor> all = velocity.replicate(rest.rows(), 1);
      body.set_initial_velocity_m_per_s(std::string(reinterpret_cast<const char*>(all.data()),
                                                    sizeof(double) * static_cast<std::size_t>(all.size())));
      const auto world = start(scene);
      constexpr int kSteps = 300;
      for (int i = 0; i < kSteps; ++i) {
        ASSERT_TRUE(world->step(false)) << i;
        ASSERT_EQ(world->guard_event(), nullptr) << to_text(*world->guard_event(), world->model());
        ASSERT_TRUE(world->last().converged) << i << " " << world->last().newton_residual;
      }
      const Eigen::RowVector3d moved = kSteps * 1e-3 * velocity;
      EXPECT_LT(((positions(*world) - rest).rowwise() - moved).cwiseAbs().maxCoeff(), double_precision ? 1e-12 : 2e-5);
    }
  }
}

/// A body that turns, or flies into a tool, meets forces that only appear after inertia has moved it. The first solve
/// starts without a residual, and Newton's method must not stop there.
TEST_P(Mechanics, NewtonsMethodFollowsABodyThatTurns) {
  for (const bool double_precision : {false, true}) {
    v1::Scene scene = tests::beam_scene(
        {.cells_x = 3, .cells_y = 2, .cells_z = 2, .double_precision = double_precision, .dt_s = 1.0 / 60});
    v1::Body& body = *scene.mutable_bodies(0);
    body.clear_fixed();
    scene.clear_gravity_m_per_s2();
    scene.mutable_solver()->set_newton_max_iterations(30);
    scene.mutable_solver()->set_newton_tolerance(1e-4);
    const Eigen::MatrixX3d rest = positions(*start(scene));
    const Eigen::RowVector3d centre = rest.colwise().mean();
    Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor> spin(rest.rows(), 3);
    for (Eigen::Index i = 0; i < rest.rows(); ++i) {
      spin.row(i) = Eigen::Vector3d(0, 0, 20).cross((rest.row(i) - centre).transpose()).transpose();
    }
    body.set_initial_velocity_m_per_s(std::string(reinterpret_cast<const char*>(spin.data()),
                                                  sizeof(double) * static_cast<std::size_t>(spin.size())));
    const auto world = start(scene);
    const auto energy_j = [&] {
      world->diagnose();
      return world->diagnostics()[0].elastic_energy_j + world->last().kinetic_energy_j;
    };
    ASSERT_TRUE(world->step(false));
    EXPECT_TRUE(world->last().converged);
    EXPECT_LE(world->last().newton_residual, 1e-4);
    EXPECT_GT(world->last().newton_iterations, 1u);
    const double first_j = energy_j();
    for (int i = 0; i < 5; ++i) ASSERT_TRUE(world->step(false));
    EXPECT_LE(energy_j(), first_j * 1.001) << "implicit Euler only loses energy";
  }
}

/// The α of Rayleigh's damping slows a free fall: v₁ = (v₀ + g dt) / (1 + α dt).
TEST_P(Mechanics, MassDampingSlowsTheFall) {
  v1::Scene scene = tests::beam_scene({.cells_x = 2,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .double_precision = true,
                                       .cg_max_iterations = 500,
                                       .cg_tolerance = 1e-14});
  scene.mutable_bodies(0)->clear_fixed();
  scene.mutable_bodies(0)->set_rayleigh_mass_per_s(3);
  const auto world = start(scene);
  double v = 0;
  for (int i = 0; i < 40; ++i) {
    ASSERT_TRUE(world->step(false));
    v = (v + 9.81 * 0.01) / (1 + 3 * 0.01);
    EXPECT_NEAR(world->last().max_speed_m_per_s, v, 1e-10);
  }
}

/// A free body pulled apart by opposite loads keeps its centre of mass where it is.
TEST_P(Mechanics, InnerForcesKeepTheCentreOfMass) {
  v1::Scene scene = tests::beam_scene({.cells_x = 6,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .double_precision = true,
                                       .cg_max_iterations = 500,
                                       .cg_tolerance = 1e-13});
  scene.clear_gravity_m_per_s2();
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  for (const double end : {0.0, 8.0}) {
    v1::Load& load = *body.add_loads();
    v1::Box& box = *load.mutable_region()->mutable_box();
    tests::set(*box.mutable_min_m(), end - 0.1, -1, -1);
    tests::set(*box.mutable_max_m(), end + 0.1, 2, 2);
    tests::set(*load.mutable_force_n(), end == 0 ? -2e4 : 2e4, 0, 0);
  }
  const auto world = start(scene);
  const Eigen::MatrixX3d rest = positions(*world);
  run(*world, 50);
  const Eigen::MatrixX3d now = positions(*world);
  Eigen::VectorXd mass(rest.rows());
  for (Eigen::Index node = 0; node < rest.rows(); ++node) {
    mass[node] = world->model().inertia[4 * std::size_t{world->model().layout.row_of_node[node]}];
  }
  EXPECT_GT((now - rest).rowwise().norm().maxCoeff(), 0.05) << "it is pulled apart";
  EXPECT_LT((mass.transpose() * (now - rest)).norm() / mass.sum(), 1e-10);
}

/// A slender cantilever under an end load: w = F L³ / (3 E I) (1 + what shear adds), Timoshenko's beam.
///
/// Linear tetrahedra in bending are too stiff: with 10 cells of the Kuhn cut over the height the tip stays 3 to 6 %
/// short; ν = 0, so that the clamp adds no stiffness of its own.
TEST_P(Mechanics, CantileverBendsAsABeam) {
  constexpr double kLength = 1, kHeight = 0.1, kYoungPa = 1e6, kForceN = 0.02;
  v1::Scene scene = tests::beam_scene({.cells_x = 60,
                                       .cells_y = 10,
                                       .cells_z = 6,
                                       .size_x_m = kLength,
                                       .size_y_m = kHeight,
                                       .size_z_m = kHeight,
                                       .linear = true,
                                       .double_precision = true,
                                       .young_modulus_pa = kYoungPa,
                                       .poisson_ratio = 0,
                                       .dt_s = 10,
                                       .cg_max_iterations = 20'000,
                                       .cg_tolerance = 1e-7});
  scene.clear_gravity_m_per_s2();
  v1::Load& load = *scene.mutable_bodies(0)->add_loads();
  v1::Box& end = *load.mutable_region()->mutable_box();
  tests::set(*end.mutable_min_m(), kLength - 1e-6, -1, -1);
  tests::set(*end.mutable_max_m(), kLength + 1e-6, 1, 1);
  tests::set(*load.mutable_force_n(), 0, -kForceN, 0);
  const auto world = start(scene);
  const Eigen::MatrixX3d rest = positions(*world);
  run(*world, 3);  // steps far longer than the beam's period: it stands still after two
  const Eigen::MatrixX3d moved = positions(*world) - rest;
  double tip = 0;
  int count = 0;
  for (Eigen::Index node = 0; node < rest.rows(); ++node) {
    if (rest(node, 0) < kLength - 1e-6) continue;
    tip += moved(node, 1);
    ++count;
  }
  tip /= count;
  const double inertia = std::pow(kHeight, 4) / 12, area = kHeight * kHeight, shear_modulus = kYoungPa / 2;
  const double beam =
      kForceN * std::pow(kLength, 3) / (3 * kYoungPa * inertia) + kForceN * kLength / (5.0 / 6 * area * shear_modulus);
  EXPECT_LT(-tip, beam) << "displacement elements bend too little, never too much";
  EXPECT_GT(-tip, 0.93 * beam);
}

/// A bar of one element row pulled at its end: u = F L / (E A), exactly, for ν = 0.
TEST_P(Mechanics, BarStretchesByHooke) {
  v1::Scene scene = tests::beam_scene({.cells_x = 6,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .size_x_m = 1,
                                       .size_y_m = 0.2,
                                       .size_z_m = 0.2,
                                       .linear = true,
                                       .double_precision = true,
                                       .young_modulus_pa = 1e5,
                                       .poisson_ratio = 0,
                                       .dt_s = 10,
                                       .cg_max_iterations = 5000,
                                       .cg_tolerance = 1e-12});
  scene.clear_gravity_m_per_s2();
  // A uniform traction on the end: each node's share of its area.
  const auto add = [&](double x, double y, double z, double force) {
    v1::Load& load = *scene.mutable_bodies(0)->add_loads();
    v1::Sphere& at = *load.mutable_region()->mutable_sphere();
    tests::set(*at.mutable_center_m(), x, y, z);
    at.set_radius_m(1e-6);
    tests::set(*load.mutable_force_n(), force, 0, 0);
  };
  // The Kuhn cut meets each face along one diagonal: a node's share is a third of the triangles about it.
  const mesh::Mesh grid = mesh::make_grid({0, 0, 0}, {1, 0.2, 0.2}, 6, 2, 2).value();
  const mesh::Surface surface = mesh::boundary(grid);
  for (const mesh::Triangle& triangle : surface.triangles) {
    Vec3<double> x[3];
    for (std::size_t c = 0; c < 3; ++c) x[c] = grid.nodes[surface.nodes[triangle[c]]];
    if (std::min({x[0][0], x[1][0], x[2][0]}) < 1 - 1e-9) continue;
    const double area = (x[1] - x[0]).cross(x[2] - x[0]).norm() / 2;
    for (const Vec3<double>& corner : x) add(corner[0], corner[1], corner[2], 1e3 * area / 3);
  }
  const auto world = start(scene);
  const Eigen::MatrixX3d rest = positions(*world);
  run(*world, 4);
  const Eigen::MatrixX3d moved = positions(*world) - rest;
  for (Eigen::Index node = 0; node < rest.rows(); ++node) {
    EXPECT_NEAR(moved(node, 0), 1e3 / 1e5 * rest(node, 0), 1e-6) << "strain σ / E at " << rest.row(node);
    EXPECT_NEAR(moved.row(node).tail<2>().norm(), 0, 1e-6);
  }
}

TEST_P(Mechanics, ResetIsBackToRest) {
  v1::Scene scene = tests::block_with_probe(true, 4);
  const auto world = start(scene);
  const Eigen::MatrixX3d rest = positions(*world);
  const std::vector<float> visible(world->visible_positions().begin(), world->visible_positions().end());
  world->set_tool_target(0, {{0.05, 0.045, 0.05}, {1, 0, 0, 0}});
  run(*world, 10);
  const Eigen::MatrixX3d first = positions(*world);
  const Vec3<double> first_force = world->readings()[0].force_n;
  ASSERT_GT((first - rest).norm(), 1e-4);

  world->reset();
  EXPECT_EQ(positions(*world), rest);
  EXPECT_TRUE(std::equal(visible.begin(), visible.end(), world->visible_positions().begin()));
  EXPECT_EQ(world->step_count(), 0u);
  EXPECT_EQ(world->readings()[0].force_n.norm(), 0);
  EXPECT_EQ(world->readings()[0].pose.position_m, Vec3<double>(0.05, 0.07, 0.05));

  world->set_tool_target(0, {{0.05, 0.045, 0.05}, {1, 0, 0, 0}});
  run(*world, 10);
  EXPECT_EQ(positions(*world), first) << "and the same again, bit by bit";
  EXPECT_EQ(world->readings()[0].force_n, first_force);
}

/// A body starts with the displacements and velocities of its scene, and a reset restores them.
TEST_P(Mechanics, StartsWithTheInitialStateOfTheScene) {
  v1::Scene scene = tests::beam_scene({.cells_x = 2,
                                       .cells_y = 1,
                                       .cells_z = 1,
                                       .double_precision = true,
                                       .cg_max_iterations = 500,
                                       .cg_tolerance = 1e-14});
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  const auto rest = positions(*start(scene));
  const Eigen::RowVector3d moved(0.5, -0.25, 2), velocity(1, 2, 3);
  const auto bytes = [&](const Eigen::RowVector3d& row) {
    const Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor> all = row.replicate(rest.rows(), 1);
    return std::string(reinterpret_cast<const char*>(all.data()),
                       sizeof(double) * static_cast<std::size_t>(all.size()));
  };
  scene.clear_gravity_m_per_s2();
  body.set_initial_displacement_m(bytes(moved));
  body.set_initial_velocity_m_per_s(bytes(velocity));
  for (const auto integrator : {v1::Solver::INTEGRATOR_IMPLICIT_EULER, v1::Solver::INTEGRATOR_BDF2}) {
    scene.mutable_solver()->set_integrator(integrator);
    const auto world = start(scene);
    for (const bool again : {false, true}) {
      if (again) world->reset();
      EXPECT_LT(((positions(*world) - rest).rowwise() - moved).cwiseAbs().maxCoeff(), 1e-15);
      run(*world, 10);
      EXPECT_LT(((positions(*world) - rest).rowwise() - (moved + 0.1 * velocity)).cwiseAbs().maxCoeff(), 1e-12);
    }
  }
}

TEST_P(Mechanics, ToolsFollowTheirTargetsAtTheMaximumSpeed) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.mutable_tools(0)->set_max_speed_m_per_s(0.4);
  const auto world = start(scene);
  const double reach = 0.4 * 0.01;
  const Vec3<double> begin(0.05, 0.07, 0.05), end = begin + Vec3<double>(0.03, 0.04, 0).normalized() * 2.5 * reach;
  world->set_tool_target(0, {end, {1, 0, 0, 0}});
  for (const double steps : {1.0, 2.0, 2.5, 2.5}) {
    ASSERT_TRUE(world->step(false));
    const Vec3<double> expected = begin + (end - begin).normalized() * steps * reach;
    EXPECT_LT((world->readings()[0].pose.position_m - expected).norm(), 1e-12);
  }
}

/// A tool whose pose expires lets go of the tissue. With its next pose it takes hold again, there and gently.
TEST_P(Mechanics, AToolWithoutNewPosesIsRetired) {
  const auto world = start(tests::block_with_probe(true, 4));  // in steps of 0.01 s
  run(*world, 200);
  const Eigen::MatrixX3d rest = positions(*world);  // sunk under its weight
  const Pose pressed{{0.05, 0.045, 0.05}, {1, 0, 0, 0}};
  const auto force_n = [&] { return world->readings()[0].force_n.norm(); };
  world->set_tool_target(0, pressed, {}, 0.3);
  run(*world, 30);
  const double held_n = force_n();
  ASSERT_GT(held_n, 0);
  EXPECT_FALSE(world->readings()[0].retired);
  EXPECT_TRUE(world->readings()[0].touching);

  for (int step = 1; step <= 10; ++step) {
    const double before_n = force_n();
    run(*world, 1);
    EXPECT_LT(force_n(), before_n) << "it fades";
  }
  EXPECT_TRUE(world->readings()[0].retired);
  EXPECT_FALSE(world->readings()[0].touching);
  EXPECT_EQ(force_n(), 0);
  EXPECT_EQ(world->readings()[0].pose.position_m, pressed.position_m);
  const double dent_m = (positions(*world) - rest).norm();
  run(*world, 100);
  EXPECT_LT((positions(*world) - rest).norm(), 0.2 * dent_m) << "the tissue is free";

  const Pose beside{{0.06, 0.045, 0.05}, {1, 0, 0, 0}};
  world->set_tool_target(0, beside);
  run(*world, 1);
  EXPECT_FALSE(world->readings()[0].retired);
  EXPECT_EQ(world->readings()[0].pose.position_m, beside.position_m) << "a tool that touches nothing may jump";
  EXPECT_LT(force_n(), 0.2 * held_n);
  run(*world, 100);
  EXPECT_NEAR(force_n(), held_n, 0.2 * held_n);

  world->set_tool_target(0, beside, {}, 0.02);
  run(*world, 50);
  ASSERT_TRUE(world->readings()[0].retired);
  world->reset();
  run(*world, 1);
  EXPECT_FALSE(world->readings()[0].retired);
}

/// A long tool that turns moves its tip fast. The limit holds for the sphere at the tip, which still reaches its
/// target.
TEST_P(Mechanics, RotationMovesTheSphereNoFasterThanTheMaximumSpeed) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  tests::set(*scene.mutable_tools(0)->mutable_spherical_probe()->mutable_tip_offset_m(), 0, 0.2, 0);
  tests::set(*scene.mutable_tools(0)->mutable_position_m(), 0, 1, 0);
  const auto world = start(scene);
  const double h = std::sqrt(0.5);
  const Pose target{{0, 1, 0}, {h, h, 0, 0}};  // a quarter turn about x: the tip goes from +y to +z
  world->set_tool_target(0, target);
  const auto tip = [&] {
    const Pose& pose = world->readings()[0].pose;
    const Eigen::Quaterniond q(pose.orientation[0], pose.orientation[1], pose.orientation[2], pose.orientation[3]);
    return Vec3<double>(pose.position_m + q * Vec3<double>(0, 0.2, 0));
  };
  Vec3<double> before = tip();
  for (int i = 0; i < 200; ++i) {
    ASSERT_TRUE(world->step(false));
    EXPECT_LE((tip() - before).norm(), 0.5 * 0.01 * (1 + 1e-9));
    before = tip();
  }
  EXPECT_LT((before - Vec3<double>(0, 1, 0.2)).norm(), 1e-12);
}

/// The tip of a capsule stays where it is while the shaft turns: the limit then holds for the far end.
TEST_P(Mechanics, RotationMovesTheEndOfACapsuleNoFasterThanTheMaximumSpeed) {
  v1::Scene scene = tests::block_with_probe(false, 4);
  scene.clear_tools();
  tests::add_tool(scene, "capsule", 0.01, 0, 1, 0, 1e6);  // 40 mm long, upright
  const auto world = start(scene);
  world->set_tool_target(0, {{0, 1, 0}, {1, 0, 0, 0}, {}});  // a quarter turn: the far end goes from +y to +z
  const double reach = 0.5 * 0.01;
  Vec3<double> before(0, 1.04, 0);
  int steps = 0;
  for (; steps < 200; ++steps) {
    ASSERT_TRUE(world->step(false));
    const Pose& pose = world->readings()[0].pose;
    const Vec3<double> end = pose.position_m + physics::rotation(pose) * Vec3<double>(0, 0, 0.04);
    const double moved = (end - before).norm();
    EXPECT_LE(moved, reach * (1 + 1e-9));
    if (moved == 0) break;
    before = end;
  }
  EXPECT_LT((before - Vec3<double>(0, 1, 0.04)).norm(), 1e-12);
  EXPECT_GE(steps, static_cast<int>(0.04 * M_PI / 2 / reach));
}

/// A capsule presses by turning about its tip, which does not move. Its work is that of the torque.
TEST_P(Mechanics, TheWorkOfAToolThatTurnsIsCounted) {
  v1::Scene scene = tests::block_with_probe(true, 8);
  scene.clear_tools();
  v1::Tool& tool = tests::add_tool(scene, "capsule", 0.01, 0.05, 0.061, 0.04, 5e6);  // its other end 40 mm along z
  tool.clear_orientation();
  scene.mutable_bodies(0)->set_rayleigh_stiffness_s(0);
  scene.mutable_bodies(0)->clear_law();
  scene.mutable_bodies(0)->mutable_law()->mutable_hooke()->set_young_modulus_pa(5e3);
  scene.mutable_bodies(0)->mutable_law()->mutable_hooke()->set_poisson_ratio(0.4);
  scene.clear_gravity_m_per_s2();
  const auto world = start(scene);
  for (int i = 1; i <= 200; ++i) {
    const double angle = 0.12 * i / 200;  // lowers the far end by 5 mm
    world->set_tool_target(0, {{0.05, 0.061, 0.04}, {std::cos(angle / 2), std::sin(angle / 2), 0, 0}, {}});
    ASSERT_TRUE(world->step(false));
  }
  world->diagnose();
  const double elastic_j = world->energy().elastic_j();
  ASSERT_GT(elastic_j, 1e-4);
  // The contacts hold some of the work, and damping by implicit Euler takes some.
  EXPECT_GT(world->energy().work_j(), elastic_j);
  EXPECT_LT(world->energy().work_j(), 1.5 * elastic_j);
}

/// A body of almost no mass and stiffness accelerates until it moves farther in a step than its own size.
TEST_P(Mechanics, TheGuardStopsAnUnstableState) {
  v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                       .cells_y = 2,
                                       .cells_z = 2,
                                       .size_x_m = 0.1,
                                       .size_y_m = 0.05,
                                       .size_z_m = 0.05,
                                       .linear = true,
                                       .young_modulus_pa = 1e-3});
  v1::Body& body = *scene.mutable_bodies(0);
  body.clear_fixed();
  body.set_density_kg_per_m3(1e-3);
  v1::Load& load = *body.add_loads();
  load.mutable_region()->mutable_sphere()->set_radius_m(1);
  tests::set(*load.mutable_force_n(), 1e-4, 0, 0);
  const auto world = start(scene);
  const Eigen::MatrixX3d rest = positions(*world);
  int good_steps = 0;
  while (good_steps < 200 && world->step(false)) ++good_steps;
  EXPECT_GE(good_steps, 1);
  EXPECT_LT(good_steps, 200) << "fastest node at " << world->last().max_speed_m_per_s << " m/s";
  world->reset();
  EXPECT_EQ(positions(*world), rest) << "nothing is left behind";
  EXPECT_TRUE(world->step(false));
}

TM_ON_EACH_BACKEND(Mechanics);

}  // namespace
}  // namespace tensormass::world
