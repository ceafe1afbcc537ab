#include <gtest/gtest.h>

#include <condition_variable>
#include <mutex>

#include "bus/zenoh/session.h"
#include "fakes.h"
#include "haptic/zenoh_link.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {
namespace {

constexpr auto kPatience = std::chrono::seconds(30);

TEST(ZenohLink, CarriesPosesAndFeedback) {
  std::mutex mutex;
  std::condition_variable changed;
  std::optional<v1::ToolPose> arrived;

  zenoh::SessionOptions listening;
  listening.listen = "tcp/127.0.0.1:0";
  zenoh::Session server = zenoh::Session::open(listening).value();
  LinkAddress address;
  address.pose_key = "tensormass/s/demo/tool/probe/pose";
  address.feedback_key = "tensormass/s/demo/tool/probe/feedback";
  address.zenoh_locator = server.locator();
  const zenoh::Subscriber poses = server
                                      .subscribe(address.pose_key,
                                                 [&](std::string_view, std::string_view payload) {
                                                   v1::ToolPose pose;
                                                   const bool parsed = pose.ParseFromString(std::string(payload));
                                                   const std::scoped_lock lock(mutex);
                                                   EXPECT_TRUE(parsed);
                                                   arrived = pose;
                                                   changed.notify_all();
                                                 })
                                      .value();

  const auto link = connect_zenoh(address).value();
  v1::ToolFeedback answer;
  answer.set_step(3);
  std::optional<Feedback> received;
  OutgoingPose pose;
  const auto end = std::chrono::steady_clock::now() + kPatience;
  // The first messages may precede the subscriptions, which take time to travel.
  while (!received && std::chrono::steady_clock::now() < end) {
    ++pose.sequence;
    ASSERT_TRUE(link->send(pose));
    std::unique_lock lock(mutex);
    if (!changed.wait_for(lock, std::chrono::milliseconds(10), [&] { return arrived.has_value(); })) continue;
    answer.set_pose_sequence(arrived->sequence());
    arrived.reset();
    lock.unlock();
    ASSERT_TRUE(server.put(address.feedback_key, answer.SerializeAsString()));
    received = link->receive();
  }
  ASSERT_TRUE(received);
  EXPECT_EQ(received->step, 3u);
  EXPECT_GE(received->pose_sequence, 1u);
  EXPECT_LE(received->pose_sequence, pose.sequence);
  EXPECT_GT(received->arrival_ns, 0);
}

TEST(ZenohLink, RefusesAServerWithoutZenoh) {
  const auto link = connect_zenoh(LinkAddress{});
  ASSERT_FALSE(link);
  EXPECT_NE(link.error().message.find("--transport zeromq"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::haptic
