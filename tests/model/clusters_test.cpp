#include "model/clusters.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <set>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "mesh/shapes.h"
#include "model/compile.h"
#include "model/tetrahedron_rings.h"
#include "model/wedge_pairs.h"
#include "support/findings.h"
#include "support/meshes.h"
#include "support/scenes.h"

/// Which elements share a quadrature point.
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

mesh::Mesh tetrahedra(std::uint32_t x, std::uint32_t y, std::uint32_t z) {
  return grid(x, y, z, mesh::Shape::kTetrahedron);
}

/// The six tetrahedra of a cell share its diagonal. Other edges have six as well, but the diagonal is longer.
TEST(RingTetrahedra, RestoresTheCellsOfAGrid) {
  const std::vector<ElementRing> rings = ring_tetrahedra(body_of(tetrahedra(4, 3, 2)));
  ASSERT_EQ(rings.size(), 4u * 3 * 2);
  for (std::uint32_t cell = 0; cell < rings.size(); ++cell) {
    ElementRing expected(6);
    std::iota(expected.begin(), expected.end(), 6 * cell);
    EXPECT_EQ(rings[cell], expected) << cell;
  }
}

/// Tetrahedra around an axis, between the points of a circle.
mesh::Mesh closed_ring(std::uint32_t count) {
  mesh::Mesh mesh;
  mesh.nodes = {{0, 0, -1.5}, {0, 0, 1.5}};
  mesh::ElementBlock& block = mesh.blocks.emplace_back();
  for (std::uint32_t i = 0; i < count; ++i) {
    mesh.nodes.push_back({std::cos(2 * M_PI * i / count), std::sin(2 * M_PI * i / count), 0});
    for (const std::uint32_t node : {0u, 1u, 2 + i, 2 + (i + 1) % count}) block.nodes.push_back(node);
  }
  return mesh;
}

/// Six that close a ring have eight nodes. Of seven, five in a row have eight, and the other two are a ring.
TEST(RingTetrahedra, HaveAtMostEightNodes) {
  EXPECT_EQ(ring_tetrahedra(body_of(closed_ring(6))), (std::vector<ElementRing>{{0, 1, 2, 3, 4, 5}}));
  EXPECT_EQ(ring_tetrahedra(body_of(closed_ring(7))), (std::vector<ElementRing>{{0, 1, 2, 3, 4}, {5, 6}}));
}

TEST(RingTetrahedra, NeedOneMaterialAndSelectiveQuadrature) {
  ReadBody body = body_of(tetrahedra(1, 1, 1));
  body.materials.push_back(body.materials[0]);
  body.element_materials = {0, 1, 0, 1, 0, 1};
  EXPECT_EQ(ring_tetrahedra(body).size(), 1u) << "another entry that says the same";
  body.materials[1].parameters = {1, 2, 3};
  EXPECT_EQ(ring_tetrahedra(body), (std::vector<ElementRing>{{0, 2, 4}, {1, 3, 5}})) << "other fibres";
  body.quadrature = physics::Quadrature::kFull;
  EXPECT_TRUE(ring_tetrahedra(body).empty());
  EXPECT_TRUE(ring_tetrahedra(body_of(grid(2, 2, 2, mesh::Shape::kHexahedron))).empty());
}

TEST(RingTetrahedra, FindEveryTetrahedronAtMostOnce) {
  mesh::Mesh mesh = tetrahedra(5, 4, 3);
  for (std::size_t i = 0; i < mesh.nodes.size(); ++i) {
    for (int c = 0; c < 3; ++c) mesh.nodes[i][c] += 0.2 * std::sin(static_cast<double>(7 * i + 3) * (c + 1));
  }
  const std::vector<ElementRing> rings = ring_tetrahedra(body_of(mesh));
  const auto nodes_of = mesh::element_nodes(mesh);
  std::set<std::uint32_t> found;
  std::size_t members = 0;
  for (const ElementRing& ring : rings) {
    members += ring.size();
    found.insert(ring.begin(), ring.end());
    EXPECT_TRUE(std::is_sorted(ring.begin(), ring.end()));
    std::set<std::uint32_t> all(nodes_of[ring[0]].begin(), nodes_of[ring[0]].end()), common = all;
    for (const std::uint32_t element : ring) {
      all.insert(nodes_of[element].begin(), nodes_of[element].end());
      std::erase_if(common, [&](std::uint32_t node) {
        return std::find(nodes_of[element].begin(), nodes_of[element].end(), node) == nodes_of[element].end();
      });
    }
    EXPECT_LE(all.size(), kClusterNodes);
    EXPECT_GE(common.size(), 2u) << "an edge of all";
  }
  EXPECT_EQ(found.size(), members);
  EXPECT_GT(members, 0.9 * 6 * 5 * 4 * 3);
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
  EXPECT_FALSE(wedges.has_clusters());
  EXPECT_EQ(wedges.element_count, 2 * 24u);
  EXPECT_EQ(wedges.point_count, 6u);
  EXPECT_TRUE(pairs.has_clusters());
  EXPECT_EQ(pairs.element_count, 2 * 12u);
  ASSERT_EQ(pairs.shares.size(), 1u);
  EXPECT_EQ(pairs.shares[0].deviatoric, 0);
  EXPECT_EQ(pairs.shares[0].volumetric, 1);
  double volume = 0;
  for (std::uint32_t e = 0; e < pairs.element_count; ++e) {
    const std::uint32_t first = pairs.members[e], second = pairs.members[pairs.stride + e];
    EXPECT_EQ(first, pairs.elements[e]);
    EXPECT_EQ(first / 2, second / 2) << "of one cell";
    EXPECT_NE(first, second);
    EXPECT_EQ(pairs.members[2 * pairs.stride + e], mesh::kNone) << "there is no third";
    EXPECT_NEAR(pairs.member_parts[e], 0.5, 1e-12);
    volume += pairs.rest[std::size_t{physics::kRestReals<ClusterShape> - 1} * pairs.stride + e];
  }
  EXPECT_NEAR(volume, 2 * 8 * 1 * 0.8, 1e-12);
  EXPECT_EQ(model.bodies[1].element_count, 24u) << "a pair is not an element of the scene";
}

/// A cell's ring stands beside its tetrahedra, which keep the rest of the deviatoric moduli.
TEST(TetrahedronRings, AreAGroupBesideTheirTetrahedra) {
  v1::Scene scene = wedge_bar(0.4);
  scene.mutable_bodies(0)->mutable_mesh()->mutable_grid()->set_shape(v1::SHAPE_TETRAHEDRON);
  const Model model = compile(scene, {}).value();
  ASSERT_EQ(model.groups.size(), 2u);
  const ElementGroup &tetrahedra = model.groups[0], &rings = model.groups[1];
  EXPECT_FALSE(tetrahedra.has_clusters());
  EXPECT_EQ(tetrahedra.element_count, 6 * 12u);
  EXPECT_TRUE(tetrahedra.shares.empty()) << "their moduli are scaled when the scene is compiled";
  EXPECT_TRUE(rings.has_clusters());
  EXPECT_EQ(rings.element_count, 12u);
  ASSERT_EQ(rings.shares.size(), 1u);
  EXPECT_EQ(rings.shares[0].deviatoric, kRingPart);
  EXPECT_EQ(rings.shares[0].volumetric, 1);
  EXPECT_FALSE(rings.checks_volume);
  double parts = 0;
  for (const double part : rings.member_parts) parts += part;
  EXPECT_NEAR(parts, 12, 1e-12);

  scene.mutable_bodies(0)->set_quadrature(v1::QUADRATURE_FULL);
  EXPECT_EQ(compile(scene, {}).value().groups.size(), 1u);
}

TEST(TetrahedronRings, NeedAMeshOfEightNodes) {
  ReadBody body = body_of(closed_ring(2));
  body.element_count = 2;
  EXPECT_TRUE(make_clusters(std::span(&body, 1)).clusters.empty()) << "the mesh has four nodes";
}

TEST(WedgePairs, FindWedgesThatLock) {
  v1::Scene scene = wedge_bar(0.4999);
  const auto found = [&] { return tests::texts(compile(scene, {}).value().findings, FindingCode::kUnpairedElements); };
  EXPECT_TRUE(found().empty());
  std::vector<double> young(24);
  for (std::size_t e = 0; e < young.size(); ++e) young[e] = 1e6 + static_cast<double>(e);
  scene.mutable_bodies(0)->mutable_element_fields()->set_young_modulus_pa(young.data(), young.size() * sizeof(double));
  ASSERT_EQ(found().size(), 1u);
  EXPECT_NE(found()[0].find("24 of 24 elements of shape wedge"), std::string::npos) << found()[0];
}

}  // namespace
}  // namespace tensormass::model
