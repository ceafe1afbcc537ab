#include <zmq.hpp>

#include "support.h"

namespace tensormass::bus {
namespace {

using namespace test;

v1::Topology make_topology(std::uint64_t version) {
  v1::Topology topology;
  topology.set_scene("demo");
  topology.set_version(version);
  topology.add_bodies()->set_triangles(std::string(500'000, 't'));
  return topology;
}

v1::Frame make_frame(std::uint64_t sequence, std::size_t bytes = 240'000) {
  v1::Frame frame;
  frame.set_sequence(sequence);
  frame.set_positions(std::string(bytes, 'p'));
  return frame;
}

TEST(RoundTrip, BothTransportsCarryTheSameKeyAndBytes) {
  BusOnFreePorts server;
  const std::string key = frame_key(kServer, "demo");
  ZeroMqReader zeromq(server.bus->endpoints().zeromq_publish, key);
  Collected<std::string> over_zenoh;
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  auto subscriber = session->subscribe(key, [&](std::string_view from, std::string_view payload) {
    EXPECT_EQ(from, key);
    over_zenoh.add(std::string(payload));
  });
  ASSERT_TRUE(subscriber) << subscriber.error().message;

  const v1::Frame frame = make_frame(3);
  std::string over_zeromq;
  // A subscription takes time to arrive, so publish until both readers have a message.
  ASSERT_TRUE(eventually([&] {
    server.bus->publish(key, frame);
    return (!over_zeromq.empty() || zeromq.try_read(over_zeromq)) && over_zenoh.size() > 0;
  }));
  EXPECT_EQ(over_zeromq, frame.SerializeAsString());
  EXPECT_EQ(over_zenoh.wait_for(1).front(), over_zeromq);
}

TEST(RoundTrip, OtherKeysDoNotArrive) {
  BusOnFreePorts server(true, false);
  // "demo" is a prefix of "demo2". Only the zero byte in the subscription tells them apart.
  const std::string key = status_key(kServer, "demo");
  ZeroMqReader reader(server.bus->endpoints().zeromq_publish, key, false);
  v1::SceneStatus wanted;
  wanted.set_step(1);
  v1::SceneStatus other;
  other.set_step(2);
  std::string payload;
  ASSERT_TRUE(eventually([&] {
    server.bus->publish(key + "2", other);
    server.bus->publish(key, wanted);
    return reader.try_read(payload);
  }));
  do {
    EXPECT_EQ(payload, wanted.SerializeAsString());
  } while (reader.try_read(payload));
}

TEST(RoundTrip, PosesArriveOverZeroMq) {
  BusOnFreePorts server(true, false);
  ZeroMqPoseWriter writer(server.bus->endpoints().zeromq_pose);
  for (std::uint64_t sequence = 1; sequence <= 3; ++sequence) {
    writer.send(pose_key(kServer, "demo", "probe") + '\0' + make_pose(sequence).SerializeAsString());
  }
  const auto poses = server.poses.wait_for(3);
  ASSERT_EQ(poses.size(), 3u);
  EXPECT_EQ(poses[0].scene, "demo");
  EXPECT_EQ(poses[0].tool, "probe");
  EXPECT_EQ(poses[2].pose.sequence(), 3u);
  EXPECT_EQ(poses[2].pose.position_m().x(), 0.5);
  EXPECT_EQ(server.bus->malformed_count(), 0u);
}

TEST(RoundTrip, PosesArriveOverZenoh) {
  BusOnFreePorts server(false, true);
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  ASSERT_TRUE(eventually([&] {
    session->put(pose_key(kServer, "demo", "probe"), make_pose(9).SerializeAsString(), true);
    return server.poses.size() > 0;
  }));
  const auto poses = server.poses.wait_for(1);
  EXPECT_EQ(poses[0].scene, "demo");
  EXPECT_EQ(poses[0].tool, "probe");
  EXPECT_EQ(poses[0].pose.sequence(), 9u);
}

TEST(LateJoiner, GetsTheNewestRetainedTopologyOverZeroMq) {
  BusOnFreePorts server(true, false);
  const std::string key = topology_key(kServer, "demo");
  server.bus->publish(key, make_topology(1), {.retain = true});
  server.bus->publish(key, make_topology(2), {.retain = true});
  // Nothing is published after the readers join. The second subscribes to a key that already has a subscription.
  ZeroMqReader first(server.bus->endpoints().zeromq_publish, key);
  EXPECT_EQ(first.read(), make_topology(2).SerializeAsString());
  ZeroMqReader second(server.bus->endpoints().zeromq_publish, key);
  EXPECT_EQ(second.read(), make_topology(2).SerializeAsString());
}

TEST(LateJoiner, GetsTheNewestRetainedTopologyOverZenoh) {
  BusOnFreePorts server(false, true);
  const std::string key = topology_key(kServer, "demo");
  server.bus->publish(key, make_topology(1), {.retain = true});
  server.bus->publish(key, make_topology(2), {.retain = true});
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  std::string received;
  std::size_t count = 0;
  ASSERT_TRUE(eventually([&] {
    count = session->get(key, 1000, [&](std::string_view from, std::string_view payload) {
      EXPECT_EQ(from, key);
      received = payload;
    });
    return count > 0;
  }));
  EXPECT_EQ(count, 1u);
  EXPECT_EQ(received, make_topology(2).SerializeAsString());
}

TEST(LateJoiner, GetsNothingOfAnUnloadedScene) {
  BusOnFreePorts server;
  const std::string gone = topology_key(kServer, "gone");
  const std::string kept = topology_key(kServer, "kept");
  server.bus->publish(gone, make_topology(1), {.retain = true});
  server.bus->publish(kept, make_topology(2), {.retain = true});
  server.bus->forget(gone);

  zmq::context_t context(1);
  zmq::socket_t both(context, zmq::socket_type::sub);
  both.set(zmq::sockopt::subscribe, gone + '\0');
  both.set(zmq::sockopt::subscribe, kept + '\0');
  both.set(zmq::sockopt::linger, 0);
  both.set(zmq::sockopt::rcvtimeo, 20'000);
  both.connect(server.bus->endpoints().zeromq_publish);
  zmq::message_t message;
  ASSERT_TRUE(both.recv(message));
  EXPECT_TRUE(message.to_string_view().starts_with(kept));

  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  std::vector<std::string> keys;
  ASSERT_TRUE(eventually([&] {
    session->get("tensormass/test/**", 1000, [&](std::string_view key, std::string_view) { keys.emplace_back(key); });
    return !keys.empty();
  }));
  EXPECT_EQ(keys, std::vector<std::string>{kept});
}

TEST(Open, NamesATakenEndpointAndTheCause) {
  BusOnFreePorts first;
  BusOptions options;
  options.server = kServer;
  options.zeromq_publish_endpoint = first.bus->endpoints().zeromq_publish;
  options.zeromq_pose_endpoint = "tcp://127.0.0.1:*";
  auto second = Bus::open(options);
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, ErrorCode::kUnavailable);
  EXPECT_NE(second.error().message.find(options.zeromq_publish_endpoint), std::string::npos) << second.error().message;

  options = {};
  options.server = kServer;
  options.zenoh_listen = first.bus->endpoints().zenoh_locator;
  second = Bus::open(options);
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, ErrorCode::kUnavailable);
  EXPECT_NE(second.error().message.find(options.zenoh_listen), std::string::npos) << second.error().message;
  EXPECT_NE(second.error().message.find("Address already in use"), std::string::npos) << second.error().message;
  EXPECT_EQ(second.error().message.find(".rs:"), std::string::npos) << second.error().message;
}

TEST(Open, RefusesANameThatCannotStandInAKey) {
  BusOptions options;
  options.server = "a/b";
  const auto bus = Bus::open(options);
  ASSERT_FALSE(bus);
  EXPECT_EQ(bus.error().code, ErrorCode::kInvalidArgument);
}

}  // namespace
}  // namespace tensormass::bus
