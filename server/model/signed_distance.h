#pragma once

#include <array>
#include <cstdint>
#include <span>

#include <Eigen/Core>

#include "mesh/box_tree.h"
#include "mesh/mesh.h"

namespace tensormass::model {

/// Distance to a closed triangle surface: negative inside. The sign is that of the angle-weighted pseudonormal at the
/// closest point (Bærentzen, Aanæs 2005).
class SignedDistance {
 public:
  /// neighbours: by triangle, the one across the edge from corner i to corner i + 1, or mesh::kNone. Beside an edge
  /// without a neighbour the sign can be wrong. Triangles are counter-clockwise seen from outside; at least one.
  SignedDistance(std::span<const Eigen::Vector3d> vertices, std::span<const mesh::Triangle> triangles,
                 std::span<const std::array<std::uint32_t, 3>> neighbours);

  double at(const Eigen::Vector3d& point) const;

 private:
  /// A triangle with the outward normals of its parts.
  struct Facet {
    std::array<Eigen::Vector3d, 3> corners;
    std::array<Eigen::Vector3d, 7> normals;  // by physics::TriangleFeature, not normalized
  };
  struct Closest;

  mesh::BoxTree<Facet> tree_;
};

}  // namespace tensormass::model
