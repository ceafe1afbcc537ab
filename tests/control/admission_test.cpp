#include "control/admission.h"

#include <gtest/gtest.h>

#include "control/scene_cost.h"
#include "support/refused.h"

namespace tensormass::control {
namespace {

constexpr double kMib = 1 << 20;

v1::Scene grid(std::uint32_t cells, v1::Shape shape = v1::SHAPE_UNSPECIFIED) {
  v1::Scene scene;
  scene.set_name("block");
  v1::Grid& grid = *scene.add_bodies()->mutable_mesh()->mutable_grid();
  grid.set_cells_x(cells);
  grid.set_cells_y(cells);
  grid.set_cells_z(cells);
  grid.set_shape(shape);
  return scene;
}

double nothing() { return 0; }
double thousand_mib() { return 1000 * kMib; }

TEST(SceneCost, CountsTheElementsOfAGrid) {
  EXPECT_EQ(estimate_cost(grid(100)).elements, 6e6);
  EXPECT_EQ(estimate_cost(grid(100, v1::SHAPE_WEDGE)).elements, 2e6);
  EXPECT_EQ(estimate_cost(grid(100, v1::SHAPE_HEXAHEDRON)).elements, 1e6);
  EXPECT_GT(estimate_cost(grid(100)).bytes, 3e9);
  // No count overflows.
  EXPECT_GT(estimate_cost(grid(~0u)).elements, 1e29);
}

TEST(SceneCost, CountsPackedElementsOfEachShape) {
  v1::Scene scene;
  v1::PackedMesh& mesh = *scene.add_bodies()->mutable_mesh()->mutable_packed();
  mesh.set_node_positions(std::string(24 * 1000, '\0'));
  v1::PackedElements& tetrahedra = *mesh.add_elements();
  tetrahedra.set_nodes(std::string(16 * 300, '\0'));
  const double linear = estimate_cost(scene).bytes;
  v1::PackedElements& hexahedra = *mesh.add_elements();
  hexahedra.set_shape(v1::SHAPE_HEXAHEDRON);
  hexahedra.set_nodes(std::string(32 * 50, '\0'));
  const SceneCost cost = estimate_cost(scene);
  EXPECT_EQ(cost.elements, 350);
  EXPECT_EQ(cost.nodes, 1000);
  EXPECT_GT(cost.bytes, linear);
  // Elements that the daemon makes quadratic cost as much as quadratic ones.
  scene.mutable_bodies(0)->set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
  EXPECT_GT(estimate_cost(scene).bytes, 2 * cost.bytes);
}

TEST(SceneCost, CountsTheTestsOfNodesAgainstRegions) {
  v1::Scene scene = grid(100);
  const double without = estimate_cost(scene).compile_s;
  for (int i = 0; i < 65'536; ++i) scene.mutable_bodies(0)->add_fixed();
  EXPECT_GT(estimate_cost(scene).compile_s, without + 100);
}

TEST(Admission, NamesTheNumberTheLimitAndTheOption) {
  Admission admission({.scene_bytes = 1000 * kMib, .all_bytes = 1200 * kMib, .load_s = 60}, nothing);
  EXPECT_REFUSED(admission.admit(grid(100)), ErrorCode::kResourceExhausted, "more than --max-scene-mib 1000");
  EXPECT_REFUSED(admission.admit(grid(100)), ErrorCode::kResourceExhausted, "about 6000000 elements");
  EXPECT_REFUSED(admission.admit(grid(200, v1::SHAPE_PYRAMID)), ErrorCode::kResourceExhausted,
                 "more than --max-load-s 60");
  EXPECT_TRUE(admission.admit(grid(50)));
}

TEST(Admission, CountsWhatIsHeldAndWhatIsPromised) {
  Admission held({.all_bytes = 1200 * kMib}, thousand_mib);
  EXPECT_TRUE(held.admit(grid(30)));
  EXPECT_REFUSED(held.admit(grid(60)), ErrorCode::kResourceExhausted,
                 "but 1000 MiB of --max-memory-mib 1200 are taken");

  Admission promised({.all_bytes = 1000 * kMib}, nothing);
  {
    const auto first = promised.admit(grid(60));
    ASSERT_TRUE(first);
    EXPECT_REFUSED(promised.admit(grid(60)), ErrorCode::kResourceExhausted, "--max-memory-mib");
  }
  EXPECT_TRUE(promised.admit(grid(60))) << "the first load has ended";
}

TEST(Admission, LeavesToTheReaderWhatIsBeyondItsHardLimits) {
  Admission admission({.scene_bytes = 1}, nothing);
  EXPECT_TRUE(admission.admit(grid(~0u)));
}

TEST(Admission, KnowsTheMachine) {
  EXPECT_GT(Admission::machine_bytes(), 100 * kMib);
  EXPECT_GT(Admission::resident_bytes(), kMib);
  EXPECT_LT(Admission::resident_bytes(), Admission::machine_bytes());
  EXPECT_DOUBLE_EQ(Admission({}).limits().all_bytes, 0.8 * Admission::machine_bytes());
}

}  // namespace
}  // namespace tensormass::control
