#include "mesh/cut_surface.h"

#include <cstring>

#include <gtest/gtest.h>

#include "cut_blades.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;
using testing::Blade;
using testing::CutScene;
using testing::wide_blade;

/// Volume that the triangles enclose whose rows belong to each piece, by piece [m³].
std::map<std::uint32_t, double> enclosed_m3(const Cut& cut, const CutSurface& surface) {
  testing::Sets sets(cut.row_count());
  const auto join = [&](std::span<const std::uint32_t> rows) {
    for (const std::uint32_t row : rows) sets.unite(rows[0], row);
  };
  for (std::uint32_t element = 0; element < cut.topology().element_count(); ++element) {
    const auto nodes = cut.topology().nodes(element);
    if (cut.first_part(element) == kNone) join(nodes);
    for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
      join(std::span(cut.parts()[p].rows).first(nodes.size()));
    }
  }
  const std::vector<Vector3d> rows = row_positions(cut);
  std::map<std::uint32_t, double> volumes;
  for (const Triangle& triangle : surface.triangles) {
    const auto x = [&](std::size_t i) { return surface.position(triangle[i], rows); };
    const auto piece = static_cast<std::uint32_t>(sets.find(surface.rows[surface.offsets[triangle[0]]]));
    volumes[piece] += six_volumes(Vector3d::Zero(), x(0), x(1), x(2)) / 6.0;
  }
  return volumes;
}

class SurfaceOfACut : public ::testing::TestWithParam<Shape> {
 protected:
  void expect_enclosed(CutScene& scene) {
    const CutSurface surface = visible_surface(scene.cut);
    testing::expect_watertight(surface);
    std::vector<CutPiece> pieces(scene.topology.element_count());
    pieces.resize(scene.cut.pieces(pieces));
    const auto enclosed = enclosed_m3(scene.cut, surface);
    ASSERT_EQ(enclosed.size(), pieces.size());
    for (const CutPiece& piece : pieces) EXPECT_NEAR(enclosed.at(piece.row), piece.volume_m3, 1e-12);
  }
};
INSTANTIATE_TEST_SUITE_P(Shapes, SurfaceOfACut, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST_P(SurfaceOfACut, IsTheBoundaryWithoutOne) {
  const CutScene scene(testing::random_mesh(2, 3, 0.5, GetParam()));
  const CutSurface surface = visible_surface(scene.cut);
  const Surface skin = boundary(scene.mesh);
  ASSERT_EQ(surface.triangles.size(), skin.triangles.size());
  ASSERT_EQ(surface.vertex_count(), skin.nodes.size());
  EXPECT_EQ(surface.triangle_elements, skin.triangle_elements);
  const std::vector<Vector3d> rows = row_positions(scene.cut);
  for (std::size_t t = 0; t < skin.triangles.size(); ++t) {
    for (std::size_t i = 0; i < 3; ++i) {
      EXPECT_EQ(surface.position(surface.triangles[t][i], rows), scene.mesh.nodes[skin.nodes[skin.triangles[t][i]]]);
    }
    EXPECT_EQ(surface.triangle_is_cut[t], 0);
  }
}

TEST_P(SurfaceOfACut, EnclosesThePieces) {
  CutScene scene(testing::unit_grid(3, GetParam()));
  expect_enclosed(scene);
  std::mt19937 random(8);
  for (int i = 0; i < 40; ++i) {
    const testing::Path path = testing::random_path(random, 3);
    for (std::size_t step = 1; step < path.size(); ++step) scene.move(path[step - 1], path[step]);
    if (i % 4 == 3) expect_enclosed(scene);
    if (i % 8 == 7) scene.cut.reset();
    ASSERT_FALSE(HasFailure()) << i;
  }
}

TEST_P(SurfaceOfACut, IsThePlaneOfABlade) {
  CutScene scene(testing::unit_grid(3, GetParam()));
  scene.move(wide_blade(-0.5, 0.4), wide_blade(1.5, 0.6));
  const Vector3d normal = Vector3d(-0.1, 0.0, 1.0).normalized();
  const double offset = normal.dot(Vector3d(-0.5, 0.0, 0.4));
  const CutSurface surface = visible_surface(scene.cut);
  const std::vector<Vector3d> rows = row_positions(scene.cut);
  double area = 0.0, above = 0.0;
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    if (surface.triangle_is_cut[t] == 0) continue;
    std::array<Vector3d, 3> x;
    for (std::size_t i = 0; i < 3; ++i) {
      x[i] = surface.position(surface.triangles[t][i], rows);
      // Crossings near nodes are moved off them along their edges.
      EXPECT_LE(std::abs(normal.dot(x[i]) - offset), kMinCrossing / 3 + 1e-6);
    }
    const Vector3d twice = (x[1] - x[0]).cross(x[2] - x[0]);
    area += 0.5 * twice.norm();
    above += 0.5 * normal.dot(twice);
  }
  EXPECT_NEAR(area, 2.0 * std::sqrt(1.01), 2e-2) << "both faces of the cut";
  EXPECT_NEAR(above, 0.0, 1e-12) << "as much looks up as down";
}

TEST_P(SurfaceOfACut, FollowsACurve) {
  // A cylinder of radius R about the y axis, cut in small steps: chords of length h are h²/8R off.
  constexpr std::uint32_t kCells = 6;
  constexpr double kRadius = 0.8;
  CutScene scene(testing::random_mesh(3, kCells, 1.0, GetParam()));
  const auto blade = [&](double angle) {
    return wide_blade(kRadius * std::sin(angle) - 0.1, kRadius * std::cos(angle) - 0.1);
  };
  constexpr int kSteps = 200;
  for (int i = 0; i < kSteps; ++i) {
    scene.move(blade(-0.2 + 2.0 * i / kSteps), blade(-0.2 + 2.0 * (i + 1) / kSteps));
  }
  double h = 0.0;
  for (std::uint32_t element = 0; element < scene.topology.element_count(); ++element) {
    const auto nodes = scene.topology.nodes(element);
    for (std::size_t a = 0; a < scene.topology.shape(element).corner_count; ++a) {
      for (std::size_t b = 0; b < a; ++b) {
        h = std::max(h, (scene.mesh.nodes[nodes[a]] - scene.mesh.nodes[nodes[b]]).norm());  // diagonals as well
      }
    }
  }
  const CutSurface surface = visible_surface(scene.cut);
  testing::expect_watertight(surface);
  const std::vector<Vector3d> rows = row_positions(scene.cut);
  double most = 0.0;
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    if (surface.triangle_is_cut[t] == 0) continue;
    for (const std::uint32_t vertex : surface.triangles[t]) {
      const Vector3d x = surface.position(vertex, rows) + Vector3d(0.1, 0.0, 0.1);
      most = std::max(most, std::abs(std::hypot(x.x(), x.z()) - kRadius));
    }
  }
  EXPECT_GT(most, 0.0);
  EXPECT_LE(most, h * h / (8.0 * kRadius) + 0.05 * h);
}

TEST(SkinOfACut, KeepsUncutFacesOfTheSkin) {
  CutScene scene(testing::unit_grid(3, Shape::kHexahedron));
  const std::size_t before = visible_surface(scene.cut).triangles.size();
  scene.move(wide_blade(-0.5, 0.5), wide_blade(0.5, 0.5));
  const CutSurface surface = visible_surface(scene.cut);
  // Boundary faces with a cut edge are drawn anew: those along the way of the blade, at mid height.
  std::size_t skin = 0;
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) skin += surface.triangle_is_cut[t] == 0;
  EXPECT_GT(skin, before);
  EXPECT_LT(skin, 2 * before);
  // A vertex of a linear element weighs the corners of at most one element.
  for (std::uint32_t v = 0; v < surface.vertex_count(); ++v) EXPECT_LE(surface.offsets[v + 1] - surface.offsets[v], 8u);
}

}  // namespace
}  // namespace tensormass::mesh
