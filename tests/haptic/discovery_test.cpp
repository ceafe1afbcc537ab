#include "haptic/discovery.h"

#include <gtest/gtest.h>

namespace tensormass::haptic {
namespace {

TEST(ReachedEndpoint, AWildcardIsReachedWhereTheControlPlaneWas) {
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", "trainer:50051"), "tcp://trainer:1");
  EXPECT_EQ(reached_endpoint("tcp://*:1", "10.0.0.2:50051"), "tcp://10.0.0.2:1");
  EXPECT_EQ(reached_endpoint("tcp://[::]:1", "[fe80::1]:50051"), "tcp://[fe80::1]:1");
  EXPECT_EQ(reached_endpoint("tcp/0.0.0.0:1", "trainer:50051"), "tcp/trainer:1");
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", "dns:///trainer:50051"), "tcp://trainer:1");
}

TEST(ReachedEndpoint, EveryOtherStaysAsItIs) {
  for (const char* endpoint : {"tcp://127.0.0.1:1", "tcp://[::1]:1", "tcp/10.0.0.2:1", "", "nonsense", "a:b/c"}) {
    EXPECT_EQ(reached_endpoint(endpoint, "trainer:50051"), endpoint);
  }
  EXPECT_EQ(reached_endpoint("tcp://0.0.0.0:1", ""), "tcp://0.0.0.0:1");
}

}  // namespace
}  // namespace tensormass::haptic
