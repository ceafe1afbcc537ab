#pragma once

#include <cmath>
#include <string>
#include <vector>

#include "support/scenes.h"
#include "world/world.h"

/// Blocks of tissue and a scalpel whose edge lies along y and cuts towards x.
namespace tensormass::tests {

struct BladeScene {
  double width_m = 0.01;  ///< along y; each of the inner 24 of 32 blade points owns a 24th of it
  double young_modulus_pa = 20e3;
  double toughness_j_per_m2 = 20;
  double dt_s = 1.0 / 960;
  bool double_precision = true;
  bool is_free = false;  ///< nothing holds the block, and it does not fall
  bool selective = false;
  std::uint32_t threads = 1;
  double tolerance = 1e-9;    ///< that of the solve, in double precision
  double points_width_m = 0;  ///< 0: the edge is wider than the block, else this wide between its ends
};
constexpr double kBlockLengthM = 0.04, kBlockHeightM = 0.02, kBladeThicknessM = 0.4e-3;

/// Returns a block, fixed at its bottom (z = 0), and a scalpel before its face x = 0 at half its height.
inline v1::Scene block_with_scalpel(const BladeScene& of = {}) {
  v1::Scene scene = beam_scene({.cells_x = 8,
                                .cells_y = 2,
                                .cells_z = 4,
                                .size_x_m = kBlockLengthM,
                                .size_y_m = of.width_m,
                                .size_z_m = kBlockHeightM,
                                .linear = true,
                                .double_precision = of.double_precision,
                                .young_modulus_pa = of.young_modulus_pa,
                                .poisson_ratio = 0.3,
                                .dt_s = of.dt_s,
                                .cg_max_iterations = 2000,
                                .cg_tolerance = of.double_precision ? of.tolerance : 1e-6,
                                .frame_rate_hz = 0});
  scene.clear_gravity_m_per_s2();
  scene.mutable_editing()->mutable_cutting();
  scene.mutable_solver()->set_cpu_threads(of.threads);
  v1::Body& body = *scene.mutable_bodies(0);
  body.set_fracture_toughness_j_per_m2(of.toughness_j_per_m2);
  body.set_rayleigh_stiffness_s(1e-3);
  if (of.selective) body.set_quadrature(v1::QUADRATURE_SELECTIVE);
  v1::Box& clamp = *body.mutable_fixed(0)->mutable_box();
  set(*clamp.mutable_min_m(), -1, -1, -1e-6);
  set(*clamp.mutable_max_m(), 1, 1, 1e-6);
  if (of.is_free) body.clear_fixed();
  v1::Tool& tool = *scene.add_tools();
  tool.set_name("scalpel");
  v1::Scalpel& scalpel = *tool.mutable_scalpel();
  const double length_m = of.points_width_m > 0 ? of.points_width_m : of.width_m * 31 / 24;
  scalpel.set_length_m(length_m);
  scalpel.set_spacing_m(length_m / 31);
  scalpel.set_thickness_m(kBladeThicknessM);
  set(*tool.mutable_position_m(), -0.001, of.width_m / 2 - length_m / 2, kBlockHeightM / 2 + 0.0003);
  tool.mutable_orientation()->set_w(std::sqrt(0.5));  // the tool's z axis is the scene's y axis
  tool.mutable_orientation()->set_x(-std::sqrt(0.5));
  return scene;
}

/// Moves the first tool by a way and makes a step.
inline bool move_and_step(world::World& world, const Eigen::Vector3d& way_m) {
  physics::Pose pose = world.tool_target(0);
  pose.position_m += way_m;
  world.set_tool_target(0, pose);
  return world.step(false);
}

}  // namespace tensormass::tests
