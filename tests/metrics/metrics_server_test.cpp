#include "metrics/metrics_server.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>

#include <array>
#include <atomic>
#include <cerrno>
#include <chrono>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "control/doorkeeper.h"
#include "core/metrics_limits.h"
#include "support/refused.h"

namespace tensormass::metrics {
namespace {

using control::Descriptor;

/// Bounds a broken build only.
constexpr timeval kDeadline{60, 0};

class MetricsServerTest : public testing::Test {
 protected:
  MetricsServerTest() { start(std::chrono::hours(1)); }

  void start(std::chrono::milliseconds time) {
    auto started = MetricsServer::start(
        "127.0.0.1:0", [this] { return text(); }, [](std::string_view host) { return host.starts_with("127.0.0.1"); },
        time);
    if (!started) throw std::runtime_error(started.error().message);
    server = std::move(*started);
  }

  std::string text() {
    ++scrapes;
    if (no_memory.exchange(false)) throw std::bad_alloc();
    return "x 1\n";
  }

  Descriptor connected() const {
    Descriptor client(socket(AF_INET, SOCK_STREAM, 0));
    setsockopt(client.get(), SOL_SOCKET, SO_RCVTIMEO, &kDeadline, sizeof(kDeadline));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    const std::string& endpoint = server->endpoint();
    address.sin_port = htons(static_cast<std::uint16_t>(std::stoi(endpoint.substr(endpoint.rfind(':') + 1))));
    EXPECT_EQ(connect(client.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0);
    return client;
  }
  static void say(const Descriptor& client, std::string_view what) {
    (void)send(client.get(), what.data(), what.size(), MSG_NOSIGNAL);
  }
  /// Returns what comes until the server closes.
  static std::string heard(const Descriptor& client) {
    std::string all;
    std::array<char, 4096> some;
    ssize_t size = 0;
    while ((size = recv(client.get(), some.data(), some.size(), 0)) > 0) {
      all.append(some.data(), static_cast<std::size_t>(size));
    }
    EXPECT_FALSE(size < 0 && errno == EAGAIN) << "the server did not close";
    return all;
  }
  std::string ask(const std::string& request) const {
    const Descriptor client = connected();
    say(client, request);
    return heard(client);
  }

  std::atomic<int> scrapes{0};
  std::atomic<bool> no_memory{false};
  std::unique_ptr<MetricsServer> server;
};

const std::string kScrape = "GET /metrics HTTP/1.1\r\nHost: 127.0.0.1:9464\r\n\r\n";

TEST_F(MetricsServerTest, AnswersAScrape) {
  const std::string answer = ask(kScrape);
  EXPECT_TRUE(answer.starts_with("HTTP/1.1 200 OK\r\n")) << answer;
  EXPECT_NE(answer.find("Content-Type: text/plain; version=0.0.4; charset=utf-8\r\n"), std::string::npos) << answer;
  EXPECT_NE(answer.find("Content-Length: 4\r\n"), std::string::npos) << answer;
  EXPECT_NE(answer.find("Connection: close\r\n"), std::string::npos) << answer;
  EXPECT_TRUE(answer.ends_with("\r\n\r\nx 1\n")) << answer;
}

TEST_F(MetricsServerTest, RefusesOtherRequests) {
  EXPECT_TRUE(ask("GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n").starts_with("HTTP/1.1 404 "));
  EXPECT_TRUE(
      ask("POST /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 3\r\n\r\n").starts_with("HTTP/1.1 405 "));
  // The name of a page that leads here: DNS rebinding.
  EXPECT_TRUE(ask("GET /metrics HTTP/1.1\r\nHost: evil.example\r\n\r\n").starts_with("HTTP/1.1 403 "));
  EXPECT_EQ(scrapes, 0);
}

TEST_F(MetricsServerTest, ClosesConnectionsThatDoNotSpeakHttp) {
  EXPECT_EQ(ask("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"), "");
  EXPECT_EQ(ask(std::string(100, '\0')), "");
  EXPECT_EQ(ask("GET /metrics HTTP/1.1\r\nHost: 127.0.0.1\r\nA: " + std::string(limits::kMaxMetricsHeaderBytes, 'a') +
                "\r\n\r\n"),
            "");
  EXPECT_EQ(scrapes, 0);
  EXPECT_TRUE(ask(kScrape).ends_with("x 1\n"));
}

TEST_F(MetricsServerTest, StrangersThatHoldConnectionsKeepNoScraperOut) {
  std::vector<Descriptor> strangers;
  for (std::size_t i = 0; i < 3 * limits::kMaxMetricsConnections; ++i) {
    strangers.push_back(connected());
    say(strangers.back(), "GET /metr");
  }
  EXPECT_TRUE(ask(kScrape).ends_with("x 1\n"));
  EXPECT_EQ(heard(strangers.front()), "") << "the oldest made room";
  say(strangers.back(), "ics HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n");
  EXPECT_TRUE(heard(strangers.back()).ends_with("x 1\n")) << "the newest is served";
}

TEST_F(MetricsServerTest, ClosesAConnectionThatSendsTooSlowly) {
  server.reset();
  start(std::chrono::milliseconds(100));
  const Descriptor slow = connected();
  say(slow, "GET /metr");
  EXPECT_EQ(heard(slow), "");
}

TEST_F(MetricsServerTest, GoesOnAfterAnAnswerForWhichThereWasNoMemory) {
  no_memory = true;
  EXPECT_EQ(ask(kScrape), "");
  EXPECT_TRUE(ask(kScrape).ends_with("x 1\n"));
}

TEST_F(MetricsServerTest, NamesAnAddressThatIsTaken) {
  const auto start = [&] {
    return MetricsServer::start(
        server->endpoint(), [] { return std::string(); }, [](std::string_view) { return true; });
  };
  EXPECT_REFUSED(start(), ErrorCode::kUnavailable, "cannot listen on '" + server->endpoint());
}

TEST_F(MetricsServerTest, EndsWithConnectionsOpen) {
  const Descriptor waiting = connected();
  say(waiting, "GET");
  server.reset();
  EXPECT_EQ(heard(waiting), "");
}

}  // namespace
}  // namespace tensormass::metrics
