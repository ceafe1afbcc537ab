#include <gtest/gtest.h>

#include <limits>

#include "haptic/discovery.h"

namespace tensormass::haptic {
namespace {

DiscoveredTool tool_above() {
  DiscoveredTool tool;
  tool.tool_position_m = {0.0, 0.0, 0.15};
  tool.tip_offset_m = {0.0, 0.0, -0.05};
  tool.radius_m = 0.01;
  return tool;
}

Surface surface_of(const std::vector<float>& positions) {
  return {{reinterpret_cast<const char*>(positions.data()), positions.size() * sizeof(float)}, {}};
}

Result<Aim> aim_at(const std::vector<float>& positions) {
  return aim_at_nearest_surface(tool_above(), surface_of(positions));
}

TEST(Aim, PointsFromTheSphereToTheNearestVertexAndStopsAtTouch) {
  const std::vector<float> positions{0.3f, 0.0f, 0.0f, 0.0f, 0.0f, 0.02f, 0.0f, 0.4f, 0.0f};
  const Aim aim = aim_at(positions).value();
  EXPECT_LT((aim.direction - Eigen::Vector3d(0.0, 0.0, -1.0)).norm(), 1e-6);
  // The centre of the sphere is 0.08 m above the vertex, its radius is 0.01 m.
  EXPECT_LT((aim.contact_m - Eigen::Vector3d(0.0, 0.0, 0.15 - 0.07)).norm(), 1e-6);
  EXPECT_NEAR(extent_of(surface_of(positions), tool_above()).value(), std::sqrt(0.3 * 0.3 + 0.4 * 0.4 + 0.02 * 0.02),
              1e-6);
}

TEST(Aim, AToolInsideTheSurfaceStartsAtItsOwnPosition) {
  EXPECT_EQ(aim_at({0.0f, 0.0f, 0.095f}).value().contact_m, Eigen::Vector3d(0.0, 0.0, 0.15));
}

TEST(Aim, FailsWithoutADirection) {
  EXPECT_NE(aim_at({}).error().message.find("--press-at"), std::string::npos);
  EXPECT_NE(aim_at({0.0f, 0.0f, 0.1f}).error().message.find("--direction"), std::string::npos);
  const std::vector<float> not_finite{std::numeric_limits<float>::quiet_NaN(), 0.0f, 0.0f};
  EXPECT_NE(aim_at(not_finite).error().message.find("finite"), std::string::npos);
  EXPECT_NE(extent_of(surface_of(not_finite), tool_above()).error().message.find("finite"), std::string::npos);
}

TEST(Aim, TheErrorSaysWhyThereIsNoSurface) {
  const auto aim = aim_at_nearest_surface(tool_above(), {{}, "scene 'quiet' has no frames"});
  ASSERT_FALSE(aim);
  EXPECT_EQ(aim.error().message,
            "the scene has no surface to press (scene 'quiet' has no frames); give --press-at and --direction");
}

TEST(Aim, WithoutASurfaceTheExtentFollowsFromTheToolsRadius) {
  EXPECT_DOUBLE_EQ(extent_of(surface_of({}), tool_above()).value(), 20 * 0.01);
}

}  // namespace
}  // namespace tensormass::haptic
