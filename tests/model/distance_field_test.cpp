#include "model/distance_field.h"

#include <cmath>
#include <map>
#include <random>

#include <gtest/gtest.h>

#include "model/compile.h"
#include "physics/tool/mesh_solid.h"
#include "support/findings.h"
#include "support/scenes.h"
#include "support/solids.h"

/// Sampled distances of a closed surface against the surface itself.
namespace tensormass::model {
namespace {

using Eigen::Vector3d;

/// An octahedron whose faces are cut into four until they are small, with its vertices on a sphere.
struct Sphere {
  explicit Sphere(double radius_m, int cuts) {
    vertices = {{1, 0, 0}, {-1, 0, 0}, {0, 1, 0}, {0, -1, 0}, {0, 0, 1}, {0, 0, -1}};
    triangles = {{0, 2, 4}, {2, 1, 4}, {1, 3, 4}, {3, 0, 4}, {2, 0, 5}, {1, 2, 5}, {3, 1, 5}, {0, 3, 5}};
    for (int i = 0; i < cuts; ++i) cut();
    for (Vector3d& vertex : vertices) vertex *= radius_m;
  }

  std::vector<Vector3d> vertices;
  std::vector<mesh::Triangle> triangles;

 private:
  void cut() {
    std::map<std::pair<std::uint32_t, std::uint32_t>, std::uint32_t> middles;
    const auto middle = [&](std::uint32_t a, std::uint32_t b) {
      const auto [found, is_new] = middles.try_emplace(std::minmax(a, b), static_cast<std::uint32_t>(vertices.size()));
      if (is_new) vertices.push_back((vertices[a] + vertices[b]).normalized());
      return found->second;
    };
    std::vector<mesh::Triangle> finer;
    for (const auto& [a, b, c] : triangles) {
      const std::uint32_t ab = middle(a, b), bc = middle(b, c), ca = middle(c, a);
      finer.insert(finer.end(), {{a, ab, ca}, {ab, b, bc}, {ca, bc, c}, {ab, bc, ca}});
    }
    triangles = std::move(finer);
  }
};

TEST(DistanceField, IsThatOfASphere) {
  constexpr double kRadiusM = 0.03, kCubeM = 2 * kRadiusM / kDistanceCubes;
  const Sphere sphere(kRadiusM, 5);
  const DistanceField field = sample_distance(sphere.vertices, sphere.triangles, "tool 'ball'").value();
  EXPECT_NEAR(field.reach_m, kRadiusM, 1e-12);
  EXPECT_NEAR(field.box.sizes().minCoeff(), 2 * kRadiusM, 1e-12);
  const physics::SampledDistance distance{field.samples.data()};
  std::mt19937 random(1);
  std::uniform_real_distribution<double> uniform(-1, 1);
  for (int i = 0; i < 2000; ++i) {
    const Vector3d direction = Vector3d(uniform(random), uniform(random), uniform(random)).normalized();
    for (const double r : {0.5 * kRadiusM, 0.95 * kRadiusM, kRadiusM, 1.05 * kRadiusM}) {
      const auto at = distance.at<double>(direction * r);
      EXPECT_NEAR(at.distance, r - kRadiusM, 0.05 * kCubeM) << "the polyhedron and the grid, at " << r;
      EXPECT_GT(at.gradient.normalized().dot(direction), 0.995) << r;
    }
    // Outside of the grid it is a lower bound.
    const double far = distance.at<double>(direction * 3 * kRadiusM).distance;
    EXPECT_LT(far, 2 * kRadiusM + 1e-6);
    EXPECT_GT(far, 1.2 * kRadiusM);
  }
}

/// At a sharp edge the nearest triangle alone does not tell which side a point is on.
TEST(DistanceField, HasTheSignOfThePseudonormalAtEdgesAndCorners) {
  const Sphere octahedron(1, 0);
  const DistanceField field = sample_distance(octahedron.vertices, octahedron.triangles, "tool 'jack'").value();
  const physics::SampledDistance distance{field.samples.data()};
  std::mt19937 random(2);
  std::uniform_real_distribution<double> uniform(-1.02, 1.02);
  for (int i = 0; i < 5000; ++i) {
    const Vector3d x(uniform(random), uniform(random), uniform(random));
    const double plane = (x.lpNorm<1>() - 1) / std::sqrt(3.0);  // exact inside, a lower bound outside
    const double found = distance.at<double>(x).distance;
    EXPECT_GT(found, plane - 0.02);
    if (plane < -0.05) {
      EXPECT_LT(found, 0);
    }
    if (plane > 0.05) {
      EXPECT_GT(found, 0);
    }
  }
}

TEST(DistanceField, RefusesWhatIsNotTheSurfaceOfASolid) {
  const Sphere whole(1, 1);
  const auto expect = [&](const char* what, const auto& damage) {
    std::vector<mesh::Triangle> triangles = whole.triangles;
    damage(triangles);
    const auto refused = sample_distance(whole.vertices, triangles, "tool 'rake'.mesh.surface");
    ASSERT_FALSE(refused) << what;
    EXPECT_NE(refused.error().message.find("tool 'rake'.mesh.surface"), std::string::npos);
    EXPECT_NE(refused.error().message.find(what), std::string::npos) << refused.error().message;
  };
  expect("is open at the edge between vertices", [](auto& triangles) { triangles.pop_back(); });
  expect("in the same direction", [](auto& triangles) { std::swap(triangles[0][0], triangles[0][1]); });
  expect("in the same direction", [](auto& triangles) { triangles.push_back(triangles[0]); });
  expect("seen from outside", [](auto& triangles) {
    for (auto& triangle : triangles) std::swap(triangle[0], triangle[1]);
  });
}

/// A blade that is thinner than the grid resolves is loaded with a finding.
TEST(SolidTool, OfAThinMeshIsAFinding) {
  const auto found_at = [](double thickness_m) {
    v1::Scene scene = tests::beam_scene({});
    tests::add_solid(scene, "mesh", {0.1, thickness_m, 0.02}, {0, 1, 0}, 1e6);
    return tests::texts(compile(scene, {1, 1, matrix::Storage::kEdges}).value().findings, FindingCode::kThinTool);
  };
  const std::vector<std::string> thin = found_at(0.002);
  ASSERT_EQ(thin.size(), 1u);
  EXPECT_NE(thin[0].find("tool 'solid'.mesh.surface is 0.002 m thin"), std::string::npos) << thin[0];
  EXPECT_TRUE(found_at(0.01).empty());
}

/// Scenes whose solid tool says nonsense are refused with the name of the field.
TEST(SolidTool, OfAMalformedMessageIsRefused) {
  const auto expect = [](const char* what, const auto& describe) {
    v1::Scene scene = tests::beam_scene({});
    v1::Tool& tool = *scene.add_tools();
    tool.set_name("rake");
    describe(tool);
    const auto refused = compile(scene, {1, 1, matrix::Storage::kEdges});
    ASSERT_FALSE(refused) << what;
    EXPECT_NE(refused.error().message.find(what), std::string::npos) << refused.error().message;
  };
  const auto set_box = [](v1::Tool& tool, double size_y_m, double edge_radius_m) {
    tool.mutable_box()->set_size_x_m(0.01);
    tool.mutable_box()->set_size_y_m(size_y_m);
    tool.mutable_box()->set_size_z_m(0.02);
    tool.mutable_box()->set_edge_radius_m(edge_radius_m);
  };
  const auto set_triangle = [](v1::Tool& tool, double first_x, std::uint32_t last) {
    v1::PackedTriangles& packed = *tool.mutable_mesh()->mutable_surface()->mutable_packed();
    packed.set_vertex_positions(tests::packed_bytes(std::vector<double>{first_x, 0, 0, 1, 0, 0, 0, 1, 0}));
    packed.set_triangles(tests::packed_bytes(std::vector<std::uint32_t>{0, 1, last}));
  };
  expect("tool 'rake'.box.size_y_m", [&](v1::Tool& tool) { set_box(tool, 0, 0); });
  expect("tool 'rake'.box.edge_radius_m", [&](v1::Tool& tool) { set_box(tool, 0.02, 0.006); });
  expect("tool 'rake'.mesh.surface: give packed triangles", [](v1::Tool& tool) { tool.mutable_mesh(); });
  expect("open at the edge", [&](v1::Tool& tool) { set_triangle(tool, 0, 2); });
  expect("of tool 'rake' refers to vertex 9", [&](v1::Tool& tool) { set_triangle(tool, 0, 9); });
  expect("of tool 'rake' is at (nan", [&](v1::Tool& tool) { set_triangle(tool, std::nan(""), 2); });
}

}  // namespace
}  // namespace tensormass::model
