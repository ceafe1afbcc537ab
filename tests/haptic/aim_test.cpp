#include <gtest/gtest.h>

#include <limits>

#include "haptic/discovery.h"

namespace tensormass::haptic {
namespace {

DiscoveredTool tool_above(const std::vector<float>& positions) {
  DiscoveredTool tool;
  tool.tool_position_m = {0.0, 0.0, 0.15};
  tool.tip_offset_m = {0.0, 0.0, -0.05};
  tool.radius_m = 0.01;
  tool.surface_positions.assign(reinterpret_cast<const char*>(positions.data()), positions.size() * sizeof(float));
  return tool;
}

TEST(Aim, PointsFromTheSphereToTheNearestVertexAndStopsAtTouch) {
  const Aim aim = aim_at_nearest_surface(tool_above({0.3f, 0.0f, 0.0f, 0.0f, 0.0f, 0.02f, 0.0f, 0.4f, 0.0f})).value();
  EXPECT_LT((aim.direction - Eigen::Vector3d(0.0, 0.0, -1.0)).norm(), 1e-6);
  // The sphere's centre is 0.08 above the vertex, its radius 0.01.
  EXPECT_LT((aim.contact_m - Eigen::Vector3d(0.0, 0.0, 0.15 - 0.07)).norm(), 1e-6);
  EXPECT_NEAR(aim.extent_m, std::sqrt(0.3 * 0.3 + 0.4 * 0.4 + 0.02 * 0.02), 1e-6);
}

TEST(Aim, AToolInsideTheSurfaceStartsWhereItStands) {
  const Aim aim = aim_at_nearest_surface(tool_above({0.0f, 0.0f, 0.095f})).value();
  EXPECT_EQ(aim.contact_m, Eigen::Vector3d(0.0, 0.0, 0.15));
}

TEST(Aim, RefusesWhatGivesNoDirection) {
  EXPECT_NE(aim_at_nearest_surface(tool_above({})).error().message.find("--press-at"), std::string::npos);
  EXPECT_NE(aim_at_nearest_surface(tool_above({0.0f, 0.0f, 0.1f})).error().message.find("--direction"),
            std::string::npos);
  EXPECT_NE(aim_at_nearest_surface(tool_above({std::numeric_limits<float>::quiet_NaN(), 0.0f, 0.0f}))
                .error()
                .message.find("finite"),
            std::string::npos);
}

}  // namespace
}  // namespace tensormass::haptic
