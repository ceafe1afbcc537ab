#include "control/doorkeeper.h"

#include <netdb.h>
#include <sys/socket.h>
#include <unistd.h>

#include <atomic>
#include <chrono>
#include <memory>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include <gtest/gtest.h>

#include "support/eventually.h"

namespace tensormass::control {
namespace {

constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, std::chrono::seconds(20));
}

class ClosedDoorTest : public testing::Test {
 protected:
  ClosedDoorTest() {
    auto listening = Doorkeeper::listen("127.0.0.1:0");
    if (!listening) throw std::runtime_error(listening.error().message);
    doorkeeper = std::move(*listening);
  }
  void open() {
    doorkeeper->open(
        [this](int descriptor) {
          inside = Descriptor(descriptor);
          ++admitted;
        },
        [this](std::string_view) { ++refused; });
  }

  Descriptor connect_to_it() {
    const std::string& endpoint = doorkeeper->endpoint();
    addrinfo hints{};
    hints.ai_socktype = SOCK_STREAM;
    addrinfo* info = nullptr;
    EXPECT_EQ(getaddrinfo("127.0.0.1", endpoint.substr(endpoint.rfind(':') + 1).c_str(), &hints, &info), 0);
    Descriptor client(socket(info->ai_family, SOCK_STREAM, 0));
    EXPECT_EQ(connect(client.get(), info->ai_addr, info->ai_addrlen), 0);
    freeaddrinfo(info);
    return client;
  }
  static void say(const Descriptor& client, std::string_view what) {
    EXPECT_EQ(send(client.get(), what.data(), what.size(), MSG_NOSIGNAL), static_cast<ssize_t>(what.size()));
  }

  std::atomic<int> admitted{0}, refused{0};
  Descriptor inside;
  std::unique_ptr<Doorkeeper> doorkeeper;
};

class DoorkeeperTest : public ClosedDoorTest {
 protected:
  DoorkeeperTest() { open(); }
};

TEST_F(ClosedDoorTest, AdmitsAllThatConnectedWhileItDidNotLook) {
  std::vector<Descriptor> clients;
  for (int i = 0; i < 100; ++i) {
    clients.push_back(connect_to_it());
    say(clients.back(), kPreface);
  }
  open();
  EXPECT_TRUE(eventually([&] { return admitted == 100; }));
  EXPECT_EQ(refused, 0);
}

TEST_F(DoorkeeperTest, AdmitsAConnectionThatSendsTheWholePreface) {
  const Descriptor client = connect_to_it();
  say(client, kPreface.substr(0, 5));
  say(client, kPreface.substr(5));
  say(client, "more");
  ASSERT_TRUE(eventually([&] { return admitted == 1; }));
  EXPECT_EQ(refused, 0);
  // The admitted connection still has every byte.
  std::string received_bytes(kPreface.size() + 4, '\0');
  std::size_t size = 0;
  ASSERT_TRUE(eventually([&] {
    const ssize_t got = recv(inside.get(), received_bytes.data() + size, received_bytes.size() - size, 0);
    if (got > 0) size += static_cast<std::size_t>(got);
    return size == received_bytes.size();
  }));
  EXPECT_EQ(received_bytes, std::string(kPreface) + "more");
}

TEST_F(DoorkeeperTest, RefusesOtherBytesAndClosesTheConnection) {
  const Descriptor client = connect_to_it();
  say(client, "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n");
  EXPECT_TRUE(eventually([&] { return refused == 1; }));
  char byte;
  EXPECT_LE(recv(client.get(), &byte, 1, 0), 0);  // closed
  EXPECT_EQ(admitted, 0);
}

TEST_F(DoorkeeperTest, RefusesAPartOfThePrefaceAtItsEndAndAtTheTimeout) {
  { say(connect_to_it(), "x"); }
  EXPECT_TRUE(eventually([&] { return refused == 1; }));
  const Descriptor hesitant = connect_to_it();
  say(hesitant, kPreface.substr(0, 10));
  EXPECT_TRUE(eventually([&] { return refused == 2; }));
  EXPECT_EQ(admitted, 0);
}

TEST_F(DoorkeeperTest, SilentConnectionsKeepNoOtherOut) {
  std::vector<Descriptor> silent;
  for (int i = 0; i < 200; ++i) silent.push_back(connect_to_it());
  const Descriptor client = connect_to_it();
  say(client, kPreface);
  EXPECT_TRUE(eventually([&] { return admitted == 1; }));
  EXPECT_GE(refused, 100);
}

TEST(Doorkeeper, NamesAnAddressThatItCannotListenOn) {
  for (const char* address : {"nonsense", "no.such.host.invalid:0", "127.0.0.1:http", "192.0.2.1:1"}) {
    const auto doorkeeper = Doorkeeper::listen(address);
    ASSERT_FALSE(doorkeeper) << address;
    EXPECT_EQ(doorkeeper.error().code, ErrorCode::kUnavailable);
    EXPECT_NE(doorkeeper.error().message.find(address), std::string::npos) << doorkeeper.error().message;
  }
}

TEST(Doorkeeper, ListensOnIPv6) {
  const auto doorkeeper = Doorkeeper::listen("[::1]:0");
  if (!doorkeeper) GTEST_SKIP() << "this machine has no IPv6: " << doorkeeper.error().message;
  EXPECT_TRUE((*doorkeeper)->endpoint().starts_with("[::1]:"));
  EXPECT_FALSE((*doorkeeper)->endpoint().ends_with(":0"));
}

}  // namespace
}  // namespace tensormass::control
