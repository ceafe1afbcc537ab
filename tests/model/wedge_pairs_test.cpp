#include "model/wedge_pairs.h"

#include <algorithm>
#include <cmath>
#include <set>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "model/compile.h"
#include "support/meshes.h"
#include "support/scenes.h"

/// Which wedges share a volumetric quadrature point.
namespace tensormass::model {
namespace {

ReadBody body_of(mesh::Mesh mesh) {
  ReadBody body;
  body.mesh = std::move(mesh);
  body.quadrature = physics::Quadrature::kSelective;
  Material& material = body.materials.emplace_back();
  material.young_modulus_pa = 1e3;
  material.poisson_ratio = 0.4999;
  return body;
}

mesh::Mesh grid(std::uint32_t x, std::uint32_t y, std::uint32_t z, mesh::Shape shape = mesh::Shape::kWedge) {
  return mesh::make_grid({0, 0, 0}, {1.0 * x, 1.0 * y, 1.0 * z}, x, y, z, shape).value();
}

/// Wedges side by side between the points of a zigzag, whose x are given and whose y alternate between 0 and 1; one
/// metre high.
mesh::Mesh row_of_wedges(const std::vector<double>& x) {
  mesh::Mesh mesh;
  const auto count = static_cast<std::uint32_t>(x.size());
  for (const double z : {0.0, 1.0}) {
    for (std::uint32_t i = 0; i < count; ++i) mesh.nodes.push_back({x[i], 1.0 * (i % 2), z});
  }
  mesh::ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = mesh::Shape::kWedge;
  for (std::uint32_t i = 0; i + 2 < count; ++i) {
    std::array<std::uint32_t, 3> base{i, i + 1, i + 2};
    if (i % 2 == 0) std::swap(base[1], base[2]);
    for (const std::uint32_t top : {0u, count}) {
      for (const std::uint32_t node : base) block.nodes.push_back(node + top);
    }
  }
  return mesh;
}

/// The two wedges of a cell, which follow each other in a grid.
TEST(PairWedges, RestoresTheCellsOfAGrid) {
  const ReadBody body = body_of(grid(4, 3, 2));
  const std::vector<ElementPair> pairs = pair_wedges(body);
  ASSERT_EQ(pairs.size(), 4u * 3 * 2);
  for (std::uint32_t cell = 0; cell < pairs.size(); ++cell) {
    EXPECT_EQ(pairs[cell], (ElementPair{2 * cell, 2 * cell + 1})) << cell;
  }
}

TEST(PairWedges, LeavesOneOfAnOddNumberAlone) {
  const std::vector<ElementPair> pairs = pair_wedges(body_of(row_of_wedges({0, 0.5, 1, 1.5, 2})));
  ASSERT_EQ(pairs.size(), 1u);
  EXPECT_EQ(pairs[0][1], pairs[0][0] + 1);
}

/// The largest face would leave both ends alone.
TEST(PairWedges, PairsWedgesWithOneCandidateFirst) {
  EXPECT_EQ(pair_wedges(body_of(row_of_wedges({0, 0.5, 1, 3, 2, 3.5}))), (std::vector<ElementPair>{{0, 1}, {2, 3}}));
}

/// Six wedges around an axis have two candidates each.
TEST(PairWedges, ThenTakesTheLargestFace) {
  mesh::Mesh mesh;
  for (const double z : {0.0, 1.0}) {
    mesh.nodes.push_back({0, 0, z});
    for (int i = 0; i < 6; ++i) {
      const double radius = i % 2 == 0 ? 1.0 : 1.2;
      mesh.nodes.push_back({radius * std::cos(i * M_PI / 3), radius * std::sin(i * M_PI / 3), z});
    }
  }
  mesh::ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = mesh::Shape::kWedge;
  for (std::uint32_t i = 0; i < 6; ++i) {
    for (const std::uint32_t top : {0u, 7u}) {
      for (const std::uint32_t node : {0u, 1 + i, 1 + (i + 1) % 6}) block.nodes.push_back(node + top);
    }
  }
  EXPECT_EQ(pair_wedges(body_of(mesh)), (std::vector<ElementPair>{{0, 1}, {2, 3}, {4, 5}}))
      << "across the long spokes, which are 1, 3 and 5";
}

TEST(PairWedges, NeedsEqualLawsModuliAndPronyTerms) {
  ReadBody body = body_of(grid(1, 1, 1));
  body.element_materials = {0, 1};
  const auto pair_with = [&](Material second) {
    body.materials.resize(1);
    body.materials.push_back(std::move(second));
    return pair_wedges(body).size() == 1;
  };
  Material other = body.materials[0];
  EXPECT_TRUE(pair_with(other)) << "another entry that says the same";
  other.parameters = {1, 2, 3};
  EXPECT_TRUE(pair_with(other)) << "another direction of the fibres";
  other.law = 1;
  EXPECT_FALSE(pair_with(other));
  other = body.materials[0];
  other.young_modulus_pa *= 2;
  EXPECT_FALSE(pair_with(other));
  other = body.materials[0];
  other.poisson_ratio = 0.4;
  EXPECT_FALSE(pair_with(other));
  other = body.materials[0];
  other.prony = {{0.5, 1}};
  EXPECT_FALSE(pair_with(other));
}

TEST(PairWedges, NeedsWedgesAndSelectiveQuadrature) {
  EXPECT_TRUE(pair_wedges(body_of(grid(2, 2, 2, mesh::Shape::kHexahedron))).empty());
  ReadBody body = body_of(grid(2, 2, 2));
  for (const auto quadrature : {physics::Quadrature::kFull, physics::Quadrature::kReduced}) {
    body.quadrature = quadrature;
    EXPECT_TRUE(pair_wedges(body).empty());
  }
}

TEST(PairWedges, FindsEveryWedgeOfAMixedMeshOnce) {
  const mesh::Mesh mesh = tests::mixed_mesh();
  const std::vector<ElementPair> pairs = pair_wedges(body_of(mesh));
  const std::uint32_t first = mesh::element_count(mesh.blocks[0]) + mesh::element_count(mesh.blocks[1]);
  const std::uint32_t count = mesh::element_count(mesh.blocks[2]);
  std::set<std::uint32_t> found;
  for (const ElementPair& pair : pairs) found.insert(pair.begin(), pair.end());
  EXPECT_EQ(pairs.size(), count / 2);
  EXPECT_EQ(found.size(), count);
  EXPECT_EQ(*found.begin(), first);
  EXPECT_EQ(*found.rbegin(), first + count - 1);
}

v1::Scene wedge_bar(double poisson_ratio) {
  v1::Scene scene = tests::beam_scene({.cells_x = 3, .cells_y = 2, .cells_z = 2, .poisson_ratio = poisson_ratio});
  scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_WEDGE);
  scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_SELECTIVE);
  return scene;
}

/// The wedges' six points for the change of shape, one of each pair for the change of volume; over each the volume
/// once.
TEST(WedgePairs, AreAGroupBesideTheirWedges) {
  v1::Scene scene = wedge_bar(0.4);
  *scene.add_bodies() = scene.bodies(0);
  scene.mutable_bodies(1)->set_name("second");
  const Model model = compile(scene, {}).value();
  ASSERT_EQ(model.groups.size(), 2u);
  const ElementGroup &wedges = model.groups[0], &pairs = model.groups[1];
  EXPECT_FALSE(wedges.is_wedge_pairs());
  EXPECT_EQ(wedges.element_count, 2 * 24u);
  EXPECT_EQ(wedges.point_count, 6u);
  EXPECT_TRUE(pairs.is_wedge_pairs());
  EXPECT_EQ(pairs.element_count, 2 * 12u);
  ASSERT_EQ(pairs.shares.size(), 1u);
  EXPECT_EQ(pairs.shares[0].deviatoric, 0);
  EXPECT_EQ(pairs.shares[0].volumetric, 1);
  double volume = 0;
  for (std::uint32_t e = 0; e < pairs.element_count; ++e) {
    EXPECT_EQ(pairs.elements[e] / 2, pairs.partners[e] / 2) << "of one cell";
    EXPECT_NE(pairs.elements[e], pairs.partners[e]);
    EXPECT_NEAR(pairs.first_parts[e], 0.5, 1e-12);
    volume += pairs.rest[std::size_t{physics::kRestReals<WedgePairShape> - 1} * pairs.stride + e];
  }
  EXPECT_NEAR(volume, 2 * 8 * 1 * 0.8, 1e-12);
  EXPECT_EQ(model.bodies[1].element_count, 24u) << "a pair is not an element of the scene";
}

TEST(WedgePairs, WarnOfWedgesThatLock) {
  v1::Scene scene = wedge_bar(0.4999);
  EXPECT_TRUE(compile(scene, {}).value().warnings.empty());
  std::vector<double> young(24);
  for (std::size_t e = 0; e < young.size(); ++e) young[e] = 1e6 + static_cast<double>(e);
  scene.mutable_bodies(0)->mutable_element_fields()->set_young_modulus_pa(young.data(), young.size() * sizeof(double));
  const Model model = compile(scene, {}).value();
  ASSERT_EQ(model.warnings.size(), 1u);
  EXPECT_NE(model.warnings[0].find("24 of 24 wedges"), std::string::npos) << model.warnings[0];
}

}  // namespace
}  // namespace tensormass::model
