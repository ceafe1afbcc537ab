#include <algorithm>
#include <array>
#include <cmath>
#include <map>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "core/finding_kinds.h"
#include "model/compile_parts.h"
#include "model/signed_distance.h"

/// Finds bodies that overlap at rest.
///
/// Only pairs whose boxes meet are looked at: is a point of one surface deeper inside the other than surfaces that
/// touch? Between bodies with a contact all vertices are counted, because the text says what contact does with them.
/// For other pairs a sample is enough, and the first point that is inside ends the search.
namespace tensormass::model {

namespace {

/// Points of a surface that are looked at, for each pair of bodies without contact. A smaller overlap may be missed.
constexpr std::size_t kSamples = 1024;

/// A body's boundary at rest.
struct RestSurface {
  std::vector<Eigen::Vector3d> vertices;
  std::vector<mesh::Triangle> triangles;
  std::vector<std::array<std::uint32_t, 3>> neighbours;  ///< as in mesh::Surface
  std::optional<SignedDistance> distance;                ///< when it is asked for

  double mean_edge_m() const {
    double sum_m = 0;
    for (const mesh::Triangle& t : triangles) {
      for (std::size_t i = 0; i < 3; ++i) sum_m += (vertices[t[i]] - vertices[t[(i + 1) % 3]]).norm();
    }
    return sum_m / (3 * static_cast<double>(triangles.size()));
  }
  /// Returns how deep a point is inside [m]; negative outside.
  double depth_m(const Eigen::Vector3d& point) {
    if (!distance) distance.emplace(vertices, triangles, neighbours);
    return -distance->at(point);
  }
};

/// Nodes of one body inside another.
struct Inside {
  std::size_t count = 0;
  double deepest_m = 0;
};

class Overlaps {
 public:
  explicit Overlaps(const OverlapInput& input)
      : in_(input), bodies_(input.bodies.bodies), boxes_(bodies_.size()), surfaces_(bodies_.size()) {
    for (std::size_t b = 0; b < boxes_.size(); ++b) {
      for (const Eigen::Vector3d& node : bodies_[b].mesh.nodes) boxes_[b].extend(node);
    }
    for (const BodyContactModel& contact : input.contacts) {
      contacts_.emplace(std::minmax(contact.body, contact.other), &contact);
    }
  }

  std::vector<Finding> find() {
    for (std::size_t body = 0; body < boxes_.size(); ++body) {
      for (std::size_t other = body + 1; other < boxes_.size(); ++other) {
        if (!boxes_[body].intersects(boxes_[other])) continue;
        const auto contact = contacts_.find(std::minmax(body, other));
        if (contact == contacts_.end()) {
          sample(body, other);
        } else {
          count(*contact->second);
        }
      }
    }
    return std::move(findings_);
  }

 private:
  using Pair = std::pair<std::size_t, std::size_t>;

  /// Counts the vertices of either body that are inside the other.
  void count(const BodyContactModel& contact) {
    std::string nodes;
    double deepest_m = 0;
    for (const auto& [of, in] : {Pair(contact.body, contact.other), Pair(contact.other, contact.body)}) {
      const Inside inside = vertices_inside(of, in, contact.distance_m);
      deepest_m = std::max(deepest_m, inside.deepest_m);
      if (inside.count == 0) continue;
      const bool one = inside.count == 1;
      nodes += fmt::format("{}{} {} of '{}' {} inside '{}'", nodes.empty() ? "" : " and ", inside.count,
                           one ? "node" : "nodes", name(of), one ? "lies" : "lie", name(in));
    }
    if (nodes.empty()) return;
    const char* then = deepest_m < contact.reach_m ? "Contact pushes them apart in the first steps"
                                                   : "Nodes deeper than the contact's reach_m stay inside";
    add(contact.body, contact.other, deepest_m, contact.distance_m,
        fmt::format("{}, the deepest by {:.3g} mm. {}", nodes, 1e3 * deepest_m, then), "move one of the bodies");
  }

  Inside vertices_inside(std::size_t of, std::size_t in, double least_m) {
    Inside out;
    for (const Eigen::Vector3d& vertex : surface(of).vertices) {
      if (!boxes_[in].contains(vertex)) continue;
      const double depth_m = surface(in).depth_m(vertex);
      if (!(depth_m > least_m)) continue;
      ++out.count;
      out.deepest_m = std::max(out.deepest_m, depth_m);
    }
    return out;
  }

  /// Looks for one point of either body inside the other.
  void sample(std::size_t body, std::size_t other) {
    const double least_m =
        thresholds::kOverlapInEdges * std::min(surface(body).mean_edge_m(), surface(other).mean_edge_m());
    for (const auto& [of, in] : {Pair(body, other), Pair(other, body)}) {
      if (only_touches(boxes_[of], boxes_[in], least_m)) continue;
      const double depth_m = first_depth_m(of, in, least_m);
      if (!(depth_m > 0)) continue;
      add(body, other, depth_m, least_m,
          fmt::format("'{}' lies inside '{}' by {:.3g} mm or more. Each moves as if the other were not there", name(of),
                      name(in), 1e3 * depth_m),
          "move one of the bodies, make one mesh of both, or give a body_contacts entry");
      return;
    }
  }

  /// Returns whether no point of both boxes is deeper than least_m inside the second one: it leaves that one through a
  /// side that is near everywhere.
  static bool only_touches(const Eigen::AlignedBox3d& of, const Eigen::AlignedBox3d& in, double least_m) {
    for (int axis = 0; axis < 3; ++axis) {
      if (of.max()[axis] - in.min()[axis] <= least_m || in.max()[axis] - of.min()[axis] <= least_m) return true;
    }
    return false;
  }

  /// Returns the depth of the first sampled point that is deeper than least_m; 0 if there is none.
  double first_depth_m(std::size_t of, std::size_t in, double least_m) {
    const RestSurface& points = surface(of);
    const std::size_t vertices = points.vertices.size();
    std::vector<Eigen::Vector3d> near;
    for (std::size_t i = 0; i < vertices + points.triangles.size(); ++i) {
      const Eigen::Vector3d point = i < vertices ? points.vertices[i] : middle(points, points.triangles[i - vertices]);
      if (boxes_[in].contains(point)) near.push_back(point);
    }
    const std::size_t stride = near.size() / kSamples + 1;
    for (std::size_t i = 0; i < near.size(); i += stride) {
      const double depth_m = surface(in).depth_m(near[i]);
      if (depth_m > least_m) return depth_m;
    }
    return 0;
  }
  static Eigen::Vector3d middle(const RestSurface& of, const mesh::Triangle& t) {
    return (of.vertices[t[0]] + of.vertices[t[1]] + of.vertices[t[2]]) / 3;
  }

  const std::string& name(std::size_t body) const { return bodies_[body].name; }

  void add(std::size_t body, std::size_t other, double value_m, double limit_m, const std::string& what,
           std::string remedy) {
    findings_.push_back(
        {.code = FindingCode::kOverlap,
         .value = value_m,
         .limit = limit_m,
         .place = fmt::format("body '{}'.mesh", name(other)),
         .body = name(body),
         .other = name(other),
         .message = fmt::format("bodies '{}' and '{}' overlap at rest: {}", name(body), name(other), what),
         .remedy = std::move(remedy)});
  }

  RestSurface& surface(std::size_t body) {
    std::optional<RestSurface>& out = surfaces_[body];
    if (out) return *out;
    if (!in_.boundaries.has(body) && in_.contact.triangle_count() > 0) {
      take_contact_surfaces();
    } else {
      const mesh::Surface& of = in_.boundaries.of(body);
      out.emplace(RestSurface{{}, of.triangles, of.neighbours, {}});
      for (const std::uint32_t node : of.nodes) out->vertices.push_back(bodies_[body].mesh.nodes[node]);
    }
    return *out;
  }

  /// Takes the boundaries of the bodies that are not known yet from the contact surface, which costs much less than to
  /// make them again.
  void take_contact_surfaces() {
    const ContactSurface& contact = in_.contact;
    std::vector<std::uint32_t> place(contact.surface_rows.size());  // by vertex, among those of its body
    std::vector<std::size_t> bodies(place.size());
    std::vector<RestSurface> all(surfaces_.size());
    for (std::size_t vertex = 0; vertex < place.size(); ++vertex) {
      const std::uint32_t node = in_.layout.node_of_row[contact.surface_rows[vertex]];
      bodies[vertex] = body_of_node(bodies_, node);
      place[vertex] = static_cast<std::uint32_t>(all[bodies[vertex]].vertices.size());
      all[bodies[vertex]].vertices.push_back(in_.bodies.merged.nodes[node]);
    }
    std::vector<std::uint32_t> triangle_place(contact.outer_count());
    for (std::size_t t = 0; t < triangle_place.size(); ++t) {
      const std::uint32_t* corners = &contact.vertex_of_corner[3 * t];
      RestSurface& of = all[bodies[corners[0]]];
      triangle_place[t] = static_cast<std::uint32_t>(of.triangles.size());
      of.triangles.push_back({place[corners[0]], place[corners[1]], place[corners[2]]});
    }
    for (std::size_t t = 0; t < triangle_place.size(); ++t) {
      auto& neighbours = all[bodies[contact.vertex_of_corner[3 * t]]].neighbours.emplace_back();
      for (std::size_t i = 0; i < 3; ++i) {
        const std::uint32_t across = contact.triangle_neighbours[3 * t + i];
        neighbours[i] = across < triangle_place.size() ? triangle_place[across] : mesh::kNone;
      }
    }
    for (std::size_t b = 0; b < all.size(); ++b) {
      if (!surfaces_[b]) surfaces_[b] = std::move(all[b]);
    }
  }

  const OverlapInput& in_;
  const std::vector<ReadBody>& bodies_;
  std::vector<Finding> findings_;
  std::vector<Eigen::AlignedBox3d> boxes_;
  std::vector<std::optional<RestSurface>> surfaces_;  // by body, when they are asked for
  std::map<Pair, const BodyContactModel*> contacts_;
};

}  // namespace

std::vector<Finding> find_overlaps(const OverlapInput& input) {
  if (input.bodies.bodies.size() < 2) return {};
  return Overlaps(input).find();
}

}  // namespace tensormass::model
