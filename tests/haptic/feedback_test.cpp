#include <gtest/gtest.h>

#include <limits>

#include "haptic/feedback.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {
namespace {

v1::ToolFeedback good() {
  v1::ToolFeedback message;
  message.set_tool("probe");
  message.set_step(7);
  message.set_pose_sequence(41);
  message.set_client_time_ns(123);
  message.set_client_id(9);
  message.set_claimed(true);
  message.mutable_position_m()->set_x(0.1);
  message.mutable_force_n()->set_z(2.0);
  for (const double k : {100.0, 10.0, 0.0, 10.0, 50.0, 0.0, 0.0, 0.0, 20.0}) {
    message.mutable_local_model()->add_stiffness_n_per_m(k);
  }
  message.mutable_local_model()->set_valid_for_s(0.05);
  return message;
}

std::string refusal(const v1::ToolFeedback& message) {
  const auto feedback = decode_feedback(message.SerializeAsString(), 0);
  return feedback ? "accepted" : feedback.error().message;
}

TEST(Feedback, DecodesEveryFieldAndTheArrival) {
  const Feedback feedback = decode_feedback(good().SerializeAsString(), 456).value();
  EXPECT_EQ(feedback.step, 7u);
  EXPECT_EQ(feedback.pose_sequence, 41u);
  EXPECT_EQ(feedback.client_time_ns, 123);
  EXPECT_EQ(feedback.client_id, 9u);
  EXPECT_TRUE(feedback.claimed);
  EXPECT_EQ(feedback.arrival_ns, 456);
  EXPECT_EQ(feedback.position_m, Eigen::Vector3d(0.1, 0.0, 0.0));
  EXPECT_EQ(feedback.force_n, Eigen::Vector3d(0.0, 0.0, 2.0));
  EXPECT_EQ(feedback.stiffness_n_per_m(0, 1), 10.0);
  EXPECT_EQ(feedback.valid_for_s, 0.05);
  // Largest eigenvalue of [[100, 10], [10, 50]]: 75 + sqrt(25² + 10²).
  EXPECT_NEAR(feedback.largest_stiffness_n_per_m, 75.0 + std::sqrt(725.0), 1e-9);
}

TEST(Feedback, HasTorqueOrientationAndTheLoadOfTheJaws) {
  v1::ToolFeedback message = good();
  EXPECT_TRUE(decode_feedback(message.SerializeAsString(), 0)->torque_n_m.isZero(0.0));
  EXPECT_TRUE(decode_feedback(message.SerializeAsString(), 0)->orientation.isApprox(Eigen::Quaterniond::Identity()));
  message.mutable_torque_n_m()->set_y(0.2);
  message.mutable_orientation()->set_x(0.6);
  message.mutable_orientation()->set_w(0.8);
  message.add_joint_loads(-0.3);
  const Feedback feedback = decode_feedback(message.SerializeAsString(), 0).value();
  EXPECT_EQ(feedback.torque_n_m, Eigen::Vector3d(0.0, 0.2, 0.0));
  EXPECT_EQ(feedback.orientation.x(), 0.6);
  EXPECT_EQ(feedback.jaw_torque_n_m, -0.3);
  message.add_joint_loads(1.0);
  EXPECT_EQ(decode_feedback(message.SerializeAsString(), 0)->jaw_torque_n_m, 0.0)
      << "a tool with two joints has no jaws";
}

TEST(Feedback, IsValidForNoTimeWithoutALocalModel) {
  v1::ToolFeedback message = good();
  message.clear_local_model();
  const Feedback feedback = decode_feedback(message.SerializeAsString(), 0).value();
  EXPECT_EQ(feedback.valid_for_s, 0.0);
  EXPECT_TRUE(feedback.stiffness_n_per_m.isZero(0.0));
}

TEST(Feedback, SaysThatTheSceneRecovers) {
  v1::ToolFeedback message = good();
  EXPECT_FALSE(decode_feedback(message.SerializeAsString(), 0)->recovering);
  message.set_recovering(true);
  EXPECT_TRUE(decode_feedback(message.SerializeAsString(), 0)->recovering);
}

// A tool that has a mass or gives way is elsewhere than the hand, and the local model belongs to the hand.
TEST(Feedback, HasTheSpringOfABladeIfItsDirectionAndNumbersAreSound) {
  v1::ToolFeedback message = good();
  EXPECT_EQ(decode_feedback(message.SerializeAsString(), 0)->yielding.limit_n, 0.0);
  v1::YieldingSpring& spring = *message.mutable_local_model()->mutable_yielding();
  spring.mutable_direction()->set_y(-1.0);
  spring.set_stiffness_n_per_m(300.0);
  spring.set_limit_n(0.4);
  const Feedback feedback = decode_feedback(message.SerializeAsString(), 0).value();
  EXPECT_EQ(feedback.yielding.direction, Eigen::Vector3d(0.0, -1.0, 0.0));
  EXPECT_EQ(feedback.yielding.stiffness_n_per_m, 300.0);
  EXPECT_EQ(feedback.yielding.limit_n, 0.4);
  for (const double wrong :
       {0.0, -1.0, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    v1::ToolFeedback bad = message;
    bad.mutable_local_model()->mutable_yielding()->set_limit_n(wrong);
    EXPECT_NE(refusal(bad).find("yielding"), std::string::npos) << wrong;
    bad = message;
    bad.mutable_local_model()->mutable_yielding()->set_stiffness_n_per_m(wrong);
    EXPECT_NE(refusal(bad).find("yielding"), std::string::npos) << wrong;
    bad = message;
    bad.mutable_local_model()->mutable_yielding()->mutable_direction()->set_y(wrong == -1.0 ? -1.1 : wrong);
    EXPECT_NE(refusal(bad).find("unit vector"), std::string::npos) << wrong;
  }
}

TEST(Feedback, TheLocalModelIsAtItsAnchorIfItHasOne) {
  v1::ToolFeedback message = good();
  message.mutable_local_model()->mutable_anchor_m()->set_y(0.3);
  EXPECT_EQ(decode_feedback(message.SerializeAsString(), 0)->position_m, Eigen::Vector3d(0.0, 0.3, 0.0));
  message.mutable_local_model()->mutable_anchor_m()->set_y(std::numeric_limits<double>::quiet_NaN());
  EXPECT_NE(refusal(message).find("position"), std::string::npos);
}

v1::ToolPose encoded(const OutgoingPose& pose) {
  std::string bytes;
  encode_pose(pose, bytes);
  v1::ToolPose message;
  EXPECT_TRUE(message.ParseFromString(bytes));
  return message;
}

TEST(Pose, HasTheAngleOfTheJawsIfTheDeviceHasOne) {
  OutgoingPose pose;
  EXPECT_EQ(encoded(pose).joint_values_size(), 0);
  pose.pose.jaw_angle_rad = 0.4;
  const v1::ToolPose message = encoded(pose);
  ASSERT_EQ(message.joint_values_size(), 1);
  EXPECT_EQ(message.joint_values(0), 0.4);
}

TEST(Pose, HasTheLevelOfThePower) {
  OutgoingPose pose;
  EXPECT_EQ(encoded(pose).level(), 0.0);
  pose.level = 0.25;
  const v1::ToolPose message = encoded(pose);
  EXPECT_EQ(message.level(), 0.25);
  EXPECT_EQ(message.valid_for_s(), kPoseValidForS) << "the power of a client that dies ends with its pose";
}

TEST(Feedback, RefusesValuesThatCouldPushWithoutBound) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto with = [](auto change) {
    v1::ToolFeedback message = good();
    change(message);
    return refusal(message);
  };
  EXPECT_EQ(refusal(good()), "accepted");
  EXPECT_NE(with([&](auto& m) { m.mutable_force_n()->set_x(nan); }).find("force"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.mutable_torque_n_m()->set_z(nan); }).find("torque"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.add_joint_loads(nan); }).find("jaws"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.mutable_orientation()->set_w(nan); }).find("orientation"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.mutable_position_m()->set_x(nan); }).find("position"), std::string::npos);
  EXPECT_NE(with([](auto& m) { m.mutable_position_m()->set_x(1e30); }).find("position"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.mutable_local_model()->set_stiffness_n_per_m(4, nan); }).find("finite"),
            std::string::npos);
  EXPECT_NE(with([](auto& m) { m.mutable_local_model()->set_stiffness_n_per_m(1, 90.0); }).find("symmetric"),
            std::string::npos);
  EXPECT_NE(with([](auto& m) {
              for (double& k : *m.mutable_local_model()->mutable_stiffness_n_per_m()) k = 1.7e308;
            }).find("too large"),
            std::string::npos)
      << "sums of two are infinite";
  EXPECT_NE(with([](auto& m) { m.mutable_local_model()->set_stiffness_n_per_m(8, -20.0); }).find("semi-definite"),
            std::string::npos);
  EXPECT_NE(with([](auto& m) { m.mutable_local_model()->add_stiffness_n_per_m(1.0); }).find("3×3"), std::string::npos);
  EXPECT_NE(with([&](auto& m) { m.set_step_s(nan); }).find("time of the server"), std::string::npos);
  EXPECT_NE(with([](auto& m) { m.set_pose_waited_s(-1.0); }).find("time of the server"), std::string::npos);
  EXPECT_NE(with([](auto& m) { m.mutable_local_model()->set_valid_for_s(-1.0); }).find("valid_for_s"),
            std::string::npos);
  EXPECT_FALSE(decode_feedback("\xff\xff garbage", 0));
}

TEST(Feedback, APoseArrivesAsItWasSent) {
  OutgoingPose pose;
  pose.sequence = 5;
  pose.client_id = std::numeric_limits<std::uint64_t>::max();
  pose.client_time_ns = 77;
  pose.session = 11;
  pose.pose.position_m = {1.0, 2.0, 3.0};
  pose.pose.orientation = Eigen::Quaterniond(0.0, 0.6, 0.0, 0.8);
  std::string bytes = "what was there before";
  encode_pose(pose, bytes);
  v1::ToolPose message;
  ASSERT_TRUE(message.ParseFromString(bytes));
  EXPECT_EQ(message.sequence(), 5u);
  EXPECT_EQ(message.client_id(), std::numeric_limits<std::uint64_t>::max());
  EXPECT_EQ(message.client_time_ns(), 77u);
  EXPECT_EQ(message.session(), 11u);
  EXPECT_EQ(message.valid_for_s(), kPoseValidForS);
  EXPECT_EQ(message.position_m().y(), 2.0);
  EXPECT_EQ(message.orientation().x(), 0.6);
  EXPECT_EQ(message.orientation().z(), 0.8);
}

TEST(FeedbackInbox, KeepsTheNewestAndCountsTheMalformed) {
  FeedbackInbox inbox;
  EXPECT_FALSE(inbox.take());
  v1::ToolFeedback message = good();
  inbox.offer(message.SerializeAsString(), 1);
  message.set_step(8);
  inbox.offer(message.SerializeAsString(), 2);
  inbox.offer("\xff\xff", 3);
  EXPECT_EQ(inbox.malformed(), 1u);
  EXPECT_EQ(inbox.take().value().step, 8u);
  EXPECT_FALSE(inbox.take()) << "taken once";
}

TEST(FeedbackInbox, DoesNotLoseARecoveryWithTheMessageThatIsReplaced) {
  FeedbackInbox inbox;
  v1::ToolFeedback message = good();
  message.set_recovering(true);
  inbox.offer(message.SerializeAsString(), 1);
  message.set_recovering(false);
  message.set_step(8);
  inbox.offer(message.SerializeAsString(), 2);
  const Feedback newest = inbox.take().value();
  EXPECT_EQ(newest.step, 8u);
  EXPECT_TRUE(newest.recovering);
  inbox.offer(message.SerializeAsString(), 3);
  EXPECT_FALSE(inbox.take().value().recovering);
}

}  // namespace
}  // namespace tensormass::haptic
