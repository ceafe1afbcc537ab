#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <unistd.h>

#include <atomic>
#include <random>

#include "core/limits.h"
#include "support.h"

namespace tensormass::bus {
namespace {

using namespace test;

/// Connects to the port at the end of `endpoint` on 127.0.0.1, writes the bytes, and closes.
void write_raw(const std::string& endpoint, std::string_view bytes) {
  const int descriptor = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  address.sin_port = htons(static_cast<std::uint16_t>(std::stoi(endpoint.substr(endpoint.rfind(':') + 1))));
  ASSERT_EQ(connect(descriptor, reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0) << endpoint;
  // The server may close before it has read everything.
  while (!bytes.empty()) {
    const ssize_t written = send(descriptor, bytes.data(), bytes.size(), MSG_NOSIGNAL);
    if (written <= 0) break;
    bytes.remove_prefix(static_cast<std::size_t>(written));
  }
  close(descriptor);
}

std::string random_bytes(std::size_t size, std::uint32_t seed) {
  std::mt19937 random(seed);
  std::string bytes(size, '\0');
  for (char& byte : bytes) byte = static_cast<char>(random());
  return bytes;
}

/// Checks that poses still arrive over both transports.
void expect_alive(BusOnFreePorts& server) {
  const std::size_t before = server.poses.size();
  ZeroMqPoseWriter writer(server.bus->endpoints().zeromq_pose);
  writer.send(pose_key(kServer, "demo", "probe") + '\0' + make_pose(1).SerializeAsString());
  EXPECT_EQ(server.poses.wait_for(before + 1).size(), before + 1);
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  EXPECT_TRUE(eventually([&] {
    session->put(pose_key(kServer, "demo", "probe"), make_pose(2).SerializeAsString());
    return server.poses.size() > before + 1;
  }));
}

class RawBytes : public testing::TestWithParam<std::string Endpoints::*> {};

TEST_P(RawBytes, AreCountedAndSurvived) {
  std::vector<std::string> kinds{"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", "x", std::string(1, '\xff')};
  for (std::uint32_t seed = 1; seed <= 20; ++seed) kinds.push_back(random_bytes(seed * 97, seed));
  for (const std::string& bytes : kinds) {
    // A new bus for each, so that a count is due to this connection.
    BusOnFreePorts server;
    write_raw(server.bus->endpoints().*GetParam(), bytes);
    EXPECT_TRUE(eventually([&] { return server.bus->malformed_count() > 0; })) << testing::PrintToString(bytes);
    if (HasFailure()) return;
    expect_alive(server);
  }
}

std::string endpoint_name(const testing::TestParamInfo<std::string Endpoints::*>& test) {
  if (test.param == &Endpoints::zeromq_publish) return "ZeroMqPublish";
  return test.param == &Endpoints::zeromq_pose ? "ZeroMqPose" : "Zenoh";
}

INSTANTIATE_TEST_SUITE_P(Endpoint, RawBytes,
                         testing::Values(&Endpoints::zeromq_publish, &Endpoints::zeromq_pose,
                                         &Endpoints::zenoh_locator),
                         endpoint_name);

TEST(GarbageMessages, OverZeroMqAreCountedAndSurvived) {
  BusOnFreePorts server;
  const std::string key = pose_key(kServer, "demo", "probe");
  ZeroMqPoseWriter writer(server.bus->endpoints().zeromq_pose);
  writer.send("");
  writer.send(random_bytes(100, 1));
  writer.send(key);
  writer.send(key + '\0');
  writer.send(key + '\0' + random_bytes(100, 2));
  writer.send(key + '\0' + std::string(limits::kMaxPoseMessageBytes + 1, 'x'));
  writer.send(pose_key("other", "demo", "probe") + '\0' + make_pose(1).SerializeAsString());
  // A message of two frames instead of one, with a valid pose in the second.
  writer.send(key, true);
  writer.send(key + '\0' + make_pose(1).SerializeAsString());
  EXPECT_EQ(server.malformed.wait_for(8), (std::vector<std::string>{"", "", "", "demo", "demo", "demo", "", ""}));
  EXPECT_EQ(server.poses.size(), 0u);
  expect_alive(server);
  EXPECT_EQ(server.bus->malformed_count(), 8u);
}

TEST(GarbageMessages, AMessageAboveZeroMqsLimitEndsOnlyItsConnection) {
  BusOnFreePorts server;
  {
    ZeroMqPoseWriter writer(server.bus->endpoints().zeromq_pose);
    writer.send(std::string(8 << 20, 'x'));
  }
  expect_alive(server);
}

TEST(GarbageMessages, OverZenohAreCountedAndSurvived) {
  BusOnFreePorts server;
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(session) << session.error().message;
  const std::string key = pose_key(kServer, "demo", "probe");
  ASSERT_TRUE(eventually([&] {
    session->put(key, random_bytes(100, 3));
    return server.malformed.size() > 0;
  }));
  const std::size_t before = server.malformed.size();
  ASSERT_TRUE(eventually([&] {
    session->put(key, std::string(limits::kMaxPoseMessageBytes + 1, 'x'));
    return server.malformed.size() > before;
  }));
  EXPECT_EQ(server.malformed.wait_for(1).front(), "demo");
  EXPECT_EQ(server.poses.size(), 0u);
  expect_alive(server);
}

TEST(GarbageMessages, OnThePublishEndpointAreCountedAndSurvived) {
  BusOnFreePorts server;
  zmq::context_t context(1);
  zmq::socket_t client(context, zmq::socket_type::xsub);
  client.set(zmq::sockopt::linger, 1000);
  client.connect(server.bus->endpoints().zeromq_publish);
  client.send(zmq::str_buffer("\x07 not a subscription"));
  client.send(zmq::buffer(std::string(1, 1).append(random_bytes(300, 4))));
  EXPECT_EQ(server.malformed.wait_for(1).size(), 1u);
  expect_alive(server);
}

std::uint64_t refused(const BusOnFreePorts& server, Refusal refusal) {
  return server.bus->counts().refusals[static_cast<std::size_t>(Carrier::kZenoh)][static_cast<std::size_t>(refusal)];
}

TEST(Zenoh, WhatItRefusesIsCounted) {
  BusOnFreePorts server(false, true);
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator, .shared_memory = false});
  ASSERT_TRUE(session) << session.error().message;
  const std::string key = pose_key(kServer, "demo", "probe");
  ASSERT_TRUE(eventually([&] {
    session->put(key, make_pose(1).SerializeAsString());
    return server.poses.size() > 0;
  }));
  EXPECT_EQ(refused(server, Refusal::kAccess), 0u);
  EXPECT_EQ(refused(server, Refusal::kMessageSize), 0u);
  EXPECT_TRUE(eventually([&] {
    session->put(frame_key(kServer, "demo"), "forged");
    return refused(server, Refusal::kAccess) > 0;
  }));
  EXPECT_TRUE(eventually([&] {
    session->put(key, std::string(1 << 20, 'x'));
    return refused(server, Refusal::kMessageSize) > 0;
  }));
  EXPECT_EQ(refused(server, Refusal::kSubscriptions), 0u);
}

TEST(Zenoh, AClientWithTooManySubscriptionsIsDisconnected) {
  BusOnFreePorts server;
  auto honest = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  auto session = zenoh::Session::open({.connect = server.bus->endpoints().zenoh_locator});
  ASSERT_TRUE(honest && session);
  std::atomic<int> heard = 0;
  const std::string key = frame_key(kServer, "demo");
  const auto listener = honest->subscribe(key, [&](auto&&...) { ++heard; });
  ASSERT_TRUE(listener);
  std::vector<zenoh::Subscriber> held;
  const auto subscribe = [&](std::size_t number) {
    auto subscriber = session->subscribe(frame_key(kServer, "s" + std::to_string(number)), [](auto&&...) {});
    ASSERT_TRUE(subscriber);
    held.push_back(std::move(*subscriber));
  };
  // Those that ended do not count.
  for (std::size_t i = 0; i < limits::kMaxZenohDeclarations; ++i) {
    subscribe(i);
    if (i % 2 == 0) held.pop_back();
  }
  // What the session sends after its subscriptions is read after them.
  ASSERT_TRUE(eventually([&] {
    session->put(pose_key(kServer, "demo", "probe"), make_pose(1).SerializeAsString());
    return server.poses.size() > 0;
  }));
  EXPECT_EQ(refused(server, Refusal::kSubscriptions), 0u);
  for (std::size_t i = 0; i < limits::kMaxZenohDeclarations; ++i) subscribe(1000 + i);
  EXPECT_TRUE(eventually([&] { return refused(server, Refusal::kSubscriptions) > 0; }));
  const int before = heard;
  EXPECT_TRUE(eventually([&] {
    server.bus->publish(key, v1::Frame());
    return heard > before;
  })) << "other clients notice nothing";
  held.clear();
  expect_alive(server);
}

TEST(Zenoh, BeyondTheSumOfSubscriptionsTheClientWithMostIsDisconnected) {
  BusOnFreePorts with_log(false, true);  // which counts need
  auto server = zenoh::Session::open({.listen = "tcp/127.0.0.1:0",
                                      .max_declarations = 100,
                                      .max_declarations_of_all = 20,
                                      .max_keys = 100,
                                      .max_key_bytes = 100,
                                      .max_requests = 1000,
                                      .max_requests_per_s = 1000});
  ASSERT_TRUE(server) << server.error().message;
  auto most = zenoh::Session::open({.connect = server->locator()}),
       fewer = zenoh::Session::open({.connect = server->locator()});
  ASSERT_TRUE(most && fewer);
  std::atomic<int> heard = 0;
  std::vector<zenoh::Subscriber> held;
  const auto subscribe = [&](zenoh::Session& session, const std::string& key) {
    auto subscriber = session.subscribe(key, [&](auto&&...) { ++heard; });
    ASSERT_TRUE(subscriber);
    held.push_back(std::move(*subscriber));
  };
  const std::uint64_t before = tensormass_zenoh_refused().too_many_declarations;
  for (int i = 0; i < 15; ++i) subscribe(*most, "most/" + std::to_string(i));
  ASSERT_TRUE(eventually([&] {
    server->put("most/14", "x");
    return heard > 0;
  }));
  EXPECT_EQ(tensormass_zenoh_refused().too_many_declarations, before);
  heard = 0;
  for (int i = 0; i < 6; ++i) subscribe(*fewer, "fewer/" + std::to_string(i));
  EXPECT_TRUE(eventually([&] {
    server->put("fewer/5", "x");
    return heard > 0 && tensormass_zenoh_refused().too_many_declarations > before;
  }));
}

}  // namespace
}  // namespace tensormass::bus
