#include "control/relay.h"

#include <fcntl.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <csignal>
#include <future>
#include <memory>
#include <string>
#include <vector>

#include <gtest/gtest.h>
#include <openssl/ssl.h>

#include "support/eventually.h"
#include "support/key_folder.h"

namespace tensormass::control {
namespace {

constexpr std::string_view kPreface = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";

class RelayTest : public testing::Test {
 protected:
  RelayTest() {
    int ends[2];
    EXPECT_EQ(socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    client = Descriptor(ends[0]);
    relay.add(ends[1]);
  }
  static void wait(const Descriptor& socket, short events) {
    pollfd item{socket.get(), events, 0};
    ASSERT_EQ(poll(&item, 1, 20'000), 1);
  }
  static void send_all(const Descriptor& socket, std::string_view bytes) {
    while (!bytes.empty()) {
      wait(socket, POLLOUT);
      const ssize_t size = send(socket.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL);
      if (size > 0) bytes.remove_prefix(static_cast<std::size_t>(size));
    }
  }
  /// Reads `size` bytes, or until the other side ends.
  static std::string read(const Descriptor& socket, std::size_t size) {
    std::string out;
    std::string part(1 << 16, '\0');
    while (out.size() < size) {
      wait(socket, POLLIN);
      const ssize_t got = recv(socket.get(), part.data(), std::min(part.size(), size - out.size()), 0);
      if (got == 0) break;
      if (got > 0) out.append(part, 0, static_cast<std::size_t>(got));
    }
    return out;
  }

  Descriptor client, inner;
  std::atomic<int> refused{0};
  Relay relay{[this](int descriptor) { inner = Descriptor(descriptor); }, [this](auto&&...) { ++refused; }};
};

TEST_F(RelayTest, CarriesBytesBothWays) {
  send_all(client, kPreface);
  EXPECT_EQ(read(inner, kPreface.size()), kPreface);
  send_all(inner, "answer");
  EXPECT_EQ(read(client, 6), "answer");
}

TEST_F(RelayTest, CarriesMoreThanAnyBufferHoldsToASlowReader) {
  // The server's frames, of an unknown kind.
  std::string many;
  while (many.size() < (8 << 20)) many += std::string("\0\x40\0\x20\0\0\0\0\0", 9) + std::string(16'384, 'x');
  auto writes = std::async(std::launch::async, [&] { send_all(inner, many); });
  EXPECT_EQ(writes.wait_for(std::chrono::milliseconds(50)), std::future_status::timeout) << "nobody reads";
  EXPECT_EQ(read(client, many.size()), many);
  writes.get();
}

TEST_F(RelayTest, PassesOnTheEndOfEitherSide) {
  send_all(client, kPreface);
  EXPECT_EQ(shutdown(client.get(), SHUT_WR), 0);
  EXPECT_EQ(read(inner, 1 << 20), kPreface) << "up to the end";
  send_all(inner, "the last answer");
  inner = Descriptor();
  EXPECT_EQ(read(client, 1 << 20), "the last answer");
}

TEST_F(RelayTest, ClosesAConnectionThatPassesALimit) {
  send_all(client, kPreface);
  std::string pings;
  for (int i = 0; i < 2000; ++i) pings += std::string("\0\0\x08\x06\0\0\0\0\0", 9) + "12345678";
  send(client.get(), pings.data(), pings.size(), MSG_NOSIGNAL);
  EXPECT_TRUE(tests::eventually([&] { return refused == 1; }, std::chrono::seconds(20)));
  EXPECT_LT(read(inner, 1 << 20).size(), pings.size()) << "and gRPC's end is closed, too";
}

/// The start of a call, and of its message: `size` bytes are announced and `sent` follow, 16 KiB a frame at most.
std::string half_sent_message(std::size_t size, std::size_t sent) {
  const auto frame = [](char type, char flags, const std::string& payload) {
    std::string out(9, '\0');
    out[1] = static_cast<char>(payload.size() >> 8);
    out[2] = static_cast<char>(payload.size());
    out[3] = type;
    out[4] = flags;
    out[8] = 1;
    return out + payload;
  };
  std::string prefix(5, '\0');
  for (int i = 1; i < 5; ++i) prefix[static_cast<std::size_t>(i)] = static_cast<char>(size >> (32 - 8 * i));
  std::string out = std::string(kPreface) + frame(1, 4, "h") + frame(0, 0, prefix);
  for (; sent > 0; sent -= std::min<std::size_t>(sent, 16'384)) {
    out += frame(0, 0, std::string(std::min<std::size_t>(sent, 16'384), 'x'));
  }
  return out;
}

TEST_F(RelayTest, WhoWaitsWithAHalfSentMessageMakesRoomForWhoSends) {
  constexpr std::size_t kMax = 100'000;
  std::vector<Descriptor> of_grpc, clients;
  std::vector<std::string> reasons;
  Relay bounded([&](int descriptor) { of_grpc.emplace_back(descriptor); },
                [&](std::string_view, std::string_view why) { reasons.emplace_back(why); }, {}, {.max_bytes = kMax});
  const auto half_send = [&](std::size_t bytes) {
    int ends[2];
    ASSERT_EQ(socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    clients.emplace_back(ends[0]);
    bounded.add(ends[1]);
    const std::string bytes_sent = half_sent_message(kMax, bytes);
    send_all(clients.back(), bytes_sent);
    EXPECT_EQ(read(of_grpc.back(), bytes_sent.size()).size(), bytes_sent.size()) << "let through";
  };
  half_send(20'000);
  half_send(70'000);
  half_send(30'000);
  const std::string goodbye = read(clients[1], 1 << 20);
  EXPECT_EQ(goodbye.substr(3, 6), std::string("\x07\0\0\0\0\0", 6)) << "GOAWAY";
  EXPECT_NE(goodbye.find("--max-message-mib; the one that waited with most made room"), std::string::npos);
  EXPECT_EQ(read(of_grpc[1], 1 << 20), "") << "gRPC's end is closed, too";
  ASSERT_EQ(reasons.size(), 1u);
  // The others go on, until they are alone with too much.
  send_all(clients[2], half_sent_message(0, 49'000).substr(kPreface.size() + 9 + 1 + 9 + 5));
  EXPECT_FALSE(read(of_grpc[2], 49'000).empty());
  EXPECT_EQ(reasons.size(), 1u);
}

TEST_F(RelayTest, TellsWhyAMessageIsTooLarge) {
  send_all(client, half_sent_message(limits::kDefaultHalfSentBytes + 1, 0));
  EXPECT_NE(read(client, 1 << 20).find("a message larger than --max-message-mib"), std::string::npos);
  EXPECT_TRUE(tests::eventually([&] { return refused == 1; }, std::chrono::seconds(20)));
}

// Both ends of each connection are here, and those of gRPC.
constexpr rlim_t kFiles = 4 * (limits::kMaxControlConnections + limits::kMaxShaking) + 64;

/// Returns whether this process may open kFiles files now.
bool allow_files() {
  rlimit files{};
  if (getrlimit(RLIMIT_NOFILE, &files) != 0 || files.rlim_max < kFiles) return false;
  files.rlim_cur = std::max(files.rlim_cur, kFiles);
  return setrlimit(RLIMIT_NOFILE, &files) == 0;
}

class FullRelay : public testing::Test {
 protected:
  void SetUp() override {
    if (!allow_files()) GTEST_SKIP() << "a process may not open " << kFiles << " files here";
    for (std::size_t i = 0; i < limits::kMaxControlConnections; ++i) connect();
    ASSERT_EQ(admitted, limits::kMaxControlConnections);
  }
  void connect() {
    int ends[2];
    ASSERT_EQ(socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends), 0);
    clients.emplace_back(ends[0]);
    relay.add(ends[1]);
  }
  /// Begins a call, which does not end, on the n-th connection. Returns when the relay has passed it on.
  void begin_call(std::size_t n) {
    std::string bytes = "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    bytes += std::string("\0\0\1\1\4\0\0\0\1x", 10);  // the headers of stream 1, of one byte
    ASSERT_EQ(write(clients[n].get(), bytes.data(), bytes.size()), static_cast<ssize_t>(bytes.size()));
    std::array<char, 64> passed{};
    ASSERT_TRUE(eventually([&] { return read(inner[n].get(), passed.data(), passed.size()) > 0; }));
  }
  /// Returns whether the relay has closed the n-th connection.
  bool is_closed(std::size_t n) {
    std::array<char, 256> bytes{};
    ssize_t size = 0;
    while ((size = read(clients[n].get(), bytes.data(), bytes.size())) > 0) continue;
    return size == 0;
  }
  template <class Condition>
  static bool eventually(const Condition& condition) {
    return tests::eventually(condition, std::chrono::seconds(20));
  }

  std::vector<Descriptor> clients, inner;
  std::atomic<std::size_t> admitted{0}, refused{0};
  // Last, because its thread uses the others.
  Relay relay{[this](int descriptor) {
                inner.emplace_back(descriptor);
                ++admitted;
              },
              [this](auto&&...) { ++refused; }};
};

TEST_F(FullRelay, TheConnectionWithoutACallForLongestMakesRoom) {
  begin_call(0);
  connect();
  EXPECT_TRUE(eventually([&] { return admitted == limits::kMaxControlConnections + 1; }));
  EXPECT_TRUE(eventually([&] { return is_closed(1); }));
  EXPECT_FALSE(is_closed(0)) << "it has a call";
  EXPECT_FALSE(is_closed(2));
  EXPECT_FALSE(is_closed(clients.size() - 1));
  EXPECT_EQ(refused, 1u);
}

TEST_F(FullRelay, RefusesOneMoreIfEachHasACall) {
  for (std::size_t i = 0; i < limits::kMaxControlConnections; ++i) begin_call(i);
  connect();
  EXPECT_TRUE(eventually([&] { return is_closed(clients.size() - 1); }));
  EXPECT_FALSE(is_closed(0));
  EXPECT_EQ(refused, 1u);
  EXPECT_EQ(admitted, limits::kMaxControlConnections);
}

/// Connects one more client, whose end blocks, to a relay.
void connect_blocking(Relay& relay, std::vector<Descriptor>& clients) {
  int ends[2];
  ASSERT_EQ(socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends), 0);
  ASSERT_EQ(fcntl(ends[1], F_SETFL, O_NONBLOCK), 0);
  clients.emplace_back(ends[0]);
  relay.add(ends[1]);
}

/// Shakes hands as a client with the keys of a folder; socket: blocking. Returns whether the relay let it in.
bool shake_hands(const tests::KeyFolder& keys, int socket) {
  const std::unique_ptr<SSL_CTX, decltype(&SSL_CTX_free)> context(SSL_CTX_new(TLS_client_method()), &SSL_CTX_free);
  keys.use_in(context.get());
  const std::unique_ptr<SSL, decltype(&SSL_free)> stream(SSL_new(context.get()), &SSL_free);
  SSL_set_fd(stream.get(), socket);
  return SSL_connect(stream.get()) == 1;
}

TEST(Relay, PeersThatShakeHandsTakeNoPlaceOfAClient) {
  if (!allow_files()) GTEST_SKIP() << "a process may not open " << kFiles << " files here";
  std::signal(SIGPIPE, SIG_IGN);  // as the daemon does, because OpenSSL writes without MSG_NOSIGNAL
  const tests::KeyFolder keys("");
  auto tls = TlsContext::make(keys.certificate(), keys.private_key(), keys.certificate());
  ASSERT_TRUE(tls) << tls.error().message;
  std::atomic<std::size_t> let_in = 0, refused = 0;
  Relay relay(
      [&](int descriptor) {
        const Descriptor inner(descriptor);
        ++let_in;
      },
      [&](auto&&...) { ++refused; },
      {.tls = tls->get(), .knows = [](std::string_view name) { return name == tests::KeyFolder::kName; }});
  std::vector<Descriptor> clients;
  const auto connect = [&] { connect_blocking(relay, clients); };
  for (std::size_t i = 0; i < limits::kMaxControlConnections + limits::kMaxShaking; ++i) connect();
  connect();
  EXPECT_TRUE(shake_hands(keys, clients.back().get()));
  EXPECT_TRUE(tests::eventually([&] { return let_in == 1; }, std::chrono::seconds(20)));
  EXPECT_TRUE(tests::eventually([&] { return refused >= limits::kMaxControlConnections; }, std::chrono::seconds(20)));
}

TEST(Relay, AKeyHasAPartOfTheConnections) {
  if (!allow_files()) GTEST_SKIP() << "a process may not open " << kFiles << " files here";
  std::signal(SIGPIPE, SIG_IGN);  // as the daemon does, because OpenSSL writes without MSG_NOSIGNAL
  const tests::KeyFolder keys("");
  auto tls = TlsContext::make(keys.certificate(), keys.private_key(), keys.certificate());
  ASSERT_TRUE(tls) << tls.error().message;
  std::atomic<std::size_t> let_in = 0, refused = 0;
  std::vector<Descriptor> inner;
  Relay relay(
      [&](int descriptor) {
        inner.emplace_back(descriptor);
        ++let_in;
      },
      [&](auto&&...) { ++refused; },
      {.tls = tls->get(), .knows = [](std::string_view name) { return name == tests::KeyFolder::kName; }});
  std::vector<Descriptor> clients;
  const auto connect = [&] {
    connect_blocking(relay, clients);
    shake_hands(keys, clients.back().get());
  };
  for (std::size_t i = 0; i < limits::kMaxConnectionsPerKey; ++i) connect();
  EXPECT_TRUE(tests::eventually([&] { return let_in == limits::kMaxConnectionsPerKey; }, std::chrono::seconds(20)));
  connect();
  EXPECT_TRUE(tests::eventually([&] { return refused == 1; }, std::chrono::seconds(20)));
  EXPECT_EQ(let_in, limits::kMaxConnectionsPerKey);
  // One that ends makes room.
  clients.front() = Descriptor();
  inner.front() = Descriptor();
  EXPECT_TRUE(tests::eventually(
      [&] {
        connect();
        return let_in > limits::kMaxConnectionsPerKey;
      },
      std::chrono::seconds(20)));
}

/// A clock of CPU time that a second passes by in each call.
double dear_cpu_s() {
  static std::atomic<int> calls = 0;
  return ++calls;
}

TEST(Relay, AKeyThatCostsTooMuchTimeIsCut) {
  std::signal(SIGPIPE, SIG_IGN);  // as the daemon does, because OpenSSL writes without MSG_NOSIGNAL
  const tests::KeyFolder keys("");
  auto tls = TlsContext::make(keys.certificate(), keys.private_key(), keys.certificate());
  ASSERT_TRUE(tls) << tls.error().message;
  std::atomic<int> let_in = 0, dear = 0, other = 0;
  std::vector<Descriptor> inner;
  Relay relay(
      [&](int descriptor) {
        inner.emplace_back(descriptor);
        ++let_in;
      },
      [&](std::string_view who, std::string_view why) {
        const bool is_cpu = why == "more than kMaxRelayCpuShare of the relay's CPU time for one key";
        ++(is_cpu && who == tests::KeyFolder::kName ? dear : other);
      },
      {.tls = tls->get(),
       .knows = [](std::string_view name) { return name == tests::KeyFolder::kName; },
       .cpu_s = &dear_cpu_s});
  std::vector<Descriptor> clients;
  EXPECT_TRUE(tests::eventually(
      [&] {
        connect_blocking(relay, clients);
        shake_hands(keys, clients.back().get());
        return dear > 0;
      },
      std::chrono::seconds(20)));
  EXPECT_EQ(other, 0);
  // Each connection costs a second or more, so those before were let in, about as many as kMaxRelayCpuAtOnceS.
  EXPECT_LE(let_in, limits::kMaxRelayCpuAtOnceS + limits::kMaxRelayCpuShare * 20);
}

}  // namespace
}  // namespace tensormass::control
