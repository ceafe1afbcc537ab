#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>
#include <string>

#include "mesh/grid.h"
#include "support/scenes.h"

/// Bars that cross on their ridges, with nodes far from the crossing: only their edges can hold each other.
namespace tensormass::tests {

/// Two bars of 100 × 20 × 20 mm, y up. The lower one lies along x with a ridge upward at y = 0 and is fixed below its
/// middle. The upper one crosses above its middle.
struct Ridges {
  std::uint32_t lower_cells = 3, upper_cells = 5;  ///< along each bar
  mesh::Shape shape = mesh::Shape::kHexahedron;    ///< elements
  double yaw = std::numbers::pi / 2;               ///< angle between the bars
  double upper_turn = std::numbers::pi / 4;        ///< 0: the upper bar lies on a flat side
  double gap_m = 0;                                ///< between lower and upper bar
  double offset_m = 0.0023;                        ///< moves the upper bar along its axis
  bool is_guided = true;                           ///< the upper bar only moves up and down
  double friction = 0, young_modulus_pa = 1e5, dt_s = 1.0 / 60;
  bool double_precision = true;
};
inline constexpr double kRidgeLengthM = 0.1, kRidgeSideM = 0.02;
inline constexpr double kRidgeMassKg = 1000 * kRidgeLengthM * kRidgeSideM * kRidgeSideM;

/// Returns a bar along x whose middle is the origin, turned about its axis and then about y.
inline mesh::Mesh ridge(std::uint32_t cells, mesh::Shape shape, double turn, double yaw, double offset_m) {
  mesh::Mesh mesh = mesh::make_grid({-kRidgeLengthM / 2 + offset_m, -kRidgeSideM / 2, -kRidgeSideM / 2},
                                    {kRidgeLengthM, kRidgeSideM, kRidgeSideM}, cells, 1, 1, shape)
                        .value();
  const Eigen::Matrix3d rotation =
      (Eigen::AngleAxisd(yaw, Eigen::Vector3d::UnitY()) * Eigen::AngleAxisd(turn, Eigen::Vector3d::UnitX()))
          .toRotationMatrix();
  for (Eigen::Vector3d& x : mesh.nodes) x = rotation * x;
  return mesh;
}

/// Adds a body of a packed mesh.
inline v1::Body& add_packed(v1::Scene& scene, const std::string& name, const mesh::Mesh& mesh) {
  v1::Body& body = *scene.add_bodies();
  body.set_name(name);
  v1::PackedMesh& packed = *body.mutable_mesh()->mutable_packed();
  for (const Eigen::Vector3d& x : mesh.nodes) {
    packed.mutable_node_positions()->append(reinterpret_cast<const char*>(x.data()), 3 * sizeof(double));
  }
  for (const mesh::ElementBlock& block : mesh.blocks) {
    v1::PackedElements& elements = *packed.add_elements();
    // The enums list the same shapes in the same order; the protocol's starts at 1.
    elements.set_shape(static_cast<v1::Shape>(static_cast<int>(block.shape) + 1));
    elements.set_nodes(block.nodes.data(), block.nodes.size() * sizeof(std::uint32_t));
  }
  return body;
}

inline v1::Scene crossed_ridges(const Ridges& ridges = {}) {
  v1::Scene scene = beam_scene({.double_precision = ridges.double_precision,
                                .dt_s = ridges.dt_s,
                                .cg_max_iterations = 2000,
                                .cg_tolerance = ridges.double_precision ? 1e-10 : 1e-6});
  scene.set_name("ridges");
  scene.clear_bodies();
  constexpr double kHalfDiagonalM = std::numbers::sqrt2 / 2 * kRidgeSideM;
  mesh::Mesh lower = ridge(ridges.lower_cells, ridges.shape, std::numbers::pi / 4, 0, 0);
  for (Eigen::Vector3d& x : lower.nodes) x[1] -= kHalfDiagonalM;
  v1::Box& clamp = *add_packed(scene, "lower", lower).add_fixed()->mutable_box();
  set(*clamp.mutable_min_m(), -1, -1, -1);
  set(*clamp.mutable_max_m(), 1, -kHalfDiagonalM + 1e-6, 1);
  mesh::Mesh upper = ridge(ridges.upper_cells, ridges.shape, ridges.upper_turn, ridges.yaw, ridges.offset_m);
  const double lowest_m = ridges.upper_turn == 0 ? kRidgeSideM / 2 : kHalfDiagonalM;
  for (Eigen::Vector3d& x : upper.nodes) x[1] += lowest_m + ridges.gap_m;
  v1::Body& above = add_packed(scene, "upper", upper);
  if (ridges.is_guided) {
    v1::PrescribedDisplacement& guide = *above.add_prescribed();
    set(*guide.mutable_region()->mutable_box()->mutable_min_m(), -1, -1, -1);
    set(*guide.mutable_region()->mutable_box()->mutable_max_m(), 1, 1, 1);
    guide.set_x_m(0);
    guide.set_z_m(0);
  }
  for (v1::Body& body : *scene.mutable_bodies()) {
    v1::IsotropicElastic& law = *body.mutable_law()->mutable_stable_neo_hookean();
    law.set_young_modulus_pa(ridges.young_modulus_pa);
    law.set_poisson_ratio(0.3);
    body.set_density_kg_per_m3(1000);
    body.set_rayleigh_stiffness_s(0.002);
  }
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body("upper");
  contact.set_other("lower");
  contact.set_distance_m(5e-4);
  contact.set_friction_coefficient(ridges.friction);
  return scene;
}

}  // namespace tensormass::tests
