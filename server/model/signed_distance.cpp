#include "model/signed_distance.h"

#include <cmath>
#include <limits>
#include <vector>

#include "physics/contact/closest_point.h"

namespace tensormass::model {

using Eigen::Vector3d;

/// The closest facet found so far.
struct SignedDistance::Closest {
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

SignedDistance::SignedDistance(std::span<const Vector3d> vertices, std::span<const mesh::Triangle> triangles,
                               std::span<const std::array<std::uint32_t, 3>> neighbours)
    : tree_([&] {
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
            const std::uint32_t vertex = triangles[t][c], across = neighbours[t][c];
            facet.corners[c] = vertices[vertex];
            facet.normals[1 + c] = normals[t];
            if (across != mesh::kNone) facet.normals[1 + c] += normals[across];
            facet.normals[4 + c] = vertex_normals[vertex];
          }
        }
        return facets;
      }()) {}

double SignedDistance::at(const Vector3d& point) const {
  const auto closest = tree_.nearest<Closest>(point);
  return closest.side * std::sqrt(closest.squared_distance);
}

}  // namespace tensormass::model
