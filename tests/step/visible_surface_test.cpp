#include "step/visible_surface.h"

#include <gtest/gtest.h>

#include "backend/cpu/team.h"
#include "mesh/random_mesh.h"
#include "support/dense_system.h"
#include "support/staged_scene.h"

namespace tensormass::step {
namespace {

/// A point of a skin follows its element: under an affine map of the mesh it goes where the map sends it.
TEST(Visible, SkinFollowsAnAffineMap) {
  const mesh::Mesh mesh = mesh::testing::random_mesh(6, 4, 1.0);
  v1::Scene scene = tests::packed_scene(mesh, true);
  scene.mutable_streams()->set_frame_rate_hz(60);
  const Eigen::Vector3d skin[4] = {{0.31, 0.42, 0.53}, {0.7, 0.2, 0.9}, {0.1, 0.8, 0.4}, {0.5, 0.5, 0.1}};
  const std::uint32_t triangles[2][3] = {{0, 1, 2}, {1, 2, 3}};
  v1::PackedTriangles& packed = *scene.mutable_bodies(0)->mutable_skin()->mutable_packed();
  packed.set_vertex_positions(skin, sizeof skin);
  packed.set_triangles(triangles, sizeof triangles);

  for (const std::uint32_t patches : {1u, 3u}) {
    tests::StagedScene<double> staged(scene, patches);
    ASSERT_EQ(staged.view.surface.vertex_count, 4u);
    const Mat3<double> gradient = Mat3<double>::Random() * 0.2;
    Eigen::VectorXd u(3 * staged.node_count());
    for (std::uint32_t node = 0; node < staged.node_count(); ++node) {
      u.segment<3>(3 * node) = gradient * mesh.nodes[node];
    }
    staged.put(staged.view.state.displacement, u);
    for (std::uint32_t patch = 0; patch < patches; ++patch) {
      backend::cpu::Barrier barrier(1);
      gather_surface(backend::cpu::Team(patch, patches, barrier), staged.view.patches, staged.view.state,
                     staged.view.surface);
    }
    for (int i = 0; i < 4; ++i) {
      const Eigen::Vector3d expected = skin[i] + gradient * skin[i];
      for (int c = 0; c < 3; ++c) EXPECT_NEAR(staged.view.surface.positions[3 * i + c], expected[c], 1e-6);
    }
  }
}

}  // namespace
}  // namespace tensormass::step
