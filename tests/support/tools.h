#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

#include "physics/lists.h"
#include "support/scenes.h"

/// Tools of every thin kind, for tests that run over all of them.
namespace tensormass::tests {

inline std::vector<std::string> thin_tool_kinds() {
  std::vector<std::string> names;
  physics::for_each_type(physics::ThinTools{}, [&](auto tag, int) { names.emplace_back(decltype(tag)::Type::kName); });
  return names;
}

/// The pressure of a thin tool's contact by its penalty, and its slope, at a depth [m]; contact/tools.h writes it in
/// another form.
///
///   p = d + L (1 / (1 − x) − 1 − x),   L = 3/4 R,   x = (d − R/4) / L, continued by its tangent from x = steepest on
struct HardenedDepth {
  double pressure_m, slope;
};
inline HardenedDepth hardened(double depth_m, double radius_m, double steepest) {
  const double length = 0.75 * radius_m, x = (depth_m - 0.25 * radius_m) / length, at = std::min(x, steepest);
  if (x <= 0) return {depth_m, 1};
  const double slope = 1 / ((1 - at) * (1 - at));
  const double pressure_m = 0.25 * radius_m + length * (1 / (1 - at) - 1);
  return {pressure_m + slope * length * (x - at), slope};
}

/// Adds a tool of this thin kind with its shape's origin at (x, y, z) [m]. Its z axis points up, along the scene's y.
/// Numbers of the kind besides the radius become four radii.
inline v1::Tool& add_tool(v1::Scene& scene, const std::string& kind, double radius_m, double x, double y, double z,
                          double penalty_pa_per_m) {
  v1::Tool& tool = *scene.add_tools();
  tool.set_name("tool");
  set(*tool.mutable_position_m(), x, y, z);
  tool.mutable_orientation()->set_w(0.70710678118654757);
  tool.mutable_orientation()->set_x(-0.70710678118654757);
  const auto* field = v1::Tool::descriptor()->FindFieldByName(kind);
  if (field == nullptr) throw std::invalid_argument(kind + " is not a kind of Tool in scene.proto");
  google::protobuf::Message& shape = *tool.GetReflection()->MutableMessage(&tool, field);
  const auto put = [&](std::string_view name, double value) {
    shape.GetReflection()->SetDouble(&shape, shape.GetDescriptor()->FindFieldByName(std::string(name)), value);
  };
  put("radius_m", radius_m);
  put("penalty_stiffness_pa_per_m", penalty_pa_per_m);
  for (auto set_largest : {&v1::Tool::set_max_force_n, &v1::Tool::set_max_torque_n_m, &v1::Tool::set_max_joint_load}) {
    (tool.*set_largest)(1e6);  // these tests press harder than a hand
  }
  physics::for_each_type(physics::Tools{}, [&](auto tag, int) {
    using Kind = typename decltype(tag)::Type;
    if (Kind::kName != kind) return;
    for (const physics::ToolParameter& parameter : Kind::kParameters) put(parameter.name, 4 * radius_m);
  });
  return tool;
}

/// Turns a tool of add_tool by 0.4 rad, so that it touches a face below it with one end: the blade of a retractor would
/// lie along the face (contact/line.h).
inline void stand_on_its_tip(v1::Tool& tool) {
  const double half = std::sqrt(0.5), sine = std::sin(0.2), cosine = std::cos(0.2);
  v1::Quaternion& q = *tool.mutable_orientation();  // about the scene's z, after the quarter turn about x
  q.set_w(half * cosine);
  q.set_x(-half * cosine);
  q.set_y(-half * sine);
  q.set_z(half * sine);
}

/// Returns a block that cannot move, 1 m along each edge, its top two large triangles at y = 1, with a tool of radius
/// 0.05 m far above it.
inline v1::Scene rigid_block(const std::string& kind, double penalty_pa_per_m) {
  v1::Scene scene = beam_scene({.cells_x = 1,
                                .cells_y = 1,
                                .cells_z = 1,
                                .size_x_m = 1,
                                .size_y_m = 1,
                                .size_z_m = 1,
                                .linear = true,
                                .double_precision = true});
  scene.clear_gravity_m_per_s2();
  v1::Box& all = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
  set(*all.mutable_min_m(), -1, -1, -1);
  set(*all.mutable_max_m(), 2, 2, 2);
  v1::Tool& tool = add_tool(scene, kind, 0.05, 0, 5, 0, penalty_pa_per_m);
  if (kind == "retractor") stand_on_its_tip(tool);
  return scene;
}

}  // namespace tensormass::tests
