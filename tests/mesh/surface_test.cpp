#include "mesh/surface.h"

#include <cmath>
#include <map>
#include <set>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;

class Boundary : public testing::EveryMesh {
 protected:
  const Mesh mesh_ = testing::random_mesh(seed_, 3, 0.5, shape_);
  const std::vector<BoundaryFace> faces_ = boundary_faces(mesh_);
  const Surface surface_ = boundary(mesh_);

  Triangle mesh_triangle(std::uint32_t i) const {
    const Triangle& t = surface_.triangles[i];
    return {surface_.nodes[t[0]], surface_.nodes[t[1]], surface_.nodes[t[2]]};
  }
  Vector3d area(const Triangle& t) const {
    return 0.5 * (mesh_.nodes[t[1]] - mesh_.nodes[t[0]]).cross(mesh_.nodes[t[2]] - mesh_.nodes[t[0]]);
  }
  static constexpr double kRoot = 0.77459666924148338;
  static constexpr double kGauss[3][2] = {
      {0.5 - 0.5 * kRoot, 5.0 / 18.0}, {0.5, 8.0 / 18.0}, {0.5 + 0.5 * kRoot, 5.0 / 18.0}};
  /// Returns ∫ x·dA / 3 over a quadratic quadrilateral. The integrand has degree 5 in r and in s. The face is quadratic
  /// along each line r = const., so three points of the line give it: on two sides, and between their middles.
  double quadratic_quadrilateral_m3(const FaceNodes& n) const {
    const auto along = [](double t, const Vector3d& a, const Vector3d& m, const Vector3d& b) -> Vector3d {
      return (1.0 - t) * (1.0 - 2.0 * t) * a + 4.0 * t * (1.0 - t) * m + t * (2.0 * t - 1.0) * b;
    };
    const auto slope = [](double t, const Vector3d& a, const Vector3d& m, const Vector3d& b) -> Vector3d {
      return (4.0 * t - 3.0) * a + (4.0 - 8.0 * t) * m + (4.0 * t - 1.0) * b;
    };
    const auto x = [&](std::size_t i) -> const Vector3d& { return mesh_.nodes[n[i]]; };
    const Vector3d centre = 0.5 * (x(4) + x(5) + x(6) + x(7)) - 0.25 * (x(0) + x(1) + x(2) + x(3));
    double sum = 0.0;
    for (const auto& [r, weight_r] : kGauss) {
      for (const auto& [s, weight_s] : kGauss) {
        const Vector3d at =
            along(s, along(r, x(0), x(4), x(1)), along(r, x(7), centre, x(5)), along(r, x(3), x(6), x(2)));
        const Vector3d along_r =
            along(s, slope(r, x(0), x(4), x(1)), slope(r, x(7), centre, x(5)), slope(r, x(3), x(6), x(2)));
        const Vector3d along_s =
            slope(s, along(r, x(0), x(4), x(1)), along(r, x(7), centre, x(5)), along(r, x(3), x(6), x(2)));
        sum += weight_r * weight_s * at.dot(along_r.cross(along_s)) / 3.0;
      }
    }
    return sum;
  }
  /// Returns ∫ x·dA / 3 over a quadratic triangle. The integrand has degree 4 in (r, s); a product of Gauss rules is
  /// exact.
  double quadratic_triangle_m3(const FaceNodes& n) const {
    double sum = 0.0;
    for (const auto& [u, weight_u] : kGauss) {
      for (const auto& [v, weight_v] : kGauss) {
        const double l[3] = {1.0 - u - v * (1.0 - u), u, v * (1.0 - u)};
        Vector3d x = Vector3d::Zero(), along_r = Vector3d::Zero(), along_s = Vector3d::Zero();
        for (std::size_t i = 0; i < 3; ++i) {
          const Vector3d &corner = mesh_.nodes[n[i]], &middle = mesh_.nodes[n[3 + i]];
          const std::size_t next = (i + 1) % 3;
          const double dr[3] = {-1, 1, 0}, ds[3] = {-1, 0, 1};
          x += l[i] * (2.0 * l[i] - 1.0) * corner + 4.0 * l[i] * l[next] * middle;
          along_r += (4.0 * l[i] - 1.0) * dr[i] * corner + 4.0 * (dr[i] * l[next] + l[i] * dr[next]) * middle;
          along_s += (4.0 * l[i] - 1.0) * ds[i] * corner + 4.0 * (ds[i] * l[next] + l[i] * ds[next]) * middle;
        }
        sum += weight_u * weight_v * (1.0 - u) * x.dot(along_r.cross(along_s)) / 3.0;
      }
    }
    return sum;
  }
  double cone_m3(const Triangle& t) const { return mesh_.nodes[t[0]].dot(area(t)) / 3.0; }
};

TEST_P(Boundary, IsEveryFaceOfExactlyOneElement) {
  // Brute force: keeps a face if no other element has the same nodes.
  using Key = std::set<std::uint32_t>;
  std::map<Key, int> uses;
  std::vector<BoundaryFace> faces;
  for_each_element(mesh_, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (std::uint32_t f = 0; f < shape.faces.size(); ++f) {
      BoundaryFace face{element, f, {shape.faces[f].node_count, {}}};
      for (std::size_t i = 0; i < face.nodes.count; ++i) face.nodes.nodes[i] = nodes[shape.faces[f].nodes[i]];
      ++uses[Key(face.nodes.begin(), face.nodes.end())];
      faces.push_back(face);
    }
  });
  std::erase_if(faces, [&](const auto& face) { return uses[Key(face.nodes.begin(), face.nodes.end())] != 1; });

  ASSERT_EQ(faces_.size(), faces.size());
  for (std::size_t i = 0; i < faces.size(); ++i) {
    EXPECT_EQ(faces_[i].element, faces[i].element);
    EXPECT_EQ(faces_[i].face, faces[i].face);
    EXPECT_TRUE(
        std::equal(faces_[i].nodes.begin(), faces_[i].nodes.end(), faces[i].nodes.begin(), faces[i].nodes.end()));
  }
}

TEST_P(Boundary, FacesEncloseTheVolumeFromOutside) {
  // Divergence theorem; the result would be negative if faces were wound inward. A bilinear face encloses the mean of
  // its two triangulations.
  double enclosed_m3 = 0.0;
  for (const BoundaryFace& face : faces_) {
    const auto& n = face.nodes;
    if (n.count == 3) enclosed_m3 += cone_m3({n[0], n[1], n[2]});
    if (n.count == 4) {
      enclosed_m3 += 0.5 * (cone_m3({n[0], n[1], n[2]}) + cone_m3({n[0], n[2], n[3]}) + cone_m3({n[1], n[2], n[3]}) +
                            cone_m3({n[1], n[3], n[0]}));
    }
    if (n.count == 6) enclosed_m3 += quadratic_triangle_m3(n);
    if (n.count == 8) enclosed_m3 += quadratic_quadrilateral_m3(n);
  }
  EXPECT_NEAR(enclosed_m3, admit(mesh_, "random")->volume_m3, 1e-12);
}

TEST_P(Boundary, TrianglesFollowTheFaces) {
  std::uint32_t triangle = 0;
  for (const BoundaryFace& face : faces_) {
    const auto& n = face.nodes;
    const std::uint32_t count = n.count - 2;
    ASSERT_LE(triangle + count, surface_.triangles.size());
    Vector3d sum = Vector3d::Zero();
    std::set<std::uint32_t> used;
    for (std::uint32_t i = triangle; i < triangle + count; ++i) {
      const Triangle t = mesh_triangle(i);
      EXPECT_EQ(surface_.triangle_elements[i], face.element);
      used.insert(t.begin(), t.end());
      sum += area(t);
      if (n.count == 4) {
        EXPECT_EQ(t[0], *std::min_element(n.begin(), n.end()));
      }
    }
    EXPECT_EQ(used, std::set<std::uint32_t>(n.begin(), n.end()));
    // The vector area depends only on the outline.
    Vector3d outline = Vector3d::Zero();
    std::vector<std::uint32_t> loop(n.begin(), n.end());
    for (std::size_t i = 0; n.count > 4 && i < n.count; ++i) loop[i] = n[i / 2 + i % 2 * n.count / 2];
    for (std::size_t i = 0; i < loop.size(); ++i) {
      outline += 0.5 * mesh_.nodes[loop[i]].cross(mesh_.nodes[loop[(i + 1) % loop.size()]]);
    }
    EXPECT_LT((sum - outline).norm(), 1e-15);
    triangle += count;
  }
  EXPECT_EQ(triangle, surface_.triangles.size());
}

TEST_P(Boundary, VerticesAreCompactAndAscending) {
  std::set<std::uint32_t> used;
  for (const Triangle& triangle : surface_.triangles) used.insert(triangle.begin(), triangle.end());
  EXPECT_EQ(used.size(), surface_.nodes.size());
  EXPECT_EQ(*used.rbegin(), surface_.nodes.size() - 1);
  EXPECT_TRUE(std::is_sorted(surface_.nodes.begin(), surface_.nodes.end()));
}

TEST_P(Boundary, NeighboursAreTheOtherTrianglesOfTheEdges) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, std::vector<std::uint32_t>> of_edge;  // directed
  for (std::uint32_t i = 0; i < surface_.triangles.size(); ++i) {
    for (int side = 0; side < 3; ++side) {
      of_edge[{surface_.triangles[i][side], surface_.triangles[i][(side + 1) % 3]}].push_back(i);
    }
  }
  for (std::uint32_t i = 0; i < surface_.triangles.size(); ++i) {
    for (int side = 0; side < 3; ++side) {
      const std::uint32_t a = surface_.triangles[i][side], b = surface_.triangles[i][(side + 1) % 3];
      const auto& across = of_edge[{b, a}];
      const bool manifold = across.size() == 1 && of_edge[{a, b}].size() == 1;
      EXPECT_EQ(surface_.neighbours[i][side], manifold ? across[0] : kNone);
    }
  }
}

TENSORMASS_EVERY_MESH(Boundary);

class BoundaryOfGrid : public ::testing::TestWithParam<Shape> {};

TEST_P(BoundaryOfGrid, IsAClosedBox) {
  const Surface surface = boundary(testing::unit_grid(4, GetParam()));
  const std::uint32_t refined = topology(GetParam()).has_mid_edge_nodes() ? 2 : 1;
  const std::uint32_t cells = 4 * refined, squares = 6 * 4 * 4;
  const bool eight = GetParam() == Shape::kQuadraticHexahedron;  // its faces have six triangles and no central node
  EXPECT_EQ(surface.triangles.size(), eight ? 6 * squares : 6 * cells * cells * 2);
  EXPECT_EQ(surface.nodes.size(), std::pow(cells + 1, 3) - std::pow(cells - 1, 3) - (eight ? squares : 0));
  for (const auto& sides : surface.neighbours) {
    for (const std::uint32_t neighbour : sides) EXPECT_NE(neighbour, kNone);
  }
}

INSTANTIATE_TEST_SUITE_P(Shapes, BoundaryOfGrid, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST(BoundaryOfMixedMesh, IsAClosedBox) {
  const Mesh mesh = tests::mixed_mesh();
  double area_m2 = 0.0;
  for (const BoundaryFace& face : boundary_faces(mesh)) {
    const auto& x = [&](std::size_t i) { return mesh.nodes[face.nodes[i]]; };
    const Vector3d diagonals =
        face.nodes.count == 4 ? (x(2) - x(0)).cross(x(3) - x(1)) : (x(1) - x(0)).cross(x(2) - x(0));
    area_m2 += 0.5 * diagonals.norm();
  }
  EXPECT_NEAR(area_m2, 2 * (2.0 * 1.0 + 1.0 * 1.5 + 1.5 * 2.0), 1e-14);
  const Surface surface = boundary(mesh);
  EXPECT_EQ(surface.triangles.size(), 8 * area_m2);
  for (const auto& sides : surface.neighbours) {
    for (const std::uint32_t neighbour : sides) EXPECT_NE(neighbour, kNone);
  }
}

TEST(BoundaryOfTwoTetrahedra, SharingAnEdgeIsToleratedAsNonManifold) {
  Mesh mesh;
  mesh.nodes = {{0, 0, 0}, {0, 0, 1}, {1, 0, 0}, {0, 1, 0}, {-1, 0, 0}, {0, -1, 0}};
  mesh.blocks.push_back({Shape::kTetrahedron, {0, 2, 3, 1, 0, 4, 5, 1}});
  const Surface surface = boundary(mesh);
  EXPECT_EQ(surface.triangles.size(), 8u);
  int open = 0;
  for (const auto& sides : surface.neighbours) open += static_cast<int>(std::count(sides.begin(), sides.end(), kNone));
  EXPECT_EQ(open, 4);
}

}  // namespace
}  // namespace tensormass::mesh
