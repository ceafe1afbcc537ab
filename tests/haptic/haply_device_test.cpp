#include "haptic/haply_device.h"

#include <gtest/gtest.h>

#include <limits>
#include <string>

namespace tensormass::haptic {
namespace {

// tests/python/test_haply.py runs the device against a simulated service.

TEST(HaplyUrl, HasAHostAPortAndAPath) {
  struct Case {
    const char* url;
    HaplyAddress address;
  };
  for (const auto& [url, expected] :
       {Case{"ws://127.0.0.1:10001", {"127.0.0.1", "10001", "/"}}, Case{"ws://localhost", {"localhost", "10001", "/"}},
        Case{"ws://localhost/", {"localhost", "10001", "/"}},
        Case{"ws://haply.local:8500/a/b", {"haply.local", "8500", "/a/b"}},
        Case{"ws://[::1]:10002", {"::1", "10002", "/"}}, Case{"ws://[::1]", {"::1", "10001", "/"}}}) {
    const auto address = parse_haply_url(url);
    ASSERT_TRUE(address) << url;
    EXPECT_EQ(address->host, expected.host) << url;
    EXPECT_EQ(address->port, expected.port) << url;
    EXPECT_EQ(address->path, expected.path) << url;
  }
}

TEST(HaplyUrl, RefusesEverythingElse) {
  for (const char* url : {"", "ws://", "127.0.0.1:10001", "wss://127.0.0.1:10001", "http://127.0.0.1:10001",
                          "ws://:10001", "ws://host:", "ws://host:port", "ws://host:99999", "ws://host:1234567",
                          "ws://host:-1", "ws://a b:1", "ws://[]:1"}) {
    const auto address = parse_haply_url(url);
    ASSERT_FALSE(address) << url;
    EXPECT_EQ(address.error().code, ErrorCode::kInvalidArgument);
    EXPECT_NE(address.error().message.find("ws://127.0.0.1:10001"), std::string::npos);
  }
}

TEST(HaplyDevice, IsNotReadOrWrittenBeforeOpen) {
  HaplyDevice device({});
  EXPECT_EQ(device.read().error().code, ErrorCode::kFailedPrecondition);
  EXPECT_EQ(device.write_force(Eigen::Vector3d::Zero()).error().code, ErrorCode::kFailedPrecondition);
  device.close();
  device.close();
}

TEST(HaplyDevice, WithoutAServiceNamesTheUrlAndTheRemedy) {
  HaplyOptions options;
  options.url = "ws://127.0.0.1:1";
  HaplyDevice device(options);
  for (int again = 0; again < 2; ++again) {
    const auto opened = device.open();
    ASSERT_FALSE(opened);
    EXPECT_EQ(opened.error().code, ErrorCode::kUnavailable);
    EXPECT_NE(opened.error().message.find("no Haply Inverse service at ws://127.0.0.1:1: Connection refused"),
              std::string::npos)
        << opened.error().message;
    EXPECT_NE(opened.error().message.find("Haply Hub"), std::string::npos);
    EXPECT_FALSE(device.read());
  }
}

TEST(HaplyDevice, RefusesOptionsWithoutMeaning) {
  HaplyOptions flat, nowhere, twisted;
  flat.workspace.scale = 0.0;
  nowhere.workspace.scene_center_m.x() = std::numeric_limits<double>::quiet_NaN();
  twisted.workspace.rotation.coeffs().setZero();
  for (const HaplyOptions& options : {flat, nowhere, twisted}) {
    const auto opened = HaplyDevice(options).open();
    ASSERT_FALSE(opened);
    EXPECT_EQ(opened.error().code, ErrorCode::kInvalidArgument) << opened.error().message;
  }
}

}  // namespace
}  // namespace tensormass::haptic
