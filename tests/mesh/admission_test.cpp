#include "mesh/admission.h"

#include <cmath>
#include <limits>
#include <numbers>

#include <gtest/gtest.h>

#include "core/limits.h"
#include "random_mesh.h"
#include "support/meshes.h"

namespace tensormass::mesh {
namespace {

Mesh tetrahedron() { return tests::reference_element(Shape::kTetrahedron); }

/// Expects a refusal whose message contains every one of `parts`.
void expect_refused(const Mesh& mesh, std::initializer_list<std::string_view> parts) {
  const Result<MeshReport> report = admit(mesh, "liver");
  ASSERT_FALSE(report);
  for (const std::string_view part : parts) {
    EXPECT_NE(report.error().message.find(part), std::string::npos)
        << "'" << part << "' is not in: " << report.error().message;
  }
}

TEST(Admission, ReportsWhatItAdmits) {
  const Result<MeshReport> report = admit(tetrahedron(), "liver");
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_EQ(report->node_count, 4u);
  EXPECT_EQ(report->element_count, 1u);
  EXPECT_EQ(report->component_count, 1u);
  EXPECT_DOUBLE_EQ(report->volume_m3, 1.0 / 6.0);
  EXPECT_NEAR(report->min_dihedral_angle_deg, std::acos(1.0 / std::sqrt(3.0)) * 180.0 / std::numbers::pi, 1e-12);
  EXPECT_TRUE(report->findings.empty());
}

TEST(Admission, ReportsTheSmallestDihedralAngleAndItsElement) {
  // The dihedral angle at an edge is the angle between the two directions within the faces, perpendicular to the edge.
  const Mesh mesh = testing::random_mesh(7, 3, 0.8);
  double least = 180.0;
  std::uint32_t where = kNone;
  for_each_element(mesh, [&](std::uint32_t element, const Topology&, std::span<const std::uint32_t> nodes) {
    for (int i = 0; i < 4; ++i) {
      for (int j = i + 1; j < 4; ++j) {
        int others[2], n = 0;
        for (int k = 0; k < 4; ++k) {
          if (k != i && k != j) others[n++] = k;
        }
        const Eigen::Vector3d axis = (mesh.nodes[nodes[j]] - mesh.nodes[nodes[i]]).normalized();
        const auto away = [&](int k) -> Eigen::Vector3d {
          const Eigen::Vector3d r = mesh.nodes[nodes[k]] - mesh.nodes[nodes[i]];
          return (r - axis.dot(r) * axis).normalized();
        };
        const double degrees = std::acos(away(others[0]).dot(away(others[1]))) * 180.0 / std::numbers::pi;
        if (degrees < least) {
          least = degrees;
          where = element;
        }
      }
    }
  });
  const MeshReport report = admit(mesh, "liver").value();
  EXPECT_NEAR(report.min_dihedral_angle_deg, least, 1e-9);
  EXPECT_EQ(report.min_dihedral_element, where);
}

TEST(Admission, RefusesAnEmptyMesh) {
  expect_refused(Mesh{}, {"'liver' has no nodes"});
  Mesh mesh = tetrahedron();
  mesh.blocks[0].nodes.clear();
  expect_refused(mesh, {"'liver' has no elements"});
  mesh.blocks.clear();
  expect_refused(mesh, {"'liver' has no elements"});
}

TEST(Admission, RefusesHalfAnElement) {
  Mesh mesh = tetrahedron();
  mesh.blocks[0].nodes.pop_back();
  expect_refused(mesh, {"'liver'", "3 node indices", "not a multiple of 4"});
}

TEST(Admission, RefusesAnIndexOutOfRange) {
  Mesh mesh = testing::unit_grid(1);
  mesh.blocks[0].nodes[4 * 2 + 1] = 8;
  expect_refused(mesh, {"element 2", "'liver'", "node 8", "8 nodes"});
  mesh.blocks[0].nodes[4 * 4 + 1] = 0xFFFFFFFFu;
  expect_refused(mesh, {"element 2", "(2 of this kind)"});
}

TEST(Admission, RefusesCoordinatesThatAreNotFinite) {
  for (const double bad :
       {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), -2.0 * limits::kMaxLength}) {
    Mesh mesh = tetrahedron();
    mesh.nodes[3].y() = bad;
    expect_refused(mesh, {"node 3", "'liver'", "finite"});
  }
}

TEST(Admission, RefusesAnInvertedElement) {
  Mesh mesh = testing::unit_grid(2);
  std::swap(mesh.blocks[0].nodes[4 * 5 + 2], mesh.blocks[0].nodes[4 * 5 + 3]);
  expect_refused(mesh, {"element 5", "'liver'", "inverted", "VTK order"});
}

class AdmissionOf : public ::testing::TestWithParam<Shape> {
 protected:
  const Mesh mesh_ = tests::reference_element(GetParam());
};

TEST_P(AdmissionOf, AdmitsTheReferenceElement) {
  const Result<MeshReport> report = admit(mesh_, "liver");
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_GE(report->min_dihedral_angle_deg, 45.0 - 1e-12);
  EXPECT_TRUE(report->findings.empty());
}

TEST_P(AdmissionOf, RefusesAMirrorImage) {
  Mesh mesh = mesh_;
  for (Eigen::Vector3d& node : mesh.nodes) node.x() = -node.x();
  expect_refused(mesh, {"element 0", "'liver'", "inverted", "VTK order"});
}

TEST_P(AdmissionOf, RefusesAFlatElement) {
  Mesh mesh = mesh_;
  for (Eigen::Vector3d& node : mesh.nodes) node.z() *= 1e-10;
  expect_refused(mesh, {"element 0", "'liver'", "flat"});
}

INSTANTIATE_TEST_SUITE_P(Shapes, AdmissionOf, ::testing::ValuesIn(testing::every_shape()),
                         [](const auto& shape) { return testing::test_name(shape.param); });

TEST(Admission, RefusesAnElementThatIsFoldedAtACorner) {
  // Moves one corner of a face past the line between its neighbours; the volume stays positive.
  Mesh mesh = tests::reference_element(Shape::kPyramid);
  mesh.nodes[1] = {-0.2, 0.2, 0.0};
  expect_refused(mesh, {"element 0", "'liver'", "pyramid is folded over at node 1", "remesh"});
  mesh = tests::reference_element(Shape::kWedge);
  mesh.nodes[4] = {-0.3, 0.3, 1.0};
  expect_refused(mesh, {"element 0", "'liver'", "wedge is folded over at node", "remesh"});
  mesh = tests::reference_element(Shape::kHexahedron);
  mesh.nodes[6] = {0.3, 0.4, 1.0};
  expect_refused(mesh, {"element 0", "'liver'", "hexahedron is folded over at node 6", "remesh"});
}

TEST(Admission, RefusesMidEdgeNodesBeyondTheQuarterPoints) {
  Mesh mesh = tests::reference_element(Shape::kQuadraticTetrahedron);
  mesh.nodes[4] = {0.26, 0.0, 0.0};
  EXPECT_TRUE(admit(mesh, "liver"));
  mesh.nodes[4] = {0.24, 0.0, 0.0};
  expect_refused(mesh, {"element 0", "'liver'", "quadratic tetrahedron is folded over at node 0", "quarter points"});
  mesh = tests::reference_element(Shape::kQuadraticHexahedron);
  mesh.nodes[8] = {0.26, 0.0, 0.0};
  EXPECT_TRUE(admit(mesh, "liver"));
  mesh.nodes[8] = {0.24, 0.0, 0.0};
  expect_refused(mesh, {"element 0", "'liver'", "quadratic hexahedron is folded over at node 0", "quarter points"});
}

TEST(Admission, RefusesAWedgeInTheOrderOfVtksDocumentation) {
  Mesh mesh = tests::reference_element(Shape::kWedge);
  mesh.blocks[0].nodes = {3, 4, 5, 0, 1, 2};
  expect_refused(mesh, {"element 0", "inverted", "in a wedge, its triangles"});
}

TEST(Admission, RefusesAHexahedronThatCountsXFastest) {
  Mesh mesh = tests::reference_element(Shape::kHexahedron);
  mesh.blocks[0].nodes = {0, 1, 3, 2, 4, 5, 7, 6};
  expect_refused(mesh, {"element 0", "VTK order"});
}

TEST(Admission, RefusesAFlatElement) {
  Mesh mesh = tetrahedron();
  mesh.nodes[3] = {0.3, 0.3, 0.0};
  expect_refused(mesh, {"element 0", "'liver'", "flat"});
  mesh.nodes[3].z() = 1e-9;
  expect_refused(mesh, {"element 0", "'liver'", "flat"});
  mesh.nodes[3].z() = 1e-7;
  EXPECT_TRUE(admit(mesh, "liver"));
  for (Eigen::Vector3d& node : mesh.nodes) node = Eigen::Vector3d::Zero();
  expect_refused(mesh, {"element 0", "'liver'", "flat"});
}

TEST(Admission, FlatnessDoesNotDependOnSize) {
  Mesh mesh = tetrahedron();
  for (Eigen::Vector3d& node : mesh.nodes) node *= 1e-6;
  EXPECT_TRUE(admit(mesh, "cell"));
}

TEST(Admission, RefusesARepeatedNode) {
  Mesh mesh = tetrahedron();
  mesh.blocks[0].nodes = {0, 1, 2, 3, 0, 1, 2, 0};
  expect_refused(mesh, {"element 1", "'liver'", "repeats a node"});
}

TEST(Admission, RefusesANodeWithoutElement) {
  Mesh mesh = tetrahedron();
  mesh.nodes.push_back({2.0, 2.0, 2.0});
  expect_refused(mesh, {"node 4", "'liver'", "no element"});
}

TEST(Admission, RefusesADuplicateInAnyNodeOrder) {
  Mesh mesh = testing::unit_grid(2);
  auto& nodes = mesh.blocks[0].nodes;
  const std::vector<std::uint32_t> rotated{nodes[4 * 3 + 1], nodes[4 * 3 + 2], nodes[4 * 3], nodes[4 * 3 + 3]};
  nodes.insert(nodes.end(), rotated.begin(), rotated.end());
  expect_refused(mesh, {"element 48", "'liver'", "same nodes as element 3"});
}

TEST(Admission, NamesEveryKindOfProblemAtOnce) {
  Mesh mesh = testing::unit_grid(2);
  std::swap(mesh.blocks[0].nodes[0], mesh.blocks[0].nodes[1]);
  mesh.nodes.push_back({2.0, 2.0, 2.0});
  expect_refused(mesh, {"element 0", "inverted", "\n", "node 27", "no element"});
}

TEST(Admission, WarnsAboutSlivers) {
  Mesh mesh = tetrahedron();
  mesh.nodes[3] = {0.3, 0.3, 1e-3};
  const MeshReport report = admit(mesh, "liver").value();
  ASSERT_EQ(report.findings.size(), 1u);
  EXPECT_NE(report.findings[0].text().find("1 elements have a dihedral angle below 5°"), std::string::npos);
  EXPECT_NE(report.findings[0].text().find("in element 0"), std::string::npos);
}

TEST(Admission, WarnsAboutSeparateParts) {
  Mesh mesh = tetrahedron();
  for (int i = 0; i < 4; ++i) mesh.nodes.push_back(mesh.nodes[i] + Eigen::Vector3d(5.0, 0.0, 0.0));
  mesh.blocks.push_back({Shape::kTetrahedron, {4, 5, 6, 7}});
  const MeshReport report = admit(mesh, "liver").value();
  EXPECT_EQ(report.component_count, 2u);
  ASSERT_EQ(report.findings.size(), 1u);
  EXPECT_NE(report.findings[0].text().find("2 parts"), std::string::npos);
}

TEST(SkinAdmission, ReportsAndRefuses) {
  const std::vector<Eigen::Vector3d> vertices{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {2, 0, 0}};
  const auto refusal = [&](std::vector<Triangle> triangles) {
    const Result<SkinReport> report = admit_skin(vertices, triangles, "body 'liver'");
    return report ? std::string("accepted") : report.error().message;
  };
  const SkinReport good = admit_skin(vertices, std::vector<Triangle>{{0, 1, 2}, {1, 3, 2}}, "body 'liver'").value();
  EXPECT_EQ(good.triangle_count, 2u);
  EXPECT_TRUE(good.findings.empty());

  EXPECT_NE(refusal({}).find("0 triangles"), std::string::npos);
  EXPECT_NE(refusal({{0, 1, 2}, {0, 1, 4}}).find("skin triangle 1 of body 'liver' refers to vertex 4"),
            std::string::npos);
  EXPECT_NE(refusal({{0, 1, 1}}).find("skin triangle 0 of body 'liver' repeats a vertex"), std::string::npos);

  const SkinReport ugly = admit_skin(vertices, std::vector<Triangle>{{0, 1, 3}}, "body 'liver'").value();
  ASSERT_EQ(ugly.findings.size(), 2u);
  EXPECT_NE(ugly.findings[0].text().find("1 triangles without area"), std::string::npos);
  EXPECT_NE(ugly.findings[1].text().find("1 vertices that belong to no triangle"), std::string::npos);

  std::vector<Eigen::Vector3d> broken = vertices;
  broken[2].z() = std::numeric_limits<double>::quiet_NaN();
  const Result<SkinReport> report = admit_skin(broken, std::vector<Triangle>{{0, 1, 2}}, "body 'liver'");
  ASSERT_FALSE(report);
  EXPECT_NE(report.error().message.find("skin vertex 2 of body 'liver'"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::mesh
