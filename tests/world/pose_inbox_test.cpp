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

/// A pose of a session; valid_for_s 0: without.
v1::ToolPose session_pose(std::uint64_t session, std::uint64_t sequence, double valid_for_s = 0) {
  v1::ToolPose out = pose(session + 100, sequence);
  out.set_session(session);
  if (valid_for_s > 0) out.set_valid_for_s(valid_for_s);
  return out;
}

constexpr auto kClient = PoseSource::kClient, kOperator = PoseSource::kOperator;

TEST(PoseInbox, NobodyUsesUpTheSequencesOfASession) {
  PoseInbox inbox;
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 1)));
  // Everybody can read the client's id in the feedback, and an id may be the number of a session.
  v1::ToolPose forged = pose(107, std::numeric_limits<std::uint64_t>::max());
  EXPECT_TRUE(inbox.submit(probe(), forged));
  forged = pose(7, std::numeric_limits<std::uint64_t>::max());
  EXPECT_TRUE(inbox.submit(probe(), forged));
  forged = session_pose(8, std::numeric_limits<std::uint64_t>::max());
  forged.set_client_id(107);
  EXPECT_TRUE(inbox.submit(probe(), forged));
  EXPECT_TRUE(inbox.submit(probe(), session_pose(7, 2)));
  EXPECT_FALSE(inbox.submit(probe(), session_pose(7, 2)));
}

TEST(PoseInbox, AClaimRefusesOthersUntilItsLastPoseExpires) {
  using namespace std::chrono_literals;
  PoseInbox inbox;
  const Clock::time_point begin = Clock::now();
  ASSERT_TRUE(inbox.submit(probe(), pose(1, 1), kClient, begin));
  EXPECT_FALSE(inbox.take()->stamp.claims) << "without a session the newest pose counts";
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 1, 0.5), kClient, begin));
  EXPECT_TRUE(inbox.take()->stamp.claims);
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 2, 0.5), kClient, begin + 400ms));
  for (const v1::ToolPose& other : {pose(1, 2), pose(0, 0), pose(107, 9), session_pose(8, 1, 0.5)}) {
    const auto refused = inbox.submit(probe(), other, kClient, begin + 899ms);
    ASSERT_FALSE(refused);
    EXPECT_EQ(refused.error().code, ErrorCode::kFailedPrecondition);
    EXPECT_NE(refused.error().message.find("client 0x6b claims it"), std::string::npos) << refused.error().message;
    EXPECT_NE(refused.error().message.find("MoveTool"), std::string::npos) << refused.error().message;
  }
  EXPECT_EQ(inbox.take()->stamp.sequence, 2u);
  EXPECT_EQ(inbox.rejected(), 4u);
  // The refused ones have used up no sequence.
  ASSERT_TRUE(inbox.submit(probe(), session_pose(8, 1, 0.5), kClient, begin + 901ms));
  EXPECT_FALSE(inbox.submit(probe(), session_pose(7, 3, 0.5), kClient, begin + 902ms)) << "now it is the other's";
}

TEST(PoseInbox, ASessionHandsOverByAPoseThatHoldsUntilTheNextOne) {
  PoseInbox inbox;
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 1, 3600)));
  ASSERT_FALSE(inbox.submit(probe(), pose(1, 1)));
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 2)));
  EXPECT_FALSE(inbox.take()->stamp.claims);
  EXPECT_TRUE(inbox.submit(probe(), pose(1, 1)));
}

TEST(PoseInbox, TheOperatorTakesAToolOverAndKeepsIt) {
  using namespace std::chrono_literals;
  PoseInbox inbox;
  const Clock::time_point begin = Clock::now();
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 1, 0.5), kClient, begin));
  ASSERT_TRUE(inbox.submit(probe(), pose(1, 1), kOperator, begin + 100ms));
  // The hand goes on and is refused, and told why.
  for (std::uint64_t i = 2; i < 30; ++i) {
    const auto refused = inbox.submit(probe(), session_pose(7, i, 0.5), kClient, begin + i * 100ms);
    ASSERT_FALSE(refused) << i;
    EXPECT_NE(refused.error().message.find("MoveTool took it over"), std::string::npos) << refused.error().message;
  }
  // Scripts and new sessions move the tool.
  EXPECT_TRUE(inbox.submit(probe(), pose(2, 1), kClient, begin + 2900ms));
  EXPECT_TRUE(inbox.submit(probe(), session_pose(8, 1), kClient, begin + 2900ms));
  // The hand paused for its half second, and takes the tool again.
  EXPECT_FALSE(inbox.submit(probe(), session_pose(7, 40, 0.5), kClient, begin + 3399ms));
  EXPECT_TRUE(inbox.submit(probe(), session_pose(7, 41, 0.5), kClient, begin + 3900ms));
}

TEST(PoseInbox, AnOperatorWithASessionClaims) {
  PoseInbox inbox;
  ASSERT_TRUE(inbox.submit(probe(), session_pose(7, 1, 3600)));
  ASSERT_TRUE(inbox.submit(probe(), session_pose(9, 1, 3600), kOperator));
  EXPECT_FALSE(inbox.submit(probe(), session_pose(8, 1, 3600)));
  EXPECT_FALSE(inbox.submit(probe(), session_pose(7, 2, 3600)));
  EXPECT_TRUE(inbox.submit(probe(), session_pose(9, 2, 3600)));
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
