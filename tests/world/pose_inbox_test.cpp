#include "world/pose_inbox.h"

#include <limits>

#include <gtest/gtest.h>

#include "support/scenes.h"

namespace tensormass::world {
namespace {

v1::ToolPose pose(std::uint64_t client, std::uint64_t sequence, double x = 0) {
  v1::ToolPose out;
  out.set_client_id(client);
  out.set_sequence(sequence);
  out.set_client_time_ns(1000 * sequence);
  out.mutable_position_m()->set_x(x);
  return out;
}

/// joints: that its poses must have, each from 0 to 1.
model::ToolModel probe(std::size_t joints = 0) {
  static constexpr std::array<physics::ToolParameter, 2> kJoints{{{"first", 0, 1}, {"second", 0, 1}}};
  model::ToolModel tool;
  tool.name = "probe";
  tool.joints = std::span(kJoints).first(joints);
  return tool;
}

TEST(PoseInbox, KeepsTheNewestPoseAndItsNumbersForFeedback) {
  PoseInbox inbox;
  EXPECT_EQ(inbox.take(), nullptr);
  ASSERT_TRUE(inbox.submit(probe(), pose(7, 1, 0.1)));
  ASSERT_TRUE(inbox.submit(probe(), pose(7, 2, 0.2)));
  const ReceivedPose* taken = inbox.take();
  ASSERT_NE(taken, nullptr);
  EXPECT_EQ(taken->pose.position_m[0], 0.2);
  EXPECT_EQ(taken->stamp.sequence, 2u);
  EXPECT_EQ(taken->stamp.client_time_ns, 2000u);
  EXPECT_EQ(taken->stamp.client_id, 7u);
  EXPECT_EQ(inbox.take(), nullptr);
  EXPECT_EQ(inbox.received(), 2u);
  EXPECT_EQ(inbox.superseded(), 1u);
  EXPECT_EQ(inbox.rejected(), 0u);
}

TEST(PoseInbox, RefusesPosesOfAnObstacle) {
  PoseInbox inbox;
  model::ToolModel table = probe();
  table.fixed = true;
  const auto refused = inbox.submit(table, pose(7, 1));
  ASSERT_FALSE(refused);
  EXPECT_NE(refused.error().message.find("tool 'probe'"), std::string::npos);
  EXPECT_NE(refused.error().message.find("fixed"), std::string::npos);
  EXPECT_EQ(inbox.take(), nullptr);
  EXPECT_EQ(inbox.rejected(), 1u);
}

TEST(PoseInbox, RefusesPosesThatAreNotNewerThanTheSameClientsLast) {
  PoseInbox inbox;
  ASSERT_TRUE(inbox.submit(probe(), pose(7, 5)));
  for (const std::uint64_t sequence : {5u, 4u, 0u}) {
    const auto refused = inbox.submit(probe(), pose(7, sequence));
    ASSERT_FALSE(refused);
    EXPECT_NE(refused.error().message.find("tool 'probe'"), std::string::npos);
    EXPECT_NE(refused.error().message.find("newer"), std::string::npos);
  }
  EXPECT_EQ(inbox.rejected(), 3u);
  EXPECT_TRUE(inbox.submit(probe(), pose(8, 1))) << "another client counts for itself";
  EXPECT_TRUE(inbox.submit(probe(), pose(7, 6))) << "and the first goes on";
}

TEST(PoseInbox, AlwaysTakesPosesOfScripts) {
  PoseInbox inbox;
  EXPECT_TRUE(inbox.submit(probe(), pose(0, 0, 1)));
  EXPECT_TRUE(inbox.submit(probe(), pose(0, 0, 2)));
  EXPECT_EQ(inbox.take()->pose.position_m[0], 2);
}

TEST(PoseInbox, TakesOneValueForEachJointOrNone) {
  PoseInbox inbox;
  v1::ToolPose message = pose(7, 1);
  message.add_joint_values(0.5);
  const auto none = inbox.submit(probe(0), message);
  ASSERT_FALSE(none);
  EXPECT_NE(none.error().message.find("1 values for a tool of 0 joints"), std::string::npos) << none.error().message;
  EXPECT_FALSE(inbox.submit(probe(2), message));
  ASSERT_TRUE(inbox.submit(probe(1), message));
  const ReceivedPose* taken = inbox.take();
  EXPECT_TRUE(taken->has_joints);
  EXPECT_EQ(taken->pose.joint_values[0], 0.5);
  message.set_sequence(2);
  for (const double value : {std::numeric_limits<double>::quiet_NaN(), -0.1, 1.1}) {
    message.set_joint_values(0, value);
    const auto refused = inbox.submit(probe(1), message);
    ASSERT_FALSE(refused);
    EXPECT_NE(refused.error().message.find("joint_values[0] (first)"), std::string::npos) << refused.error().message;
  }
  message.clear_joint_values();
  ASSERT_TRUE(inbox.submit(probe(1), message));
  EXPECT_FALSE(inbox.take()->has_joints);
}

TEST(PoseInbox, APoseHoldsForAsLongAsItSays) {
  PoseInbox inbox;
  ASSERT_TRUE(inbox.submit(probe(), pose(7, 1)));
  EXPECT_EQ(inbox.take()->valid_for_s, kUntilTheNext);
  v1::ToolPose message = pose(7, 2);
  message.set_valid_for_s(0.5);
  ASSERT_TRUE(inbox.submit(probe(), message));
  EXPECT_EQ(inbox.take()->valid_for_s, 0.5);
  message.set_sequence(3);
  for (const double seconds : {0.0, 0.01, -1.0, 4000.0, std::numeric_limits<double>::quiet_NaN()}) {
    message.set_valid_for_s(seconds);
    const auto refused = inbox.submit(probe(), message);
    ASSERT_FALSE(refused) << seconds;
    EXPECT_NE(refused.error().message.find("valid_for_s"), std::string::npos) << refused.error().message;
  }
  EXPECT_EQ(inbox.take(), nullptr);
}

TEST(PoseInbox, OfManyClientsOnlyTheOldestIsForgotten) {
  PoseInbox inbox;
  for (std::uint64_t client = 1; client <= 9; ++client) ASSERT_TRUE(inbox.submit(probe(), pose(client, 10)));
  for (std::uint64_t client = 2; client <= 9; ++client) EXPECT_FALSE(inbox.submit(probe(), pose(client, 10))) << client;
  EXPECT_TRUE(inbox.submit(probe(), pose(1, 10)));
}

TEST(PoseInbox, RefusesInvalidPoses) {
  PoseInbox inbox;
  const double bad[] = {std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity(), 1e9};
  for (const double value : bad) {
    EXPECT_FALSE(inbox.submit(probe(), pose(7, 1, value)));
    v1::ToolPose turned = pose(7, 1);
    turned.mutable_orientation()->set_w(value);
    EXPECT_FALSE(inbox.submit(probe(), turned));
  }
  v1::ToolPose nowhere = pose(7, 1);
  nowhere.clear_position_m();
  EXPECT_FALSE(inbox.submit(probe(), nowhere)) << "and not the origin";
  EXPECT_EQ(inbox.take(), nullptr);
  EXPECT_EQ(inbox.rejected(), 7u);
  EXPECT_TRUE(inbox.submit(probe(), pose(7, 1))) << "a refused pose leaves its sequence unused";
}

}  // namespace
}  // namespace tensormass::world
