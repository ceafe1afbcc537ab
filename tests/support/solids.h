#pragma once

#include <array>
#include <cstring>
#include <string>
#include <vector>

#include "physics/lists.h"
#include "support/scenes.h"

/// Solid tools for tests: the same box as a box, as a mesh, and the half-space above or below it as a plane.
namespace tensormass::tests {

inline std::vector<std::string> solid_kinds() {
  std::vector<std::string> names;
  physics::for_each_type(physics::SolidTools{}, [&](auto tag, int) { names.emplace_back(decltype(tag)::Type::kName); });
  return names;
}

template <class Item>
std::string packed_bytes(const std::vector<Item>& items) {
  return {reinterpret_cast<const char*>(items.data()), items.size() * sizeof(Item)};
}

/// Returns the surface of a box about the origin.
inline v1::PackedTriangles box_surface(const std::array<double, 3>& size_m) {
  std::vector<double> positions;
  for (int vertex = 0; vertex < 8; ++vertex) {
    for (int c = 0; c < 3; ++c) {
      positions.push_back(((vertex >> c) & 1 ? 0.5 : -0.5) * size_m[static_cast<std::size_t>(c)]);
    }
  }
  const std::vector<std::uint32_t> triangles{0, 2, 1, 1, 2, 3, 4, 5, 6, 5, 7, 6, 0, 1, 4, 1, 5, 4,
                                             2, 6, 3, 3, 6, 7, 0, 4, 2, 2, 4, 6, 1, 3, 5, 3, 7, 5};
  v1::PackedTriangles out;
  out.set_vertex_positions(packed_bytes(positions));
  out.set_triangles(packed_bytes(triangles));
  return out;
}

/// Adds a box of this size about a point. As a plane, its lower side and all above it, or with `upwards` its upper side
/// and all below it.
inline v1::Tool& add_solid(v1::Scene& scene, const std::string& kind, const std::array<double, 3>& size_m,
                           const std::array<double, 3>& center_m, double penalty_pa_per_m, bool upwards = false) {
  v1::Tool& tool = *scene.add_tools();
  tool.set_name("solid");
  tool.set_max_force_n(1e6);  // these tests press harder than a hand
  tool.set_max_torque_n_m(1e6);
  set(*tool.mutable_position_m(), center_m[0], center_m[1], center_m[2]);
  if (kind == "box") {
    v1::BoxSolid& box = *tool.mutable_box();
    box.set_size_x_m(size_m[0]);
    box.set_size_y_m(size_m[1]);
    box.set_size_z_m(size_m[2]);
    box.set_penalty_stiffness_pa_per_m(penalty_pa_per_m);
  } else if (kind == "mesh") {
    *tool.mutable_mesh()->mutable_surface()->mutable_packed() = box_surface(size_m);
    tool.mutable_mesh()->set_penalty_stiffness_pa_per_m(penalty_pa_per_m);
  } else {
    const double h = 0.70710678118654757, side = upwards ? 1 : -1;  // turns the z axis to ±y
    tool.mutable_position_m()->set_y(center_m[1] + side * size_m[1] / 2);
    tool.mutable_orientation()->set_w(h);
    tool.mutable_orientation()->set_x(-side * h);
    tool.mutable_plane()->set_penalty_stiffness_pa_per_m(penalty_pa_per_m);
  }
  return tool;
}

}  // namespace tensormass::tests
