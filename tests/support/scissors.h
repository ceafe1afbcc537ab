#pragma once

#include <cmath>

#include "support/scenes.h"
#include "world/world.h"

/// A sheet of tissue and scissors that cut it from its face x = 0 on.
///
///        z  ╲  edge 1             ┌──────────────   the sheet is thickness_m high and held at its far end
///        ↑   ╲______ pivot        │     x →
///        │   ╱                    └──────────────
///           ╱  edge 0             the blades lie in a plane y = const, and close towards the middle of the sheet
namespace tensormass::tests {

struct ScissorsScene {
  double young_modulus_pa = 1e6;
  double toughness_j_per_m2 = 20;
  double thickness_m = 6e-3;
  double length_m = 60e-3, width_m = 20e-3;  ///< along x, along y
  double dt_s = 1.0 / 960;
  double opening_rad = 0.7;
  double before_m = 24e-3;  ///< from the pivot to the sheet
  bool double_precision = true;
  bool is_free = false;  ///< nothing holds the sheet, and it does not fall
  std::uint32_t threads = 1;
  double tolerance = 1e-9;  ///< that of the solve, in double precision
};
constexpr double kBladeLengthM = 80e-3, kEdgeOffsetM = 4e-3, kScissorsThicknessM = 20e-6;
constexpr std::uint32_t kPointsOfEdge = 32;

inline v1::Scene sheet_with_scissors(const ScissorsScene& of = {}) {
  v1::Scene scene = beam_scene({.cells_x = 12,
                                .cells_y = 4,
                                .cells_z = 2,
                                .size_x_m = of.length_m,
                                .size_y_m = of.width_m,
                                .size_z_m = of.thickness_m,
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
  v1::Box& clamp = *body.mutable_fixed(0)->mutable_box();
  set(*clamp.mutable_min_m(), of.length_m - 1e-6, -1, -1);
  set(*clamp.mutable_max_m(), 1, 1, 1);
  if (of.is_free) body.clear_fixed();
  v1::Tool& tool = *scene.add_tools();
  tool.set_name("scissors");
  v1::Scissors& scissors = *tool.mutable_scissors();
  scissors.set_radius_m(1e-3);
  scissors.set_blade_length_m(kBladeLengthM);
  scissors.set_thickness_m(kScissorsThicknessM);
  scissors.set_spacing_m(kBladeLengthM / (kPointsOfEdge - 1));
  scissors.set_edge_offset_m(kEdgeOffsetM);
  // The tool's z axis is −x of the scene, its x axis the scene's z axis.
  tool.mutable_orientation()->set_w(std::sqrt(0.5));
  tool.mutable_orientation()->set_y(-std::sqrt(0.5));
  set(*tool.mutable_position_m(), kBladeLengthM - of.before_m, of.width_m / 2 + 0.3e-3, of.thickness_m / 2);
  tool.add_joint_values(of.opening_rad);
  tool.set_max_joint_load(1e3);
  return scene;
}

/// Turns the blades of the first tool to an opening, moves it by a way, and makes a step.
inline bool open_and_step(world::World& world, double opening_rad, const Eigen::Vector3d& way_m = {0, 0, 0}) {
  physics::Pose pose = world.tool_target(0);
  pose.joint_values[0] = opening_rad;
  pose.position_m += way_m;
  world.set_tool_target(0, pose);
  return world.step(false);
}

/// Returns the area of the sheet that edges have swept down to an opening [m²]: in slices across its thickness, as far
/// as the line of an edge, turned about the pivot, has come from the sheet's face.
inline double swept_m2(const ScissorsScene& of, double opening_rad) {
  constexpr int kSlices = 2000;
  const double half = opening_rad / 2;
  // Two points of an edge, forwards of the pivot and aside: of the line aside = −offset, turned by half the opening.
  const auto turned = [&](double forwards, double aside) {
    return Eigen::Vector2d(forwards * std::cos(half) - aside * std::sin(half),
                           forwards * std::sin(half) + aside * std::cos(half));
  };
  const Eigen::Vector2d a = turned(0, -kEdgeOffsetM), b = turned(kBladeLengthM, -kEdgeOffsetM);
  double sum_m2 = 0;
  for (int i = 0; i < kSlices; ++i) {
    const double aside = of.thickness_m * ((i + 0.5) / kSlices - 0.5);
    const double share = (std::abs(aside) - a[1]) / (b[1] - a[1]);
    const double reached = a[0] + std::min(share, 1.0) * (b[0] - a[0]);
    sum_m2 += std::max(reached - of.before_m, 0.0) * of.thickness_m / kSlices;
  }
  return sum_m2;
}

}  // namespace tensormass::tests
