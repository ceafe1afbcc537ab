#include "model/distance_field.h"

#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include <fmt/format.h>

#include "mesh/box_tree.h"
#include "physics/contact/closest_point.h"
#include "physics/tool/mesh_solid.h"

namespace tensormass::model {
namespace {

using Eigen::Vector3d;
using mesh::Triangle;
using Edge = std::pair<std::uint32_t, std::uint32_t>;  // from, to

/// A surface that encloses less, relative to the cube of its diagonal, is flat.
constexpr double kLeastRelativeVolume = 1e-9;

/// A triangle with the outward normals of its parts.
struct Facet {
  std::array<Vector3d, 3> corners;
  std::array<Vector3d, 7> normals;  // by physics::TriangleFeature, not normalized
};

/// The closest facet found so far.
struct Closest {
  double squared_distance = std::numeric_limits<double>::infinity();
  double side = 1;

  void offer(const Facet& facet, const Vector3d& point) {
    const auto& x = facet.corners;
    const auto [weights, feature] = physics::closest_point_on_triangle<double>(point, x[0], x[1], x[2]);
    const Vector3d offset = point - (x[0] * weights[0] + x[1] * weights[1] + x[2] * weights[2]);
    if (!(offset.squaredNorm() < squared_distance)) return;
    squared_distance = offset.squaredNorm();
    side = facet.normals[static_cast<std::size_t>(feature)].dot(offset) < 0 ? -1 : 1;
  }
};

/// Returns the triangle of each directed edge. Errors: the surface is not closed.
Result<std::map<Edge, std::size_t>> edges_of(std::span<const Triangle> triangles, std::string_view what) {
  std::map<Edge, std::size_t> edges;
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    for (std::size_t c = 0; c < 3; ++c) {
      const Edge edge{triangles[t][c], triangles[t][(c + 1) % 3]};
      if (!edges.emplace(edge, t).second) {
        return invalid(
            fmt::format("{}: two triangles run along the edge from vertex {} to vertex {} in the same "
                        "direction; give a surface whose triangles all turn the same way",
                        what, edge.first, edge.second));
      }
    }
  }
  for (const auto& [edge, triangle] : edges) {
    if (edges.contains({edge.second, edge.first})) continue;
    return invalid(
        fmt::format("{}: the surface is open at the edge between vertices {} and {}; a solid needs a closed "
                    "surface, whose triangles share their vertices",
                    what, edge.first, edge.second));
  }
  return edges;
}

double volume_of(std::span<const Vector3d> vertices, std::span<const Triangle> triangles) {
  double six_volumes = 0;
  for (const Triangle& t : triangles) six_volumes += vertices[t[0]].dot(vertices[t[1]].cross(vertices[t[2]]));
  return six_volumes / 6;
}

std::vector<Facet> facets_of(std::span<const Vector3d> vertices, std::span<const Triangle> triangles,
                             const std::map<Edge, std::size_t>& edges) {
  std::vector<Vector3d> normals(triangles.size()), vertex_normals(vertices.size(), Vector3d::Zero());
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    const auto x = [&](std::size_t c) { return vertices[triangles[t][c % 3]]; };
    normals[t] = (x(1) - x(0)).cross(x(2) - x(0)).normalized();
    for (std::size_t c = 0; c < 3; ++c) {
      const Vector3d a = x(c + 1) - x(c), b = x(c + 2) - x(c);
      vertex_normals[triangles[t][c]] += normals[t] * std::atan2(a.cross(b).norm(), a.dot(b));
    }
  }
  std::vector<Facet> facets(triangles.size());
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    Facet& facet = facets[t];
    facet.normals[0] = normals[t];
    for (std::size_t c = 0; c < 3; ++c) {
      const std::uint32_t from = triangles[t][c], to = triangles[t][(c + 1) % 3];
      facet.corners[c] = vertices[from];
      facet.normals[1 + c] = normals[t] + normals[edges.at({to, from})];
      facet.normals[4 + c] = vertex_normals[from];
    }
  }
  return facets;
}

}  // namespace

Result<DistanceField> sample_distance(std::span<const Vector3d> vertices, std::span<const Triangle> triangles,
                                      std::string_view what) {
  TM_ASSIGN_OR_RETURN(edges, edges_of(triangles, what));
  DistanceField out;
  for (const Triangle& triangle : triangles) {
    for (const std::uint32_t vertex : triangle) {
      out.box.extend(vertices[vertex]);
      out.reach_m = std::max(out.reach_m, vertices[vertex].norm());
    }
  }
  const double volume_m3 = volume_of(vertices, triangles);
  if (!(volume_m3 > kLeastRelativeVolume * std::pow(out.box.diagonal().norm(), 3))) {
    return invalid(
        fmt::format("{}: the surface encloses {:.3g} m³; it must not be flat, and its triangles must be "
                    "counter-clockwise seen from outside",
                    what, volume_m3));
  }
  const double spacing = out.box.sizes().maxCoeff() / kDistanceCubes;
  const Vector3d origin = out.box.min() - Vector3d::Constant(kDistanceMargin * spacing);
  std::array<std::uint32_t, 3> counts;
  for (int c = 0; c < 3; ++c) {
    const double cubes = std::ceil(out.box.sizes()[c] / spacing) + 2 * kDistanceMargin;
    counts[static_cast<std::size_t>(c)] = static_cast<std::uint32_t>(cubes) + 1;
  }
  const mesh::BoxTree<Facet> tree(facets_of(vertices, triangles, edges));
  out.samples.reserve(physics::SampledDistance::kHeader + std::size_t{counts[0]} * counts[1] * counts[2]);
  for (const std::uint32_t count : counts) out.samples.push_back(static_cast<float>(count));
  for (const double header : {spacing, origin.x(), origin.y(), origin.z()}) {
    out.samples.push_back(static_cast<float>(header));
  }
  for (std::uint32_t k = 0; k < counts[2]; ++k) {
    for (std::uint32_t j = 0; j < counts[1]; ++j) {
      for (std::uint32_t i = 0; i < counts[0]; ++i) {
        const auto closest = tree.nearest<Closest>(origin + spacing * Vector3d(i, j, k));
        out.samples.push_back(static_cast<float>(closest.side * std::sqrt(closest.squared_distance)));
      }
    }
  }
  return out;
}

}  // namespace tensormass::model
