#include "daemon/config.h"

#include <gtest/gtest.h>

namespace tensormass::daemon {
namespace {

TEST(LocalEndpoints, AreLiteralAddressesOfLoopbackAndLocalhost) {
  for (const char* local : {"127.0.0.1:50051", "127.3.2.1:1", "[::1]:50051", "localhost:50051", "tcp://127.0.0.1:50052",
                            "tcp/localhost:7447", "ipc:///run/tensormass", ""}) {
    EXPECT_TRUE(is_local_endpoint(local)) << local;
  }
  // DNS decides where the names lead, and 127 as the first byte of a name means nothing.
  for (const char* other : {"127.0.0.1.example.com:50051", "127.evil.example:50051", "127.:1", "127.0.0.1.:1",
                            "127.0.0.300:1", "127.1:1", "localhost.example:1", "0.0.0.0:50051", "10.127.0.1:1",
                            "[::]:1", "[::2]:1", "tcp://127.example:50052", "tcp://*:50052", "tcp/127.example:7447"}) {
    EXPECT_FALSE(is_local_endpoint(other)) << other;
  }
}

}  // namespace
}  // namespace tensormass::daemon
