#include "mesh/curve.h"

#include <cmath>
#include <random>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "mesh/geometry.h"
#include "mesh/surface.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

/// A quarter of a ring with radii 1 and 2 and height 1, in cells × cells × cells cells. Its corners lie on the ring.
Mesh quarter_ring(std::uint32_t cells) {
  Mesh mesh = testing::unit_grid(cells);
  for (Vector3d& x : mesh.nodes) {
    const double angle = 0.5 * M_PI * (1 - x.x()), radius = 1 + x.y();
    x = {radius * std::cos(angle), radius * std::sin(angle), x.z()};
  }
  return mesh;
}

double radius(const Vector3d& x) { return std::hypot(x.x(), x.y()); }

struct Skin {
  std::vector<Vector3d> vertices;
  std::vector<Triangle> triangles;
};

Skin skin_of(const Mesh& mesh) {
  const Surface surface = boundary(mesh);
  Skin skin{{}, surface.triangles};
  for (const std::uint32_t node : surface.nodes) skin.vertices.push_back(mesh.nodes[node]);
  return skin;
}

/// Adds a triangle so small that it is almost a point.
void add_point(Skin& skin, const Vector3d& x) {
  const auto first = static_cast<std::uint32_t>(skin.vertices.size());
  skin.vertices.insert(skin.vertices.end(), {x, x + Vector3d(1e-9, 0, 0), x + Vector3d(0, 1e-9, 0)});
  skin.triangles.push_back({first, first + 1, first + 2});
}

ElevatedMesh elevated(const Mesh& mesh) { return elevate(mesh, "here").value(); }

/// Returns whether the added node lies on the outer side of the ring, away from the side's rim. The rim is also the rim
/// of flat sides, on which its edges lie already.
bool is_outer(const ElevatedMesh& ring, std::uint32_t node, std::uint32_t first_added) {
  const auto [a, b] = ring.middle_of[node - first_added];
  const auto is_inside = [&](const Vector3d& x) {
    return radius(x) > 1.999 && x.x() > 1e-9 && x.y() > 1e-9 && x.z() > 0 && x.z() < 1;
  };
  return is_inside(ring.mesh.nodes[a]) && is_inside(ring.mesh.nodes[b]);
}

TEST(Curve, EdgesOfABoundaryFollowAFineSurface) {
  const Mesh linear = quarter_ring(4);
  const auto first_added = static_cast<std::uint32_t>(linear.nodes.size());
  const ElevatedMesh straight = elevated(linear);
  ElevatedMesh curved = straight;
  const Skin skin = skin_of(quarter_ring(64));
  const Curved result = curve(curved, skin.vertices, skin.triangles);
  EXPECT_EQ(result.straight, 0u);
  // A closed triangulated surface has half as many edges as it has sides of triangles: 6 × 16 × 2 triangles.
  EXPECT_EQ(result.moved, 6u * 16 * 2 * 3 / 2);
  double off_before = 0, off_after = 0;
  for (std::uint32_t node = first_added; node < curved.mesh.nodes.size(); ++node) {
    if (!is_outer(straight, node, first_added)) continue;
    off_before = std::max(off_before, std::abs(radius(straight.mesh.nodes[node]) - 2));
    off_after = std::max(off_after, std::abs(radius(curved.mesh.nodes[node]) - 2));
  }
  EXPECT_GT(off_before, 0.03);
  EXPECT_LT(off_after, off_before / 50);
  const auto before = admit(straight.mesh, "ring"), after = admit(curved.mesh, "ring");
  ASSERT_TRUE(after) << after.error().message;
  const double volume = 0.75 * M_PI;
  EXPECT_LT(std::abs(after->volume_m3 - volume), std::abs(before->volume_m3 - volume) / 5);
}

TEST(Curve, CornersAndInnerNodesStay) {
  const ElevatedMesh straight = elevated(quarter_ring(3));
  ElevatedMesh curved = straight;
  const Skin skin = skin_of(quarter_ring(24));
  curve(curved, skin.vertices, skin.triangles);
  std::vector<bool> is_middle_of_boundary(straight.mesh.nodes.size(), false);
  for (const BoundaryFace& face : boundary_faces(straight.mesh)) {
    for (std::size_t k = 3; k < 6; ++k) is_middle_of_boundary[face.nodes[k]] = true;
  }
  for (std::size_t node = 0; node < straight.mesh.nodes.size(); ++node) {
    if (is_middle_of_boundary[node]) continue;
    EXPECT_EQ(curved.mesh.nodes[node], straight.mesh.nodes[node]) << node;
  }
  EXPECT_EQ(curved.middle_of, straight.middle_of);
}

/// The surface is a sheet 0.1 m outside of the ring. Edges bend as it does and keep the distance.
TEST(Curve, EdgesBesideTheSurfaceBendAsItDoes) {
  const Mesh linear = quarter_ring(4);
  const auto first_added = static_cast<std::uint32_t>(linear.nodes.size());
  const ElevatedMesh straight = elevated(linear);
  ElevatedMesh curved = straight;
  Skin sheet;
  constexpr std::uint32_t kCells = 128;
  for (std::uint32_t i = 0; i <= kCells; ++i) {
    const double angle = 0.5 * M_PI * (1.5 * i / kCells - 0.25);
    for (const double z : {-1.0, 2.0}) sheet.vertices.emplace_back(2.1 * std::cos(angle), 2.1 * std::sin(angle), z);
  }
  for (std::uint32_t i = 0; i < 2 * kCells; i += 2) {
    sheet.triangles.push_back({i, i + 2, i + 1});
    sheet.triangles.push_back({i + 2, i + 3, i + 1});
  }
  curve(curved, sheet.vertices, sheet.triangles);
  int checked = 0;
  for (std::uint32_t node = first_added; node < curved.mesh.nodes.size(); ++node) {
    if (!is_outer(straight, node, first_added) || radius(straight.mesh.nodes[node]) > 1.99) continue;
    const double off_before = std::abs(radius(straight.mesh.nodes[node]) - 2);
    EXPECT_LT(std::abs(radius(curved.mesh.nodes[node]) - 2), off_before / 5) << node;
    ++checked;
  }
  EXPECT_GE(checked, 10);
}

/// The surface is a few points: the element's corners, and one deep below the middle of each edge.
TEST(Curve, AnElementThatWouldFoldStaysStraight) {
  const Mesh linear = tests::reference_element(Shape::kTetrahedron);
  const ElevatedMesh straight = elevated(linear);
  const Vector3d centre = 0.25 * (linear.nodes[0] + linear.nodes[1] + linear.nodes[2] + linear.nodes[3]);
  Skin skin;
  for (const Vector3d& corner : linear.nodes) add_point(skin, corner);
  for (const auto& [a, b] : straight.middle_of) {
    const Vector3d edge = linear.nodes[b] - linear.nodes[a], middle = 0.5 * (linear.nodes[a] + linear.nodes[b]);
    const Vector3d along = edge.normalized(), inward = centre - middle;
    add_point(skin, middle + 0.45 * edge.norm() * (inward - along * along.dot(inward)).normalized());
  }
  ElevatedMesh curved = straight;
  const Curved result = curve(curved, skin.vertices, skin.triangles);
  EXPECT_EQ(result.moved, 0u);
  EXPECT_EQ(result.straight, 6u);
  EXPECT_EQ(curved.mesh.nodes, straight.mesh.nodes);
}

/// The skin covers a part of one flat side, and the ways to it lead along the sides or through the body.
TEST(Curve, BeyondTheRimOfASurfaceEdgesStayStraight) {
  const ElevatedMesh straight = elevated(testing::unit_grid(3));
  ElevatedMesh curved = straight;
  Skin skin;
  skin.vertices = {{0.2, 0.2, 1}, {0.7, 0.3, 1}, {0.4, 0.8, 1}};
  skin.triangles = {{0, 1, 2}};
  curve(curved, skin.vertices, skin.triangles);
  for (std::size_t node = 0; node < straight.mesh.nodes.size(); ++node) {
    EXPECT_LT((curved.mesh.nodes[node] - straight.mesh.nodes[node]).norm(), 1e-15) << node;
  }
}

TEST(Curve, EveryElementIsSoundUnderARoughSurface) {
  const ElevatedMesh straight = elevated(testing::unit_grid(4));
  const double least_m3 = kMinCurvedJacobian / (6.0 * 4 * 4 * 4) * (1 - 1e-12);  // six tetrahedra a cell
  std::mt19937 random(1);
  std::uint32_t moved = 0, stayed = 0;
  for (int surface = 0; surface < 20; ++surface) {
    Mesh rough = testing::unit_grid(11);
    for (Vector3d& x : rough.nodes) {
      if (x.z() == 1) x.z() += 0.5 * (random() / double{0xFFFFFFFFu} - 0.5);
    }
    const Skin skin = skin_of(rough);
    ElevatedMesh curved = straight;
    const Curved result = curve(curved, skin.vertices, skin.triangles);
    moved += result.moved;
    stayed += result.straight;
    ASSERT_TRUE(admit(curved.mesh, "rough")) << admit(curved.mesh, "rough").error().message;
    for_each_element(curved.mesh, [&](std::uint32_t element, const Topology& shape, auto nodes) {
      EXPECT_GE(element_geometry(curved.mesh, shape, nodes).min_jacobian_m3, least_m3) << element;
      EXPECT_GE(min_jacobian_of_points_m3(curved.mesh, nodes), least_m3) << element;
    });
  }
  EXPECT_EQ(moved + stayed, 20u * 6 * 16 * 2 * 3 / 2);
  EXPECT_GT(stayed, 10u);
}

TEST(Curve, ATriangleWithoutAreaIsHarmless) {
  Skin skin = skin_of(quarter_ring(8));
  skin.triangles.push_back({0, 1, 0});
  skin.vertices.push_back(skin.vertices[0]);
  skin.triangles.push_back({0, static_cast<std::uint32_t>(skin.vertices.size() - 1), 1});
  ElevatedMesh curved = elevated(quarter_ring(2));
  curve(curved, skin.vertices, skin.triangles);
  for (const Vector3d& x : curved.mesh.nodes) EXPECT_TRUE(x.allFinite());
}

}  // namespace
}  // namespace tensormass::mesh
