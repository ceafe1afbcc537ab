#include <algorithm>
#include <cmath>
#include <numbers>
#include <vector>

#include <fmt/format.h>

#include "core/finding_kinds.h"
#include "model/compile_parts.h"

/// Finds tools that start inside tissue, that are smaller than the triangles which they touch, and that a free body
/// passes within a step.
namespace tensormass::model {

namespace {

using Point = Vec3<double>;

/// Points of a free body from which its fall is followed. A tool that is small and lies between them is not seen.
constexpr std::size_t kFallingPoints = 256;
/// Steps along the way of a fall. Each goes as far as the tool is away.
constexpr int kFallingSteps = 128;
/// Longest fall that is followed [m].
constexpr double kLongestFallM = 100;

/// What tools can touch, as it is at the start.
struct StartSurface {
  std::vector<Point> vertices;
  std::vector<std::array<std::uint32_t, 3>> triangles;
  std::vector<std::size_t> bodies;  ///< by triangle

  explicit StartSurface(const ToolMistakeInput& m) {
    const auto at_start = [&](std::size_t row) {
      Point x;
      for (std::size_t c = 0; c < 3; ++c) {
        const std::size_t i = 4 * row + c;
        x[static_cast<Eigen::Index>(c)] = m.rest[i] + (m.initial_displacement.empty() ? 0 : m.initial_displacement[i]);
      }
      return x;
    };
    for (const std::uint32_t row : m.contact.surface_rows) vertices.push_back(at_start(row));
    for (std::size_t t = 0; t < m.contact.outer_count(); ++t) {
      const std::uint32_t* corners = &m.contact.vertex_of_corner[3 * t];
      triangles.push_back({corners[0], corners[1], corners[2]});
      bodies.push_back(body_of_node(m.bodies, m.layout.node_of_row[m.contact.triangle_rows[3 * t]]));
    }
  }
};

physics::PlacedTool<double> at_start(const ToolMistakeInput& m, const ToolModel& tool) {
  physics::Pose shape = tool.initial_pose;
  shape.position_m += physics::rotation(shape) * tool.tip_offset_m;
  physics::PlacedTool<double> placed = tool.placed<double>(shape, shape);
  placed.samples = m.tool_samples.data() + tool.first_sample;
  return placed;
}

/// Calls visit(TypeTag<Kind>{}) with the kind of a tool.
template <class Visit>
void with_kind(const ToolModel& tool, const Visit& visit) {
  physics::for_each_type(physics::Tools{}, [&](auto tag, int index) {
    if (index == static_cast<int>(tool.kind)) visit(tag);
  });
}

/// Returns the first body that encloses a point, by the sum of the solid angles of its triangles (van Oosterom,
/// Strackee 1983); the number of bodies if there is none.
std::size_t enclosing_body(const StartSurface& surface, std::size_t body_count, const Point& p) {
  std::vector<double> half_angle(body_count, 0);
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    const Point a = surface.vertices[surface.triangles[t][0]] - p, b = surface.vertices[surface.triangles[t][1]] - p,
                c = surface.vertices[surface.triangles[t][2]] - p;
    const double la = a.norm(), lb = b.norm(), lc = c.norm();
    half_angle[surface.bodies[t]] +=
        std::atan2(a.dot(b.cross(c)), la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb);
  }
  const auto encloses = [](double angle) { return angle > std::numbers::pi; };  // 2π inside, 0 outside
  return static_cast<std::size_t>(std::find_if(half_angle.begin(), half_angle.end(), encloses) - half_angle.begin());
}

/// Tissue in a tool at the start.
struct Start {
  double depth_m = 0;  ///< largest depth of the surface inside the tool
  std::size_t body = 0;
  bool encloses = false;  ///< the tissue encloses a point of the core; for a solid its middle
};

template <class Kind>
Start tissue_in(const physics::PlacedTool<double>& tool, const StartSurface& surface, std::size_t body_count) {
  Start out;
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    Point x[3];
    for (std::size_t i = 0; i < 3; ++i) x[i] = surface.vertices[surface.triangles[t][i]];
    const double reach_m = std::max((x[1] - x[0]).norm(), (x[2] - x[0]).norm());
    const auto take = [&](double depth_m) {
      if (!(depth_m > out.depth_m)) return;
      out.depth_m = depth_m;
      out.body = surface.bodies[t];
    };
    if (Kind::distance(tool, x[0]) > reach_m) continue;  // no point of the triangle is nearer than that
    if constexpr (Kind::kIsSolid) {
      for (const Point& p : {x[0], x[1], x[2], Point((x[0] + x[1] + x[2]) / 3)}) take(-Kind::distance(tool, p));
    } else {
      Kind::for_each_candidate(tool, x[0], x[1], x[2], [&](const Point& weights, const auto& core) {
        const Point p = weights[0] * x[0] + weights[1] * x[1] + weights[2] * x[2];
        take(tool.radius_m - (p - core.position).norm());
      });
    }
  }
  std::vector<Point> core;
  if constexpr (Kind::kIsSolid) {
    if (Kind::distance(tool, tool.position()) < 0) core.push_back(tool.position());
  } else {
    for (std::uint32_t i = 0; i < Kind::kCorePoints; ++i) core.push_back(Kind::core_point(tool, static_cast<int>(i)));
  }
  for (const Point& p : core) {
    const std::size_t body = enclosing_body(surface, body_count, p);
    if (body == body_count) continue;
    out.body = body;
    out.encloses = true;
    break;
  }
  return out;
}

void find_tool_inside(const ToolMistakeInput& m, const StartSurface& surface, const ToolModel& tool,
                      std::vector<Finding>& findings) {
  with_kind(tool, [&](auto tag) {
    const Start start = tissue_in<typename decltype(tag)::Type>(at_start(m, tool), surface, m.bodies.size());
    const double value = std::max(start.depth_m / tool.radius_m, start.encloses ? 1.0 : 0.0);
    if (!(value > thresholds::kStartDepthInRadii)) return;
    const std::string& body = m.bodies[start.body].name;
    findings.push_back(
        {.code = FindingCode::kToolInsideTissue,
         .value = value,
         .limit = thresholds::kStartDepthInRadii,
         .place = fmt::format("tool '{}'.position_m", tool.name),
         .body = body,
         .tool = tool.name,
         .message =
             start.encloses
                 ? fmt::format("tool '{}' starts inside body '{}', so its first forces mean nothing", tool.name, body)
                 : fmt::format("tool '{}' starts with tissue of body '{}' {:.3g} mm inside it, so its first "
                               "forces are large",
                               tool.name, body, 1e3 * start.depth_m),
         .remedy = "start it outside of the tissue, and move it there"});
  });
}

/// The triangles of each body by size.
void find_coarse_surfaces(const ToolMistakeInput& m, const StartSurface& surface, std::vector<Finding>& findings) {
  struct Triangle {
    double edge_m, area_m2;
  };
  std::vector<std::vector<Triangle>> of_body(m.bodies.size());
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    const double area_m2 = m.contact.triangle_area[t];
    of_body[surface.bodies[t]].push_back({std::sqrt(4 / std::numbers::sqrt3 * area_m2), area_m2});
  }
  for (std::size_t b = 0; b < of_body.size(); ++b) {
    // Half of the surface has larger triangles. An equilateral triangle of the same area has this edge.
    std::sort(of_body[b].begin(), of_body[b].end(), [](const auto& x, const auto& y) { return x.edge_m < y.edge_m; });
    double area_m2 = 0, half_m2 = 0, edge_m = 0;
    for (const Triangle& one : of_body[b]) half_m2 += one.area_m2 / 2;
    for (std::size_t i = 0; i < of_body[b].size() && area_m2 < half_m2; ++i) {
      area_m2 += of_body[b][i].area_m2;
      edge_m = of_body[b][i].edge_m;
    }
    for (const ToolModel& tool : m.tools) {
      if (!(edge_m > thresholds::kCoarseEdge * tool.width_m)) continue;
      findings.push_back({.code = FindingCode::kCoarseSurface,
                          .value = edge_m / tool.width_m,
                          .limit = thresholds::kCoarseEdge,
                          .place = fmt::format("body '{}'.mesh", m.bodies[b].name),
                          .body = m.bodies[b].name,
                          .tool = tool.name,
                          .message = fmt::format(
                              "body '{}': half of its surface has triangles of more than {:.3g} mm, and tool '{}' is "
                              "{:.3g} mm wide, so the force at one depth depends on where it lies between the nodes",
                              m.bodies[b].name, 1e3 * edge_m, tool.name, 1e3 * tool.width_m),
                          .remedy = "take a finer mesh where the tool touches it, or a wider tool"});
    }
  }
}

/// Returns how far a point goes in a direction until it reaches a tool [m]; kLongestFallM if it does not.
template <class Kind>
double way_to(const physics::PlacedTool<double>& tool, const Point& from, const Point& direction) {
  const double near_m = 1e-3 * tool.radius_m;
  double way_m = 0;
  for (int i = 0; i < kFallingSteps && way_m < kLongestFallM; ++i) {
    const double distance_m = Kind::distance(tool, Point(from + way_m * direction));
    if (distance_m < near_m) return way_m;
    way_m += distance_m;
  }
  return kLongestFallM;
}

/// The motion of a free body until it meets something.
struct Fall {
  Point direction = Point::Zero();
  double speed_m_per_s = 0;          ///< at the start, in this direction
  double acceleration_m_per_s2 = 0;  ///< in this direction
  double damping_per_s = 0;          ///< Rayleigh's α

  /// Returns the speed after a way [m/s].
  double speed_after(double way_m) const {
    const double free = std::sqrt(speed_m_per_s * speed_m_per_s + 2 * acceleration_m_per_s2 * way_m);
    if (damping_per_s == 0) return free;
    return std::min(free, std::max(speed_m_per_s, acceleration_m_per_s2 / damping_per_s));
  }
};

void find_passed_tool(const ToolMistakeInput& m, const Fall& fall, std::size_t b, const std::vector<Point>& points,
                      std::vector<Finding>& findings) {
  Finding worst;
  for (const ToolModel& tool : m.tools) {
    if (tool.core_points == 0 || tool.contact_points == 0) continue;  // nothing passes a solid, and a blade cuts
    const physics::PlacedTool<double> placed = at_start(m, tool);
    double way_m = kLongestFallM;
    with_kind(tool, [&](auto tag) {
      for (const Point& p : points) {
        way_m = std::min(way_m, way_to<typename decltype(tag)::Type>(placed, p, fall.direction));
      }
    });
    if (way_m == kLongestFallM) continue;
    const double thickness_m = 2 * tool.radius_m;
    const double step_m = (fall.speed_after(way_m) + fall.acceleration_m_per_s2 * m.settings.dt_s) * m.settings.dt_s;
    const double value = step_m / thickness_m;
    if (!(value > thresholds::kPassingWay) || value <= worst.value) continue;
    const std::string& body = m.bodies[b].name;
    worst = {.code = FindingCode::kBodyPassesTool,
             .value = value,
             .limit = thresholds::kPassingWay,
             .place = "scene.stepping.dt_s",
             .body = body,
             .tool = tool.name,
             .message = fmt::format("body '{}' moves {:.2g} mm a step where it reaches tool '{}', which is {:.2g} mm "
                                    "thick, so it can pass through",
                                    body, 1e3 * step_m, tool.name, 1e3 * thickness_m),
             .remedy = fmt::format("take a dt_s of {:.2g} s or less, a thicker tool, or a solid (box, plane, mesh)",
                                   m.settings.dt_s * thresholds::kPassingWay / value)};
  }
  if (worst.value > 0) findings.push_back(worst);
}

void find_passed_tools(const ToolMistakeInput& m, const StartSurface& surface, std::vector<Finding>& findings) {
  if (m.settings.quasi_static()) return;
  for (std::size_t b = 0; b < m.bodies.size(); ++b) {
    const BodyModel& body = m.bodies[b];
    const bool hangs = std::any_of(m.attachments.begin(), m.attachments.end(), [&](const ReadAttachment& attachment) {
      return std::any_of(attachment.springs.begin(), attachment.springs.end(),
                         [&](const auto& spring) { return body.has_node(spring[0]) || body.has_node(spring[1]); });
    });
    if (body.fixed_node_count > 0 || hangs) continue;
    Point velocity = Point::Zero();
    std::vector<Point> points;
    for (std::size_t v = 0; v < surface.vertices.size(); ++v) {
      const std::uint32_t row = m.contact.surface_rows[v];
      if (!body.has_node(m.layout.node_of_row[row])) continue;
      points.push_back(surface.vertices[v]);
      if (m.initial_velocity.empty()) continue;
      for (std::size_t i = 0; i < 3; ++i) velocity[static_cast<Eigen::Index>(i)] += m.initial_velocity[4 * row + i];
    }
    velocity /= static_cast<double>(points.size());
    const std::size_t stride = points.size() / kFallingPoints + 1;
    std::vector<Point> sampled;
    for (std::size_t i = 0; i < points.size(); i += stride) sampled.push_back(points[i]);
    const double damping = m.damping[b].mass_per_s;
    const double gravity = m.settings.gravity_m_per_s2.norm();
    if (gravity > 0) {
      const Point down = m.settings.gravity_m_per_s2 / gravity;
      find_passed_tool(m, {down, std::max(velocity.dot(down), 0.0), gravity, damping}, b, sampled, findings);
    } else if (velocity.norm() > 0) {
      find_passed_tool(m, {velocity.normalized(), velocity.norm(), 0, damping}, b, sampled, findings);
    }
  }
}

}  // namespace

std::vector<Finding> find_mistakes_of_tools(const ToolMistakeInput& input) {
  std::vector<Finding> findings;
  if (input.tools.empty()) return findings;
  const StartSurface surface(input);
  for (const ToolModel& tool : input.tools) {
    if (tool.contact_points > 0) find_tool_inside(input, surface, tool, findings);  // a blade may begin inside
  }
  find_coarse_surfaces(input, surface, findings);
  find_passed_tools(input, surface, findings);
  return findings;
}

}  // namespace tensormass::model
