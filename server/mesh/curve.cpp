#include "mesh/curve.h"

#include <algorithm>
#include <array>
#include <limits>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/box_tree.h"
#include "mesh/geometry.h"
#include "mesh/shapes.h"
#include "mesh/surface.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

struct SurfaceTriangle {
  std::array<Vector3d, 3> corners;
};

/// The nearest point found so far. Comparisons are false for NaN, which a triangle without area may give.
struct NearestPoint {
  double squared_distance = std::numeric_limits<double>::infinity();
  Vector3d point = Vector3d::Constant(std::numeric_limits<double>::infinity());

  void offer(const SurfaceTriangle& triangle, const Vector3d& to) {
    const auto& [a, b, c] = triangle.corners;
    const Vector3d near = nearest_on_triangle(to, a, b, c);
    const double squared = (near - to).squaredNorm();
    if (!(squared < squared_distance)) return;
    squared_distance = squared;
    point = near;
  }
};

/// An added node on the boundary, and the area-weighted normal of the faces around it.
struct BoundaryMiddle {
  std::uint32_t node;
  Vector3d normal;
};

/// Returns the added nodes that lie on the boundary, ascending.
std::vector<BoundaryMiddle> added_on_boundary(const Mesh& mesh, std::uint32_t first_added) {
  std::vector<Vector3d> normals(mesh.nodes.size() - first_added, Vector3d::Zero());
  std::vector<bool> is_found(normals.size(), false);
  for (const BoundaryFace& face : boundary_faces(mesh)) {
    const auto x = [&](std::size_t corner) -> const Vector3d& { return mesh.nodes[face.nodes[corner]]; };
    const Vector3d normal = (x(1) - x(0)).cross(x(2) - x(0));
    for (const std::uint32_t node : face.nodes) {
      if (node < first_added) continue;
      normals[node - first_added] += normal;
      is_found[node - first_added] = true;
    }
  }
  std::vector<BoundaryMiddle> found;
  for (std::uint32_t i = 0; i < normals.size(); ++i) {
    if (is_found[i]) found.push_back({first_added + i, normals[i].normalized()});
  }
  return found;
}

bool is_sound(const Mesh& mesh, std::span<const std::uint32_t> nodes) {
  const auto x = [&](std::size_t corner) -> const Vector3d& { return mesh.nodes[nodes[corner]]; };
  const double least_m3 = kMinCurvedJacobian * six_volumes(x(0), x(1), x(2), x(3)) / 6.0;
  return element_geometry(mesh, topology(Shape::kQuadraticTetrahedron), nodes).min_jacobian_m3 >= least_m3 &&
         min_jacobian_of_points_m3(mesh, nodes) >= least_m3;
}

}  // namespace

Curved curve(ElevatedMesh& elevated, std::span<const Vector3d> vertices, std::span<const Triangle> triangles) {
  Mesh& mesh = elevated.mesh;
  const auto first_added = static_cast<std::uint32_t>(mesh.nodes.size() - elevated.middle_of.size());
  std::vector<SurfaceTriangle> items;
  items.reserve(triangles.size());
  for (const auto& [a, b, c] : triangles) items.push_back({{vertices[a], vertices[b], vertices[c]}});
  const BoxTree<SurfaceTriangle> tree(std::move(items));
  const auto way = [&](const Vector3d& x) -> Vector3d {
    const auto nearest = tree.nearest<NearestPoint>(x);
    return nearest.point - x;
  };

  const std::vector<BoundaryMiddle> on_boundary = added_on_boundary(mesh, first_added);
  std::vector<Vector3d> ways(first_added);  // to the surface, from each end
  std::vector<bool> known(first_added, false);
  std::vector<bool> moved(mesh.nodes.size(), false);
  const auto middle = [&](std::uint32_t node) -> Vector3d {
    const auto [a, b] = elevated.middle_of[node - first_added];
    return 0.5 * (mesh.nodes[a] + mesh.nodes[b]);
  };
  for (const auto& [node, normal] : on_boundary) {
    const auto [a, b] = elevated.middle_of[node - first_added];
    for (const std::uint32_t end : {a, b}) {
      if (!known[end]) ways[end] = way(mesh.nodes[end]);
      known[end] = true;
    }
    const Vector3d own = way(mesh.nodes[node]);
    const double farthest = std::max({own.norm(), ways[a].norm(), ways[b].norm()});
    // Also false if there is no nearest point, because no triangle has an area.
    if (!(farthest <= kMaxCurvedDistance * (mesh.nodes[a] - mesh.nodes[b]).norm())) continue;
    mesh.nodes[node] += normal * normal.dot(own - 0.5 * (ways[a] + ways[b]));
    moved[node] = true;
  }

  // Each pass moves nodes back, so it ends at the latest when all elements are straight again.
  const auto nodes_of = element_nodes(mesh);
  const Rows elements = node_elements(mesh);
  std::vector<std::uint32_t> suspects;
  const auto suspect_those_at = [&](std::uint32_t node) {
    suspects.insert(suspects.end(), elements[node].begin(), elements[node].end());
  };
  for (const BoundaryMiddle& middle_node : on_boundary) suspect_those_at(middle_node.node);
  while (!suspects.empty()) {
    std::sort(suspects.begin(), suspects.end());
    suspects.erase(std::unique(suspects.begin(), suspects.end()), suspects.end());
    std::vector<std::uint32_t> folded;
    std::copy_if(suspects.begin(), suspects.end(), std::back_inserter(folded),
                 [&](std::uint32_t element) { return !is_sound(mesh, nodes_of[element]); });
    suspects.clear();
    for (const std::uint32_t element : folded) {
      for (const std::uint32_t node : nodes_of[element]) {
        if (!moved[node]) continue;
        moved[node] = false;
        mesh.nodes[node] = middle(node);
        suspect_those_at(node);
      }
    }
  }
  Curved result;
  result.moved = static_cast<std::uint32_t>(std::count(moved.begin(), moved.end(), true));
  result.straight = static_cast<std::uint32_t>(on_boundary.size()) - result.moved;
  return result;
}

}  // namespace tensormass::mesh
