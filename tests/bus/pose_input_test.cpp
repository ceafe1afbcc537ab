#include "bus/pose_input.h"

#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "bus/keys.h"
#include "core/limits.h"

namespace tensormass::bus {
namespace {

class PoseInputTest : public testing::Test {
 protected:
  std::vector<v1::ToolPose> poses;
  std::vector<std::string> refused_scenes;
  BusCounters counters;
  PoseInput input{
      "host",
      [this](std::string_view, std::string_view, const v1::ToolPose& pose, const Sender&) { poses.push_back(pose); },
      [this](const Refused& refused) { refused_scenes.emplace_back(refused.scene); }, counters};
  const std::string key = pose_key("host", "demo", "probe");
};

std::string serialized_pose() {
  v1::ToolPose pose;
  pose.set_sequence(7);
  pose.mutable_position_m()->set_z(0.25);
  return pose.SerializeAsString();
}

TEST_F(PoseInputTest, FramedPoseArrivesAsSent) {
  input.receive_framed(key + '\0' + serialized_pose());
  ASSERT_EQ(poses.size(), 1u);
  EXPECT_EQ(poses[0].sequence(), 7u);
  EXPECT_EQ(poses[0].position_m().z(), 0.25);
  EXPECT_EQ(input.malformed_count(), 0u);
}

TEST_F(PoseInputTest, RefusesAMalformedMessageAndNamesItsScene) {
  input.receive_framed("");
  input.receive_framed(key);
  input.receive_framed(key + "\xff" + serialized_pose());
  EXPECT_EQ(refused_scenes, (std::vector<std::string>{"", "", ""}));
  refused_scenes.clear();

  input.receive(key, "\xff\xff\xff\xff garbage");
  input.receive(key, "");
  input.receive(key, serialized_pose().substr(0, 5));
  // A valid pose with an unknown field that makes the message too long; without the limit it would parse.
  std::string too_long = serialized_pose();
  too_long += "\x7a";
  too_long += "\x80\x40";
  too_long += std::string(limits::kMaxPoseMessageBytes * 2, 'x');
  v1::ToolPose readable;
  ASSERT_TRUE(readable.ParseFromString(too_long.substr(0, serialized_pose().size() + 3 + 8192)));
  input.receive(key, too_long);
  EXPECT_EQ(refused_scenes, (std::vector<std::string>{"demo", "demo", "demo", "demo"}));
  EXPECT_EQ(input.malformed_count(), 7u);
  EXPECT_TRUE(poses.empty());
}

TEST_F(PoseInputTest, DropsAFloodUnreadAndTellsOfItOnce) {
  const std::string message = key + '\0' + serialized_pose();
  const auto dropped = [this](Carrier carrier) {
    return counters.read().refusals[static_cast<std::size_t>(carrier)][static_cast<std::size_t>(Refusal::kPoseRate)];
  };
  // More than a busy machine sends within the rate: some are beyond it, however long this takes.
  const Sender flooder{Carrier::kZeroMq, 7}, other{Carrier::kZeroMq, 8};
  std::uint64_t sent = 0;
  while (dropped(Carrier::kZeroMq) < 100 && sent < 10'000'000) {
    input.receive_framed(message, flooder);
    ++sent;
  }
  EXPECT_EQ(poses.size() + dropped(Carrier::kZeroMq), sent);
  EXPECT_GE(refused_scenes.size(), 1u);
  EXPECT_LT(refused_scenes.size(), 100u);
  EXPECT_EQ(input.malformed_count(), 0u);
  const std::size_t before = poses.size();
  input.receive_framed(message, other);
  input.receive(key, serialized_pose(), {Carrier::kZenoh, 7});
  EXPECT_EQ(poses.size(), before + 2);
  EXPECT_EQ(dropped(Carrier::kZenoh), 0u);
}

TEST_F(PoseInputTest, SaysWhoFloods) {
  const Sender flooder{Carrier::kZeroMq, 7}, other{Carrier::kZeroMq, 8};
  const std::string frames(limits::kMaxPoseBytesPerSecond, 'x');
  // Each is worth a second.
  bool stays = true;
  for (int sent = 0; sent < 1000 && stays; ++sent) stays = input.refuse_frames(frames.size(), flooder);
  EXPECT_FALSE(stays);
  EXPECT_FALSE(input.receive_framed(frames, flooder));
  EXPECT_TRUE(input.receive_framed(key + '\0' + serialized_pose(), other));
  EXPECT_EQ(poses.size(), 1u);
  EXPECT_EQ(input.malformed_count(), 1u) << "the first message of several frames; the others are dropped unread";
  // Another connection has the number now.
  input.forget(flooder);
  EXPECT_TRUE(input.receive_framed(key + '\0' + serialized_pose(), flooder));
  EXPECT_EQ(poses.size(), 2u);
}

}  // namespace
}  // namespace tensormass::bus
