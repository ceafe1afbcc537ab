#pragma once

#include <cstdint>
#include <string>

#include "tensormass/v1/scene.pb.h"

/// Scenes built in code, for tests and the benchmark.
namespace tensormass::tests {

inline void set(v1::Vector3& v, double x, double y, double z) {
  v.set_x(x);
  v.set_y(y);
  v.set_z(z);
}

struct Beam {
  std::uint32_t cells_x = 24, cells_y = 4, cells_z = 4;
  double size_x_m = 8, size_y_m = 1, size_z_m = 0.8;
  bool linear = false;  ///< Hooke's law, else St-Venant-Kirchhoff's
  bool double_precision = false;
  double young_modulus_pa = 1e6;
  double poisson_ratio = 0.4;
  double dt_s = 0.01;
  std::uint32_t cg_max_iterations = 50;
  double cg_tolerance = 0;
  double frame_rate_hz = 0;
};

/// Returns the beam that is common in comparisons: fixed at x = 0, density 1000 kg/m³, gravity along −y, lockstep.
inline v1::Scene beam_scene(const Beam& beam = {}) {
  v1::Scene scene;
  scene.set_name("beam");
  v1::Body& body = *scene.add_bodies();
  body.set_name("beam");
  v1::Grid& grid = *body.mutable_mesh()->mutable_grid();
  set(*grid.mutable_size_m(), beam.size_x_m, beam.size_y_m, beam.size_z_m);
  grid.set_cells_x(beam.cells_x);
  grid.set_cells_y(beam.cells_y);
  grid.set_cells_z(beam.cells_z);
  v1::IsotropicElastic& law =
      beam.linear ? *body.mutable_law()->mutable_hooke() : *body.mutable_law()->mutable_st_venant_kirchhoff();
  law.set_young_modulus_pa(beam.young_modulus_pa);
  law.set_poisson_ratio(beam.poisson_ratio);
  body.set_density_kg_per_m3(1000);
  v1::Box& clamp = *body.add_fixed()->mutable_box();
  set(*clamp.mutable_min_m(), -1e-6, -1, -1);
  set(*clamp.mutable_max_m(), 1e-6, 1 + beam.size_y_m, 1 + beam.size_z_m);
  set(*scene.mutable_gravity_m_per_s2(), 0, -9.81, 0);
  scene.mutable_stepping()->set_dt_s(beam.dt_s);
  scene.mutable_stepping()->set_lockstep(true);
  scene.mutable_solver()->set_cg_max_iterations(beam.cg_max_iterations);
  scene.mutable_solver()->set_cg_tolerance(beam.cg_tolerance);
  scene.mutable_solver()->set_precision(beam.double_precision ? v1::Solver::PRECISION_DOUBLE
                                                              : v1::Solver::PRECISION_FLOAT);
  scene.mutable_streams()->set_frame_rate_hz(beam.frame_rate_hz);
  return scene;
}

/// Adds a spherical probe with its centre at (x, y, z) [m].
inline v1::Tool& add_probe(v1::Scene& scene, const std::string& name, double radius_m, double x, double y, double z) {
  v1::Tool& tool = *scene.add_tools();
  tool.set_name(name);
  tool.mutable_spherical_probe()->set_radius_m(radius_m);
  tool.set_max_force_n(1e6), tool.set_max_torque_n_m(1e6);  // these tests press harder than a hand
  set(*tool.mutable_position_m(), x, y, z);
  return tool;
}

/// Returns a block of soft tissue, 0.1 × 0.05 × 0.1 m, fixed at its bottom (y = 0), with a probe of 10 mm radius above
/// its top.
inline v1::Scene block_with_probe(bool double_precision = false, std::uint32_t cells = 10) {
  Beam block;
  block.cells_x = block.cells_z = cells;
  block.cells_y = cells / 2;
  block.size_x_m = block.size_z_m = 0.1;
  block.size_y_m = 0.05;
  block.young_modulus_pa = 5e3;
  block.double_precision = double_precision;
  block.cg_max_iterations = 200;
  block.cg_tolerance = double_precision ? 1e-12 : 1e-5;
  block.frame_rate_hz = 60;
  v1::Scene scene = beam_scene(block);
  scene.set_name("block");
  v1::Box& clamp = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
  set(*clamp.mutable_min_m(), -1, -1, -1);
  set(*clamp.mutable_max_m(), 1, 1e-6, 1);
  add_probe(scene, "probe", 0.01, 0.05, 0.07, 0.05);
  return scene;
}

/// Whether a step of the scene runs Newton's method.
inline bool iterates(const v1::Scene& scene) { return scene.solver().newton_max_iterations() > 1; }

/// Adds an attachment of every second node of one body to the first node of another, from node `first` on to `end`.
inline v1::Attachment& attach_every_second(v1::Scene& scene, const std::string& name, const std::string& body,
                                           const std::string& other, std::uint32_t first, std::uint32_t end) {
  v1::Attachment& attachment = *scene.add_attachments();
  attachment.set_name(name);
  attachment.set_body(body);
  attachment.set_other(other);
  for (std::uint32_t node = first; node < end; node += 2)
    attachment.mutable_region()->mutable_nodes()->add_indices(node);
  attachment.mutable_other_region()->mutable_nodes()->add_indices(0);
  attachment.set_stiffness_n_per_m(500);
  return attachment;
}

/// Returns block_with_probe with a second block that hangs below it. The attachment "strong" has 8 springs and holds
/// it; "weak" has 9 and tears at once, because each of its springs breaks at 1e-5 N.
inline v1::Scene hanging_block(std::uint32_t cells = 4) {
  v1::Scene scene = block_with_probe(true, cells);
  v1::Body& hanging = *scene.add_bodies();
  hanging = scene.bodies(0);
  hanging.set_name("hanging");
  hanging.clear_fixed();
  set(*hanging.mutable_mesh()->mutable_translation_m(), 0, -0.2, 0);
  attach_every_second(scene, "strong", "hanging", scene.bodies(0).name(), 1, 17);
  attach_every_second(scene, "weak", "hanging", scene.bodies(0).name(), 0, 17).set_breaking_force_n(9e-5);
  return scene;
}

}  // namespace tensormass::tests
