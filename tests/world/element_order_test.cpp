#include <algorithm>

#include <gtest/gtest.h>

#include "mesh/elevate.h"
#include "mesh/grid.h"
#include "support/backends.h"
#include "support/dense_system.h"
#include "world/world.h"

/// Bodies that are made quadratic when their scene is loaded.
namespace tensormass::world {
namespace {

class ElementOrder : public tests::OnBackend {};

/// The same body twice: linear tetrahedra with element_order, and its quadratic tetrahedra as they are sent packed. A
/// probe presses both.
TEST_P(ElementOrder, AMadeQuadraticBodyStepsBitwiseAsTheSameQuadraticTetrahedra) {
  for (const bool double_precision : {false, true}) {
    v1::Scene made = tests::block_with_probe(double_precision, 6);
    v1::Body& body = *made.mutable_bodies(0);
    body.set_quadrature(v1::QUADRATURE_SELECTIVE);
    v1::Scene packed = made;
    body.set_element_order(v1::ELEMENT_ORDER_QUADRATIC);

    const mesh::Mesh linear = mesh::make_grid(Eigen::Vector3d::Zero(), {0.1, 0.05, 0.1}, 6, 3, 6).value();
    const mesh::Mesh quadratic = mesh::elevate(linear, "here").value().mesh;
    *packed.mutable_bodies(0)->mutable_mesh() = tests::packed_scene(quadratic, false).bodies(0).mesh();

    const auto first = start(made), second = start(packed);
    ASSERT_EQ(first->model().bodies[0].node_count, 13u * 7 * 13);
    EXPECT_EQ(first->model().bodies[0].volume_m3, second->model().bodies[0].volume_m3);
    for (World* world : {first.get(), second.get()}) world->set_tool_target(0, {{0.05, 0.052, 0.05}, {1, 0, 0, 0}});
    for (int i = 0; i < 8; ++i) {
      ASSERT_TRUE(first->step(true));
      ASSERT_TRUE(second->step(true));
      ASSERT_EQ(first->positions(first->model().bodies[0]), second->positions(second->model().bodies[0])) << i;
      EXPECT_EQ(first->readings()[0].force_n, second->readings()[0].force_n) << i;
    }
    EXPECT_GT(first->readings()[0].force_n.y(), 0.01) << "the probe touches";
    EXPECT_TRUE(std::ranges::equal(first->visible_positions(), second->visible_positions()));
  }
}

TM_ON_EACH_BACKEND(ElementOrder);

}  // namespace
}  // namespace tensormass::world
