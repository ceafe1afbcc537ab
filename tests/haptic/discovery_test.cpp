#include "haptic/discovery.h"

#include <gtest/gtest.h>

#include <chrono>
#include <thread>

namespace tensormass::haptic {
namespace {

TEST(ReachedEndpoint, ReplacesAWildcardByTheHostOfTheControlPlane) {
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", "trainer:50051"), "tcp://trainer:1");
  EXPECT_EQ(reached_endpoint("tcp://*:1", "10.0.0.2:50051"), "tcp://10.0.0.2:1");
  EXPECT_EQ(reached_endpoint("tcp://[::]:1", "[fe80::1]:50051"), "tcp://[fe80::1]:1");
  EXPECT_EQ(reached_endpoint("tcp/0.0.0.0:1", "trainer:50051"), "tcp/trainer:1");
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", "dns:///trainer:50051"), "tcp://trainer:1");
}

TEST(ReachedEndpoint, LeavesEveryOtherEndpointUnchanged) {
  for (const char* endpoint : {"tcp://127.0.0.1:1", "tcp://[::1]:1", "tcp/10.0.0.2:1", "", "nonsense", "a:b/c"}) {
    EXPECT_EQ(reached_endpoint(endpoint, "trainer:50051"), endpoint);
  }
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", ""), "tcp://0.0.0.0:1");
}

TEST(DiscoverTool, EndsAtOnceWhenStopped) {
  std::atomic<bool> stop = false;
  const auto start = std::chrono::steady_clock::now();
  std::jthread stopper([&] {
    std::this_thread::sleep_for(std::chrono::milliseconds(50));
    stop = true;
  });
  // Nobody listens on port 1.
  const auto tool = discover_tool("127.0.0.1:1", "demo", "probe", {60.0, stop});
  ASSERT_FALSE(tool);
  EXPECT_EQ(tool.error().code, ErrorCode::kCancelled);
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(10));
}

TEST(DiscoverTool, NamesTheAddressThatDidNotAnswer) {
  const std::atomic<bool> stop = false;
  const auto tool = discover_tool("127.0.0.1:1", "demo", "probe", {0.1, stop});
  ASSERT_FALSE(tool);
  EXPECT_EQ(tool.error().code, ErrorCode::kUnavailable);
  EXPECT_NE(tool.error().message.find("127.0.0.1:1"), std::string::npos);
}

}  // namespace
}  // namespace tensormass::haptic
