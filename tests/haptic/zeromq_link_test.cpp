#include <gtest/gtest.h>
#include <stdlib.h>

#include <algorithm>
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

// Two sockets like the server's, on free ports.
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

// Publishes until `done` returns true. One message is not enough: the subscriber may still be connecting.
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
    // No server is connected yet.
    for (pose.sequence = 1; pose.sequence <= 1'000; ++pose.sequence) ASSERT_FALSE(link->send(pose));
    zmq::socket_t late(server.context, zmq::socket_type::pull);
    late.set(zmq::sockopt::linger, 0);
    late.bind(server.address.zeromq_pose_endpoint);
    // A loop that waits for the last echo only receives.
    late.set(zmq::sockopt::rcvtimeo, 1);
    v1::ToolPose arrived;
    ASSERT_TRUE(
        publish_until([&] { link->receive(); }, [&] { return (arrived = server.next_pose(late)).sequence() != 0; }));
    EXPECT_EQ(arrived.sequence(), 1'000u) << "and none that was older";
  }
  std::filesystem::remove_all(folder);
}

// Sends poses for 100 ms. Returns how many were not taken at once.
int count_refused(FakeServer& server) {
  const auto link = connect_zeromq(server.address).value();
  MonotonicClock clock;
  OutgoingPose pose;
  EXPECT_TRUE(publish_until([] {}, [&] { return link->send(pose); })) << "not connected";
  int refused = 0;
  for (int tick = 0; tick < 200; ++tick) {
    clock.sleep_until_ns(clock.now_ns() + 500'000);
    refused += !link->send(pose);
    link->receive();
  }
  return refused;
}

TEST(ZeroMqLink, TakesAPoseInEveryTick) {
  FakeServer server;
  // Some poses wait while ZeroMQ's thread has no core. That is unlikely in each of several tries.
  int fewest = count_refused(server);
  for (int attempt = 1; attempt < 50 && fewest >= 10; ++attempt) fewest = std::min(fewest, count_refused(server));
  EXPECT_LT(fewest, 10);
}

TEST(ZeroMqLink, TheLastPoseBeforeTheCloseArrives) {
  for (const bool is_connected : {false, true}) {
    FakeServer server;
    server.poses.set(zmq::sockopt::rcvtimeo, 2'000);
    for (int round = 0; round < 20; ++round) {
      auto link = connect_zeromq(server.address).value();
      OutgoingPose pose;
      if (is_connected) {
        pose.sequence = 1;
        ASSERT_TRUE(publish_until([] {}, [&] { return link->send(pose); }));
        ASSERT_EQ(server.next_pose().sequence(), 1u);
      }
      for (pose.sequence = 2; pose.sequence < 10; ++pose.sequence) link->send(pose);
      link->send(pose);
      link.reset();
      std::uint64_t newest = 0;
      while (newest < pose.sequence) {
        const std::uint64_t arrived = server.next_pose().sequence();
        ASSERT_NE(arrived, 0u) << "round " << round << ": lost after pose " << newest;
        newest = std::max(newest, arrived);
      }
    }
  }
}

TEST(ZeroMqLink, CountsGarbageAndContinues) {
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

TEST(ZeroMqLink, RefusesMalformedEndpoints) {
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
