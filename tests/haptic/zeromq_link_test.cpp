#include <gtest/gtest.h>
#include <stdlib.h>

#include <chrono>
#include <filesystem>
#include <string>
#include <thread>

#include <zmq.hpp>

#include "haptic/clock.h"
#include "haptic/zeromq_link.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {
namespace {

constexpr auto kPatience = std::chrono::seconds(20);
constexpr int kPatienceMs = 20'000;

// The server's two sockets, on free ports.
struct FakeServer {
  zmq::context_t context;
  zmq::socket_t poses{context, zmq::socket_type::pull};
  zmq::socket_t publisher{context, zmq::socket_type::xpub};
  LinkAddress address;

  FakeServer() {
    address.pose_key = "tensormass/s/demo/tool/probe/pose";
    address.feedback_key = "tensormass/s/demo/tool/probe/feedback";
    for (zmq::socket_t* socket : {&poses, &publisher}) {
      socket->set(zmq::sockopt::linger, 0);
      socket->set(zmq::sockopt::rcvtimeo, kPatienceMs);
      socket->bind("tcp://127.0.0.1:*");
    }
    address.zeromq_pose_endpoint = poses.get(zmq::sockopt::last_endpoint);
    address.zeromq_publish_endpoint = publisher.get(zmq::sockopt::last_endpoint);
  }

  std::string next_subscription() {
    zmq::message_t message;
    return publisher.recv(message) ? message.to_string() : "";
  }

  v1::ToolPose next_pose() { return next_pose(poses); }
  v1::ToolPose next_pose(zmq::socket_t& from) {
    zmq::message_t message;
    v1::ToolPose pose;
    const std::string prefix = address.pose_key + '\0';
    if (from.recv(message) && message.to_string_view().starts_with(prefix)) {
      EXPECT_TRUE(pose.ParseFromString(message.to_string().substr(prefix.size())));
    }
    return pose;
  }

  void publish(const std::string& key, const std::string& payload) {
    publisher.send(zmq::buffer(key + '\0' + payload), zmq::send_flags::none);
  }
};

// Publishes until the link has what `done` wants: a subscriber may still be connecting, and keeps only the newest.
template <class Publish, class Done>
bool publish_until(Publish publish, Done done) {
  const auto end = std::chrono::steady_clock::now() + kPatience;
  while (std::chrono::steady_clock::now() < end) {
    publish();
    if (done()) return true;
    std::this_thread::yield();
  }
  return false;
}

TEST(ZeroMqLink, CarriesPosesAndFeedback) {
  FakeServer server;
  const auto link = connect_zeromq(server.address).value();
  EXPECT_EQ(server.next_subscription(), '\1' + server.address.feedback_key + '\0');

  OutgoingPose pose;
  pose.sequence = 17;
  pose.client_id = 5;
  ASSERT_TRUE(link->send(pose));
  const v1::ToolPose arrived = server.next_pose();
  EXPECT_EQ(arrived.sequence(), 17u);
  EXPECT_EQ(arrived.client_id(), 5u);

  v1::ToolFeedback feedback;
  feedback.set_step(3);
  feedback.set_pose_sequence(17);
  MonotonicClock clock;
  const std::int64_t before_ns = clock.now_ns();
  std::optional<Feedback> received;
  ASSERT_TRUE(publish_until([&] { server.publish(server.address.feedback_key, feedback.SerializeAsString()); },
                            [&] { return (received = link->receive()).has_value(); }));
  EXPECT_EQ(received->step, 3u);
  EXPECT_EQ(received->pose_sequence, 17u);
  EXPECT_GE(received->arrival_ns, before_ns);
  EXPECT_LE(received->arrival_ns, clock.now_ns());
}

TEST(ZeroMqLink, TheNewestPoseWins) {
  FakeServer server;
  std::string folder = testing::TempDir() + "tensormass-XXXXXX";
  ASSERT_NE(mkdtemp(folder.data()), nullptr);
  server.address.zeromq_pose_endpoint = "ipc://" + folder + "/poses";
  {
    const auto link = connect_zeromq(server.address).value();
    OutgoingPose pose;
    // Nobody listens yet.
    for (pose.sequence = 1; pose.sequence <= 1'000; ++pose.sequence) ASSERT_TRUE(link->send(pose));
    zmq::socket_t late(server.context, zmq::socket_type::pull);
    late.set(zmq::sockopt::linger, 0);
    late.set(zmq::sockopt::rcvtimeo, kPatienceMs);
    late.bind(server.address.zeromq_pose_endpoint);
    EXPECT_EQ(server.next_pose(late).sequence(), 1'000u);
  }
  std::filesystem::remove_all(folder);
}

TEST(ZeroMqLink, CountsGarbageAndGoesOn) {
  FakeServer server;
  const auto link = connect_zeromq(server.address).value();
  server.next_subscription();
  ASSERT_TRUE(publish_until([&] { server.publish(server.address.feedback_key, "\xff\xff\xff"); },
                            [&] { return link->malformed() > 0; }));
  EXPECT_FALSE(link->receive());
  ASSERT_TRUE(
      publish_until([&] { server.publish(server.address.feedback_key, v1::ToolFeedback().SerializeAsString()); },
                    [&] { return link->receive().has_value(); }));
}

TEST(ZeroMqLink, RefusesEndpointsThatAreNone) {
  FakeServer server;
  LinkAddress off = server.address;
  off.zeromq_pose_endpoint.clear();
  EXPECT_NE(connect_zeromq(off).error().message.find("zenoh"), std::string::npos);
  LinkAddress wrong = server.address;
  wrong.zeromq_publish_endpoint = "not an endpoint";
  EXPECT_NE(connect_zeromq(wrong).error().message.find("not an endpoint"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::haptic
