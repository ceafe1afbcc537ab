#include "world/enclosure.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "mesh/adjacency.h"
#include "physics/lists.h"

namespace tensormass::world {

Enclosure::Enclosure(const model::Model& model) {
  if (!model.goes_on) return;
  for (std::size_t b = 0; b < model.bodies.size(); ++b) {
    const model::BodyModel& body = model.bodies[b];
    const auto count = static_cast<double>(body.triangles.size());
    if (count == 0 || count > kMaxTrianglesPerS * model.dt_s) continue;
    if (!mesh::triangle_neighbours(body.triangles, body.name)) continue;
    bodies_.push_back({.place = b,
                       .vertex_begin = body.vertex_begin,
                       .vertex_end = body.vertex_begin + body.vertex_count,
                       .triangles = body.triangles,
                       .appended = {}});
    if (model.edit_tables) {  // so that a step with an edit allocates nothing
      const model::EditTables& tables = *model.edit_tables;
      const std::size_t boundary = body.has_skin ? tables.skin.boundary[b].size() : 0;
      bodies_.back().triangles.reserve(std::max(body.triangles.size(), boundary) + tables.max_new_triangles);
      bodies_.back().appended.reserve(tables.max_new_vertices);
    }
    for (mesh::Triangle& triangle : bodies_.back().triangles) {
      for (std::uint32_t& corner : triangle) corner += body.vertex_begin;
    }
    triangles_.reserve(std::max(triangles_.capacity(), bodies_.back().triangles.capacity()));
  }
  if (!bodies_.empty()) sides_.resize(model.visible.point_count());
}

void Enclosure::take(const model::Model& model, const model::Editor& editor) {
  for (Body& body : bodies_) {
    const model::BodyModel& loaded = model.bodies[body.place];
    const model::BodySurface& surface = editor.surfaces()[body.place];
    const auto point = [&](std::uint32_t vertex) {
      if (vertex < loaded.vertex_count) return body.vertex_begin + vertex;
      return surface.appended_vertices[vertex - loaded.vertex_count];
    };
    body.appended = surface.appended_vertices;
    body.triangles.clear();
    if (loaded.has_skin && !surface.appended_triangles.empty()) {
      editor.for_each_enclosing_triangle(model, body.place, [&](const mesh::Triangle& of) {
        body.triangles.push_back({point(of[0]), point(of[1]), point(of[2])});
      });
      continue;
    }
    auto dead = surface.dead_triangles.begin();
    const std::size_t all = loaded.triangles.size() + surface.appended_triangles.size();
    for (std::size_t t = 0; t < all; ++t) {
      if (dead != surface.dead_triangles.end() && *dead == t) {
        ++dead;
        continue;
      }
      const bool is_loaded = t < loaded.triangles.size();
      const mesh::Triangle& of =
          is_loaded ? loaded.triangles[t] : surface.appended_triangles[t - loaded.triangles.size()];
      body.triangles.push_back({point(of[0]), point(of[1]), point(of[2])});
    }
  }
}

Vec3<double> Enclosure::position(std::uint32_t point) const {
  return Eigen::Map<const Eigen::Vector3f>(visible_m_.data() + std::size_t{3} * point).cast<double>();
}

void Enclosure::update(std::span<const float> visible_m) {
  visible_m_ = visible_m;
  for (Body& body : bodies_) {
    body.least.setConstant(std::numeric_limits<double>::infinity());
    body.most = -body.least;
    const auto add = [&](std::uint32_t place) {
      const Vec3<double> x = position(place);
      body.least = body.least.cwiseMin(x);
      body.most = body.most.cwiseMax(x);
    };
    for (std::uint32_t v = body.vertex_begin; v < body.vertex_end; ++v) add(v);
    for (const std::uint32_t v : body.appended) add(v);
  }
}

Enclosure::Core Enclosure::core_of(const model::ToolModel& tool, const physics::Pose& shape) {
  Core core;
  const auto placed = tool.placed<double>(shape, shape);
  physics::with_tool(tool.kind, [&](auto kind) {
    using Kind = typename decltype(kind)::Type;
    if constexpr (Kind::kContactPoints == 0) return;  // a blade belongs inside
    if constexpr (Kind::kIsSolid) {
      if (tool.reach_m > 0) core.points[core.count++] = shape.position_m;  // a plane has no place
    } else {
      for (std::uint32_t i = 0; i < Kind::kCorePoints; ++i) core.points[core.count++] = Kind::core_point(placed, i);
    }
  });
  return core;
}

/// Returns the triangles that a line along z through a point of a rectangle can cross: all but those that lie beside
/// it. Most do, and to see that takes less than to look for a crossing.
std::span<const mesh::Triangle> Enclosure::triangles_between(const Body& body, const Vec3<double>& least,
                                                             const Vec3<double>& most) {
  // A bit for each side of the rectangle beyond which a point lies. A triangle is beside it if its corners share one.
  const auto note = [&](std::uint32_t point) {
    const Vec3<double> x = position(point);
    sides_[point] = static_cast<std::uint8_t>((x[0] < least[0]) | (x[0] > most[0]) << 1 | (x[1] < least[1]) << 2 |
                                              (x[1] > most[1]) << 3);
  };
  for (std::uint32_t v = body.vertex_begin; v < body.vertex_end; ++v) note(v);
  for (const std::uint32_t v : body.appended) note(v);
  triangles_.clear();
  for (const mesh::Triangle& t : body.triangles) {
    if ((sides_[t[0]] & sides_[t[1]] & sides_[t[2]]) == 0) triangles_.push_back(t);
  }
  return triangles_;
}

/// Collects where a line through the point along an axis crosses the surface, relative to the point. Returns false if
/// there is no room for all. A line through an edge or a corner counts as one a little beside it, for all triangles
/// alike.
bool Enclosure::cross(std::span<const mesh::Triangle> triangles, const Vec3<double>& point, int axis,
                      Crossings& out) const {
  const int u = (axis + 1) % 3, v = (axis + 2) % 3;
  out.count = 0;
  for (const mesh::Triangle& t : triangles) {
    std::array<Vec3<double>, 3> x;
    for (std::size_t c = 0; c < 3; ++c) x[c] = position(t[c]) - point;
    // A triangle is crossed if its edges wind around the line in the plane across it. Both triangles of an edge compute
    // its side of the line in the same order, so that no rounding opens a gap between them.
    int winding = 0;
    for (std::size_t c = 0; c < 3; ++c) {
      const std::size_t d = (c + 1) % 3;
      if ((x[c][v] < 0) == (x[d][v] < 0)) continue;
      const bool upwards = x[c][v] < 0, forwards = t[c] < t[d];
      const Vec3<double>&a = forwards ? x[c] : x[d], &b = forwards ? x[d] : x[c];
      const double side = a[u] * b[v] - a[v] * b[u];
      if (forwards == upwards ? side >= 0 : side <= 0) winding += upwards ? 1 : -1;
    }
    if (winding == 0) continue;
    const Vec3<double> normal = (x[1] - x[0]).cross(x[2] - x[0]);
    if (normal[axis] == 0) continue;
    if (out.count == kMaxCrossings) return false;
    out.all[out.count++] = {normal.dot(x[0]) / normal[axis], winding};
  }
  return true;
}

bool Enclosure::is_inside(const Body& body, std::span<const mesh::Triangle> triangles,
                          const Vec3<double>& point) const {
  if ((point.array() < body.least.array()).any() || (point.array() > body.most.array()).any()) return false;
  Crossings crossings;
  if (!cross(triangles, point, 2, crossings)) return false;
  int left = 0;
  for (std::size_t i = 0; i < crossings.count; ++i) left += crossings.all[i].at_m > 0 ? crossings.all[i].leaves : 0;
  return left > 0;
}

bool Enclosure::encloses(const model::ToolModel& tool, const physics::Pose& shape) {
  const Core core = core_of(tool, shape);
  if (core.count == 0) return false;
  const double around_m = tool.radius_m / 2;
  Vec3<double> least = core.points[0], most = least;
  for (std::size_t i = 1; i < core.count; ++i) {
    least = least.cwiseMin(core.points[i]);
    most = most.cwiseMax(core.points[i]);
  }
  least.array() -= around_m;
  most.array() += around_m;
  for (const Body& body : bodies_) {
    if ((most.array() < body.least.array()).any() || (least.array() > body.most.array()).any()) continue;
    const std::span<const mesh::Triangle> triangles = triangles_between(body, least, most);
    for (std::size_t i = 0; i < core.count; ++i) {
      bool enclosed = is_inside(body, triangles, core.points[i]);
      for (int side = 0; enclosed && side < 6; ++side) {
        const double way_m = side % 2 == 0 ? around_m : -around_m;
        enclosed = is_inside(body, triangles, core.points[i] + way_m * Vec3<double>::Unit(side / 2));
      }
      if (enclosed) return true;
    }
  }
  return false;
}

bool Enclosure::is_outside(const model::ToolModel& tool, const physics::Pose& shape) const {
  const Core core = core_of(tool, shape);
  for (std::size_t i = 0; i < core.count; ++i) {
    for (const Body& body : bodies_) {
      if (is_inside(body, body.triangles, core.points[i])) return false;
    }
  }
  return true;
}

std::optional<Vec3<double>> Enclosure::way_out(const model::ToolModel& tool, const physics::Pose& shape) const {
  const Core core = core_of(tool, shape);
  std::optional<Vec3<double>> shortest;
  Crossings crossings;
  for (int axis = 0; axis < 3; ++axis) {
    for (const double direction : {1.0, -1.0}) {
      // From where the tool is, each point may move as far as the last crossing that it must pass.
      double way_m = 0;
      for (std::size_t i = 0; i < core.count; ++i) {
        for (const Body& body : bodies_) {
          if (!is_inside(body, body.triangles, core.points[i]) ||
              !cross(body.triangles, core.points[i], axis, crossings)) {
            continue;
          }
          const auto end = crossings.all.begin() + static_cast<std::ptrdiff_t>(crossings.count);
          std::sort(crossings.all.begin(), end,
                    [&](const auto& a, const auto& b) { return direction * a.at_m < direction * b.at_m; });
          int depth = 1;
          for (auto one = crossings.all.begin(); one != end && depth > 0; ++one) {
            if (!(direction * one->at_m > 0)) continue;
            depth -= (direction > 0 ? 1 : -1) * one->leaves;
            way_m = std::max(way_m, direction * one->at_m);
          }
        }
      }
      const Vec3<double> way = direction * (way_m + 2 * tool.radius_m) * Vec3<double>::Unit(axis);
      if (shortest && shortest->norm() <= way.norm()) continue;
      physics::Pose moved = shape;
      moved.position_m += way;
      if (is_outside(tool, moved)) shortest = way;
    }
  }
  return shortest;
}

}  // namespace tensormass::world
