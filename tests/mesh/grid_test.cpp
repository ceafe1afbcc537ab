#include "mesh/grid.h"

#include <limits>
#include <map>

#include <gtest/gtest.h>

#include "mesh/admission.h"
#include "mesh/shapes.h"
#include "random_mesh.h"

namespace tensormass::mesh {
namespace {

TEST(Grid, NodesRunXFastest) {
  const Mesh mesh = make_grid({1.0, 2.0, 3.0}, {4.0, 6.0, 8.0}, 2, 3, 4).value();
  ASSERT_EQ(mesh.nodes.size(), 3u * 4u * 5u);
  EXPECT_EQ(mesh.nodes[1 + 3 * (2 + 4 * 3)], Eigen::Vector3d(3.0, 6.0, 9.0));
  EXPECT_EQ(mesh.nodes.back(), Eigen::Vector3d(5.0, 8.0, 11.0));
}

TEST(Grid, ElementsFillTheBoxAndArePositivelyWound) {
  const Mesh mesh = make_grid({0.0, 0.0, 0.0}, {4.0, 6.0, 8.0}, 2, 3, 4).value();
  EXPECT_EQ(element_count(mesh), 6u * 2u * 3u * 4u);
  const Result<MeshReport> report = admit(mesh, "box");
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_NEAR(report->volume_m3, 4.0 * 6.0 * 8.0, 1e-12);
  EXPECT_EQ(report->component_count, 1u);
}

TEST(Grid, FacesConformAcrossCells) {
  const Mesh mesh = testing::unit_grid(3);
  std::map<std::array<std::uint32_t, 3>, int> uses;
  for_each_element(mesh, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Face& face : shape.faces) {
      std::array<std::uint32_t, 3> key{nodes[face.nodes[0]], nodes[face.nodes[1]], nodes[face.nodes[2]]};
      std::sort(key.begin(), key.end());
      ++uses[key];
    }
  });
  int outside = 0;
  for (const auto& [key, count] : uses) {
    ASSERT_LE(count, 2);
    if (count == 2) continue;
    ++outside;  // such a face must lie in a side of the box
    bool in_side = false;
    for (int axis = 0; axis < 3; ++axis) {
      for (const double side : {0.0, 1.0}) {
        in_side |=
            mesh.nodes[key[0]][axis] == side && mesh.nodes[key[1]][axis] == side && mesh.nodes[key[2]][axis] == side;
      }
    }
    EXPECT_TRUE(in_side);
  }
  EXPECT_EQ(outside, 6 * 9 * 2);
}

TEST(Grid, RefusesWhatIsNoBox) {
  const Eigen::Vector3d zero = Eigen::Vector3d::Zero(), one = Eigen::Vector3d::Ones();
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto message = [](const Result<Mesh>& mesh) { return mesh ? std::string("accepted") : mesh.error().message; };
  EXPECT_NE(message(make_grid(zero, one, 1, 0, 1)).find("cells_y is 0"), std::string::npos);
  EXPECT_NE(message(make_grid(zero, {1.0, 1.0, -1.0}, 1, 1, 1)).find("size_m.z is -1"), std::string::npos);
  EXPECT_NE(message(make_grid(zero, {nan, 1.0, 1.0}, 1, 1, 1)).find("size_m.x"), std::string::npos);
  EXPECT_NE(message(make_grid({0.0, nan, 0.0}, one, 1, 1, 1)).find("origin_m.y"), std::string::npos);
  const Result<Mesh> huge = make_grid(zero, one, 0xFFFFFFFFu, 0xFFFFFFFFu, 0xFFFFFFFFu);
  EXPECT_NE(message(huge).find("kMaxNodes"), std::string::npos);
  EXPECT_EQ(huge.error().code, ErrorCode::kResourceExhausted);
}

}  // namespace
}  // namespace tensormass::mesh
