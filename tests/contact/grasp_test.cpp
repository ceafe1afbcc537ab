#include <cmath>

#include <gtest/gtest.h>

#include "support/backends.h"
#include "support/scenes.h"
#include "support/tools.h"

/// A grasper on tissue, step after step, through the whole of World.
namespace tensormass::contact {
namespace {

using physics::Pose;

class Grasp : public tests::OnBackend {
 protected:
  static constexpr double kDtS = 1.0 / 60, kJawM = 0.03, kRadiusM = 0.003;

  /// A box of tissue from the origin, and the grasper above the middle of its top, closed jaws downwards.
  static v1::Scene scene(double size_x_m, double size_y_m, double size_z_m, double opening_rad) {
    v1::Scene scene = tests::beam_scene({.cells_x = 4,
                                         .cells_y = 6,
                                         .cells_z = 6,
                                         .size_x_m = size_x_m,
                                         .size_y_m = size_y_m,
                                         .size_z_m = size_z_m,
                                         .double_precision = true,
                                         .dt_s = kDtS,
                                         .cg_max_iterations = 1000,
                                         .cg_tolerance = 1e-8});
    scene.clear_gravity_m_per_s2();
    v1::Body& body = *scene.mutable_bodies(0);
    body.set_density_kg_per_m3(1000);
    body.clear_law();
    body.mutable_law()->mutable_stable_neo_hookean()->set_young_modulus_pa(5e3);
    body.mutable_law()->mutable_stable_neo_hookean()->set_poisson_ratio(0.3);
    v1::Tool& tool = tests::add_tool(scene, "grasper", kRadiusM, size_x_m / 2, size_y_m / 2, size_z_m - 0.012, 5e6);
    tool.mutable_grasper()->set_jaw_length_m(kJawM);
    tool.clear_orientation();  // z upwards
    tool.add_joint_values(opening_rad);
    return scene;
  }
};

/// The jaws press by their joint alone: no force in total, and the work of the joint becomes elastic energy.
TEST_P(Grasp, TheWorkOfClosingJawsIsCounted) {
  constexpr double kOpenRad = 1.45, kClosedRad = 1.2;
  v1::Scene tissue = scene(0.02, 0.04, 0.02, kOpenRad);
  v1::Box& bottom = *tissue.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
  tests::set(*bottom.mutable_min_m(), -1, -1, -1);
  tests::set(*bottom.mutable_max_m(), 1, 1, 1e-6);
  tissue.mutable_bodies(0)->set_rayleigh_stiffness_s(0);
  const auto world = start(tissue);
  Pose pose = world->readings()[0].pose;
  EXPECT_EQ(pose.joint_values[0], kOpenRad);
  for (int i = 1; i <= 200; ++i) {
    pose.joint_values[0] = kOpenRad + (kClosedRad - kOpenRad) * i / 200;
    world->set_tool_target(0, pose);
    ASSERT_TRUE(world->step(false));
  }
  const world::ToolReading& reading = world->readings()[0];
  EXPECT_GT(reading.joint_loads[0], 1e-4) << "tissue pushes the jaws open";
  EXPECT_LT(std::abs(reading.force_n[0]), 0.05 * reading.joint_loads[0] / kJawM) << "one jaw against the other";
  world->diagnose();
  const double elastic_j = world->energy().elastic_j();
  ASSERT_GT(elastic_j, 1e-6);
  // The contacts hold some of the work, and damping by implicit Euler takes some.
  EXPECT_GT(world->energy().work_j(), elastic_j);
  EXPECT_LT(world->energy().work_j(), 1.5 * elastic_j);
}

/// The jaws close on a free piece of tissue that does not weigh anything yet, lift it, and hold it for a minute.
TEST_P(Grasp, TissueIsHeldWithoutSlipAndLetGo) {
  constexpr double kOpenRad = 0.9, kClosedRad = 0.35;
  v1::Scene sheet = scene(0.006, 0.03, 0.03, kOpenRad);
  sheet.mutable_bodies(0)->clear_fixed();
  sheet.mutable_bodies(0)->set_rayleigh_stiffness_s(0.01);
  sheet.mutable_tools(0)->set_friction_coefficient(0.8);
  tests::set(*sheet.mutable_gravity_m_per_s2(), 0, 0, -9.81);
  v1::Schedule& weight = *sheet.mutable_gravity_schedule();
  for (const double time_s : {1.0, 1.5}) weight.add_time_s(time_s);
  for (const double factor : {0.0, 1.0}) weight.add_factor(factor);
  const auto world = start(sheet);
  const auto height_m = [&] {  // the middle of the tissue, seen from the grasper
    const std::vector<double> x = world->positions(world->model().bodies[0]);
    double mean = 0;
    for (std::size_t i = 2; i < x.size(); i += 3) mean += x[i];
    return mean / (static_cast<double>(x.size()) / 3) - world->readings()[0].pose.position_m[2];
  };
  Pose pose = world->readings()[0].pose;
  const auto go = [&](double seconds, double opening_rad, double lift_m) {
    const Pose from = pose;
    const int steps = static_cast<int>(std::lround(seconds / kDtS));
    for (int i = 1; i <= steps; ++i) {
      const double share = static_cast<double>(i) / steps;
      pose.joint_values[0] = from.joint_values[0] + share * (opening_rad - from.joint_values[0]);
      pose.position_m[2] = from.position_m[2] + share * lift_m;
      world->set_tool_target(0, pose);
      ASSERT_TRUE(world->step(false));
    }
  };
  go(1, kClosedRad, 0);
  go(1, kClosedRad, 0);
  const double grasped_m = height_m();
  const double weight_n = 1000 * 0.006 * 0.03 * 0.03 * 9.81;
  EXPECT_NEAR(world->readings()[0].force_n[2], -weight_n, 0.01 * weight_n);
  go(1, kClosedRad, 0.05);
  go(1, kClosedRad, 0);
  const double lifted_m = height_m();
  EXPECT_NEAR(lifted_m, grasped_m, 0.1 * kJawM);
  go(60, kClosedRad, 0);
  EXPECT_NEAR(height_m(), lifted_m, 0.01 * kJawM) << "no drift in a minute";
  EXPECT_NEAR(world->readings()[0].force_n[2], -weight_n, 0.01 * weight_n);
  go(0.25, kOpenRad, 0);
  EXPECT_LT(height_m(), lifted_m - 0.05) << "it falls";
  EXPECT_EQ(world->readings()[0].force_n.norm(), 0);
}

TM_ON_EACH_BACKEND(Grasp);

}  // namespace
}  // namespace tensormass::contact
