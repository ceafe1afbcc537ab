#pragma once

#include <stdexcept>
#include <string>
#include <vector>

#include "physics/lists.h"
#include "support/scenes.h"

/// Tools of every kind, for tests that run over all of them.
namespace tensormass::tests {

inline std::vector<std::string> tool_kinds() {
  std::vector<std::string> names;
  physics::for_each_type(physics::Tools{}, [&](auto tag, int) { names.emplace_back(decltype(tag)::Type::kName); });
  return names;
}

/// Adds a tool of this kind with its shape's origin at (x, y, z) [m]. Its z axis points up, along the scene's y.
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
  physics::for_each_type(physics::Tools{}, [&](auto tag, int) {
    using Kind = typename decltype(tag)::Type;
    if (Kind::kName != kind) return;
    for (const physics::ToolParameter& parameter : Kind::kParameters) put(parameter.name, 4 * radius_m);
  });
  return tool;
}

}  // namespace tensormass::tests
