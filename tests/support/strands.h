#pragma once

#include <cstdint>

#include "support/scenes.h"

/// Two blocks with a gap between them, which strands of an attachment bridge, and a tool that severs them.
namespace tensormass::tests {

inline constexpr double kStrandsStiffness = 100;                    ///< all strands together [N/m]
inline constexpr double kGapBegins = 0.02, kGapEnds = 0.04;         ///< heights of the gap [m]
inline constexpr double kReachM = 0.004, kSeveringRadiusM = 0.003;  ///< the tool's [m]

/// Returns the block "upper", which is held, above the free block "lower". 22 upright strands join their layers of
/// nodes: at x = 0, 0.01 .. 0.1 m and z = 0 and 0.01 m. Without gravity nothing moves. The tool is a sphere in front of
/// the gap, which it enters without a touch.
inline v1::Scene strung_blocks(bool in_double, bool gravity) {
  v1::Scene scene = beam_scene({.cells_x = 10,
                                .cells_y = 2,
                                .cells_z = 1,
                                .size_x_m = 0.1,
                                .size_y_m = kGapBegins,
                                .size_z_m = 0.01,
                                .double_precision = in_double,
                                .young_modulus_pa = 1e6,
                                .cg_max_iterations = 400,
                                .cg_tolerance = in_double ? 1e-12 : 1e-6,
                                .frame_rate_hz = 60});
  scene.set_name("strung");
  if (!gravity) scene.clear_gravity_m_per_s2();
  v1::Body& lower = *scene.mutable_bodies(0);
  lower.set_name("lower");
  v1::Body& upper = *scene.add_bodies();
  upper = lower;
  upper.set_name("upper");
  set(*upper.mutable_mesh()->mutable_translation_m(), 0, kGapEnds, 0);
  set(*upper.mutable_fixed(0)->mutable_box()->mutable_min_m(), -1, -1, -1);
  set(*upper.mutable_fixed(0)->mutable_box()->mutable_max_m(), 1, 1, 1);
  lower.clear_fixed();
  lower.set_rayleigh_mass_per_s(10);
  v1::Attachment& strands = *scene.add_attachments();
  strands.set_name("strands");
  strands.set_body("lower");
  strands.set_other("upper");
  const auto set_layer = [](v1::Region& region, double y_m) {
    set(*region.mutable_box()->mutable_min_m(), -1, y_m - 1e-4, -1);
    set(*region.mutable_box()->mutable_max_m(), 1, y_m + 1e-4, 1);
  };
  set_layer(*strands.mutable_region(), kGapBegins);
  set_layer(*strands.mutable_other_region(), kGapEnds);
  strands.set_stiffness_n_per_m(kStrandsStiffness);
  v1::Tool& tool = add_probe(scene, "tool", kSeveringRadiusM, 0.05, 0.03, -0.05);
  tool.set_max_speed_m_per_s(100);
  tool.mutable_dissection()->set_reach_m(kReachM);
  return scene;
}

}  // namespace tensormass::tests
