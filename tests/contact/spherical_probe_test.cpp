#include "contact/spherical_probe.h"

#include <gtest/gtest.h>

#include "mesh/random_mesh.h"
#include "mesh/surface.h"
#include "support/dense_system.h"
#include "support/staged_scene.h"

/// The contact stages of one step against brute force over the mesh's boundary.
namespace tensormass::contact {
namespace {

using step::StageKind;
using tests::StagedScene;

constexpr double kPenalty = 4e6;  // Pa/m

void place(StagedScene<double>& staged, const Vec3<double>& center, double radius_m) {
  // The view hands tools to the stages as constants; between steps they are the backend's to write.
  auto& tool = const_cast<view::ToolState<double>&>(staged.view.contact.tools[0]);
  tool = {{center[0], center[1], center[2]}, radius_m, kPenalty};
}

backend::ToolForce measured(const StagedScene<double>& staged) {
  backend::ToolForce force;
  backend::read_forces<double>({staged.view.contact.tool_loads, staged.view.patches.patch_count}, {&force, 1});
  return force;
}

/// What contact with a sphere outside the tissue adds to the system, triangle by triangle from the boundary.
struct DenseContact {
  Eigen::MatrixXd a;
  Eigen::VectorXd b;
  int touching = 0;

  DenseContact(const mesh::Mesh& mesh, const Eigen::VectorXd& u, const Eigen::VectorXd& v, double dt,
               const Vec3<double>& center, double radius_m)
      : a(Eigen::MatrixXd::Zero(u.size(), u.size())), b(Eigen::VectorXd::Zero(u.size())) {
    const mesh::Surface surface = mesh::boundary(mesh);
    for (const mesh::Triangle& triangle : surface.triangles) {
      Vec3<double> rest[3], x[3];
      std::uint32_t node[3];
      for (std::size_t c = 0; c < 3; ++c) {
        node[c] = surface.nodes[triangle[c]];
        rest[c] = mesh.nodes[node[c]];
        x[c] = rest[c] + u.segment<3>(3 * node[c]);
      }
      const auto closest = physics::closest_point_on_triangle(center, x[0], x[1], x[2]);
      Vec3<double> point = Vec3<double>::Zero(), velocity = Vec3<double>::Zero();
      for (int c = 0; c < 3; ++c) {
        point += closest.weights[c] * x[c];
        velocity += closest.weights[c] * v.segment<3>(3 * node[c]);
      }
      const double distance = (point - center).norm(), depth = radius_m - distance;
      if (depth <= 0) continue;
      ++touching;
      const Vec3<double> n = (point - center) / distance;
      const double k = kPenalty * (rest[1] - rest[0]).cross(rest[2] - rest[0]).norm() / 2;
      for (int c = 0; c < 3; ++c) {
        b.segment<3>(3 * node[c]) += dt * k * closest.weights[c] * (depth - dt * n.dot(velocity)) * n;
        for (int d = 0; d < 3; ++d) {
          a.block<3, 3>(3 * node[c], 3 * node[d]) +=
              dt * dt * k * closest.weights[c] * closest.weights[d] * n * n.transpose();
        }
      }
    }
  }
};

/// The unit box with moved nodes, free, and one tool.
v1::Scene box_scene(const mesh::Mesh& mesh, bool linear = true) {
  v1::Scene scene = tests::packed_scene(mesh, linear);
  tests::add_probe(scene, "probe", 0.3, 0, 5, 0);
  scene.mutable_solver()->set_cg_max_iterations(3000);
  scene.mutable_solver()->set_cg_tolerance(1e-13);
  return scene;
}

class Probe : public testing::TestWithParam<std::uint32_t> {
 protected:
  const mesh::Mesh mesh_ = mesh::testing::random_mesh(8, 4, 1.0);
};

TEST_P(Probe, AddsToTheSystemWhatBruteForceAdds) {
  const v1::Scene scene = box_scene(mesh_);
  StagedScene<double> staged(scene, GetParam());
  const Eigen::Index size = 3 * staged.node_count();
  const Eigen::VectorXd u = tests::random_field(size, 0.01, 1), v = tests::random_field(size, 0.5, 2);
  staged.put(staged.view.state.displacement, u);
  staged.put(staged.view.state.velocity, v);
  const double dt = staged.model.dt_s;
  const tests::DenseSystem tissue = tests::dense_system(scene, u);
  // Over a face, over an edge, at a corner.
  for (const Vec3<double>& center : {Vec3<double>(0.5, 1.2, 0.5), {1.15, 1.1, 0.5}, {-0.1, -0.1, 1.1}}) {
    place(staged, center, 0.3);
    staged.run_through(StageKind::kAssembleContact);
    const DenseContact contact(mesh_, u, v, dt, center, 0.3);
    ASSERT_GT(contact.touching, 3);
    const Eigen::MatrixXd a = tissue.a(dt) + contact.a;
    const Eigen::VectorXd b = tissue.b(dt, v) + contact.b;
    EXPECT_LT((staged.matrix() - a).norm(), 1e-12 * contact.a.norm());
    EXPECT_LT((staged.by_node(staged.view.matrix.rhs) - b).norm(), 1e-12 * b.norm());
  }
}

/// The tissue gains the momentum that the reported force of the tool gives.
TEST_P(Probe, ActsOnTheTissueAsTheTissueOnIt) {
  StagedScene<double> staged(box_scene(mesh_), GetParam());
  const Vec3<double> center(0.4, 1.1, 0.6);
  place(staged, center, 0.3);
  staged.step();
  const Eigen::VectorXd v = staged.by_node(staged.view.state.velocity),
                        u = staged.by_node(staged.view.state.displacement);
  Vec3<double> momentum = Vec3<double>::Zero(), angular = Vec3<double>::Zero();
  for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
    const Vec3<double> mv = staged.model.inertia[4 * std::size_t{staged.row(node)}] * v.segment<3>(3 * node);
    momentum += mv;
    angular += (mesh_.nodes[node] - center).cross(mv);
  }
  const backend::ToolForce tool = measured(staged);
  ASSERT_GT(tool.force_n[1], 100);
  EXPECT_LT((momentum + staged.model.dt_s * tool.force_n).norm(), 1e-9 * momentum.norm());
  // Without friction every force passes through the centre.
  EXPECT_LT(angular.norm(), 1e-9 * momentum.norm());
  EXPECT_LT(tool.torque_n_m.norm(), 1e-12 * tool.force_n.norm());
}

TEST_P(Probe, OutOfReachIsExactlyNothing) {
  v1::Scene with = box_scene(mesh_), without = with;
  without.clear_tools();
  StagedScene<double> touching_nothing(with, GetParam()), alone(without, GetParam());
  const Eigen::VectorXd v = tests::random_field(3 * alone.node_count(), 0.5, 2);
  alone.put(alone.view.state.velocity, v);
  touching_nothing.put(touching_nothing.view.state.velocity, v);
  place(touching_nothing, {0.5, 1.6, 0.5}, 0.3);
  for (int i = 0; i < 3; ++i) {
    alone.step();
    touching_nothing.step();
  }
  EXPECT_EQ(measured(touching_nothing).force_n, (Vec3<double>(Vec3<double>::Zero())));
  EXPECT_EQ(measured(touching_nothing).torque_n_m, (Vec3<double>(Vec3<double>::Zero())));
  EXPECT_EQ(touching_nothing.by_node(touching_nothing.view.state.displacement),
            alone.by_node(alone.view.state.displacement));
}

/// Contacts of one step must not push in the next.
TEST_P(Probe, LetsGoWhenItLeaves) {
  StagedScene<double> staged(box_scene(mesh_), GetParam());
  place(staged, {0.5, 1.1, 0.5}, 0.3);
  staged.step();
  ASSERT_GT(measured(staged).force_n.norm(), 100);
  place(staged, {0.5, 9, 0.5}, 0.3);
  staged.step();
  EXPECT_EQ(measured(staged).force_n.norm(), 0);
}

INSTANTIATE_TEST_SUITE_P(Patches, Probe, testing::Values(1u, 2u, 6u));

/// A block that cannot move: every node fixed, its top two large triangles at y = 1.
v1::Scene rigid_block() {
  tests::Beam block{.cells_x = 1,
                    .cells_y = 1,
                    .cells_z = 1,
                    .size_x_m = 1,
                    .size_y_m = 1,
                    .size_z_m = 1,
                    .linear = true,
                    .double_precision = true};
  v1::Scene scene = tests::beam_scene(block);
  scene.clear_gravity_m_per_s2();
  v1::Box& all = *scene.mutable_bodies(0)->mutable_fixed(0)->mutable_box();
  tests::set(*all.mutable_min_m(), -1, -1, -1);
  tests::set(*all.mutable_max_m(), 2, 2, 2);
  tests::add_probe(scene, "probe", 0.05, 0, 5, 0);
  return scene;
}

TEST(ProbeOnARigidBlock, FeelsStiffnessTimesDepth) {
  StagedScene<double> staged(rigid_block());
  for (const double depth : {1e-4, 1e-3, 1e-2}) {
    place(staged, {0.3, 1.05 - depth, 0.7}, 0.05);  // far from every edge: one triangle
    staged.step();
    const backend::ToolForce tool = measured(staged);
    EXPECT_NEAR(tool.force_n[1], kPenalty * 0.5 * depth, 1e-9 * kPenalty * depth);
    EXPECT_NEAR(tool.force_n[0], 0, 1e-9 * tool.force_n[1]);
    EXPECT_NEAR(tool.force_n[2], 0, 1e-9 * tool.force_n[1]);
    EXPECT_NEAR(tool.torque_n_m.norm(), 0, 1e-12);
  }
}

/// The force grows on when the centre passes the surface, and goes on pushing the tool out.
TEST(ProbeOnARigidBlock, IsPushedOutWithItsCentreInside) {
  StagedScene<double> staged(rigid_block());
  for (const double depth : {0.049, 0.0499999, 0.05, 0.0500001, 0.051, 0.1}) {
    place(staged, {0.3, 1.05 - depth, 0.7}, 0.05);
    staged.step();
    EXPECT_NEAR(measured(staged).force_n[1], kPenalty * 0.5 * depth, 1e-6 * kPenalty * depth) << "at " << depth << " m";
  }
}

/// A centre inside of one body is not inside of its neighbour: that one is pushed away and not drawn in.
TEST(ProbeBetweenTwoBodies, PushesTheOneThatItIsNotIn) {
  v1::Scene scene = box_scene(mesh::testing::unit_grid(2));
  v1::Body& neighbour = *scene.add_bodies();
  neighbour = scene.bodies(0);
  neighbour.set_name("neighbour");
  neighbour.mutable_mesh()->mutable_translation_m()->set_x(1.02);
  for (const std::uint32_t patches : {1u, 3u}) {
    StagedScene<double> staged(scene, patches);
    place(staged, {0.97, 0.4, 0.6}, 0.1);  // 3 cm inside of the first, 5 cm before the second
    staged.step();
    const Eigen::VectorXd v = staged.by_node(staged.view.state.velocity);
    Vec3<double> momentum[2] = {Vec3<double>::Zero(), Vec3<double>::Zero()};
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      momentum[node / 27] += staged.model.inertia[4 * std::size_t{staged.row(node)}] * v.segment<3>(3 * node);
    }
    EXPECT_LT(momentum[0][0], -1) << "over the sphere and out of it";
    EXPECT_GT(momentum[1][0], 1);
  }
}

/// Compares the sign by pseudonormal with a search for an element that contains the point: at faces, edges and corners,
/// sharp and blunt.
/// Returns how many points were inside.
int check_sides(const mesh::Mesh& mesh, std::uint32_t patches, std::uint32_t seed) {
  StagedScene<double> staged(box_scene(mesh), patches);
  Eigen::AlignedBox3d box;
  for (const Eigen::Vector3d& x : mesh.nodes) box.extend(x);
  const auto contains = [&](const Eigen::Vector3d& p, std::span<const std::uint32_t> nodes) {
    Mat3<double> edges;
    for (int k = 0; k < 3; ++k)
      edges.col(k) = mesh.nodes[nodes[static_cast<std::size_t>(k) + 1]] - mesh.nodes[nodes[0]];
    const Vec3<double> w = edges.inverse() * (p - mesh.nodes[nodes[0]]);
    return w.minCoeff() >= 0 && w.sum() <= 1;
  };
  const auto elements = mesh::element_nodes(mesh);
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(-0.25, 1.25);
  int inside_count = 0;
  for (int i = 0; i < 400; ++i) {
    const Eigen::Vector3d p =
        box.min() + box.sizes().cwiseProduct(Eigen::Vector3d(uniform(random), uniform(random), uniform(random)));
    const bool inside =
        std::any_of(elements.begin(), elements.end(), [&](const auto& nodes) { return contains(p, nodes); });
    inside_count += inside ? 1 : 0;
    place(staged, p, 0.05);
    staged.run(StageKind::kDetectContact);
    const auto* first = staged.view.contact.closest;
    const auto* nearest = std::min_element(
        first, first + patches, [](const auto& a, const auto& b) { return a.distance_squared < b.distance_squared; });
    EXPECT_EQ(nearest->side < 0, inside) << "point " << p.transpose() << ", " << std::sqrt(nearest->distance_squared)
                                         << " m from the surface";
  }
  return inside_count;
}

TEST(Side, IsRightAroundABoxWithADentedSurface) {
  EXPECT_GT(check_sides(mesh::testing::random_mesh(12, 3, 1.0), 1, 1), 50);
  EXPECT_GT(check_sides(mesh::testing::random_mesh(13, 3, 1.0), 4, 2), 50);
}

TEST(Side, IsRightAroundSharpTetrahedra) {
  std::mt19937 random(4);
  std::uniform_real_distribution<double> uniform(0, 1);
  int inside = 0;
  for (int trial = 0; trial < 20; ++trial) {
    mesh::Mesh mesh;
    for (int k = 0; k < 4; ++k) mesh.nodes.push_back({uniform(random), uniform(random), 0.2 * uniform(random)});
    mesh.blocks.push_back({mesh::Shape::kTetrahedron, {0, 1, 2, 3}});
    const double volume = mesh::six_volumes(mesh.nodes[0], mesh.nodes[1], mesh.nodes[2], mesh.nodes[3]) / 6;
    if (std::abs(volume) < 3e-3) continue;
    if (volume < 0) std::swap(mesh.nodes[0], mesh.nodes[1]);
    inside += check_sides(mesh, 1, static_cast<std::uint32_t>(trial));
  }
  EXPECT_GT(inside, 50);
}

}  // namespace
}  // namespace tensormass::contact
