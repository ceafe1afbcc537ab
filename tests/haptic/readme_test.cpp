#include <gtest/gtest.h>

#include "fakes.h"
#include "haptic/loop.h"

// Defined in the README's example, which CMake extracts and compiles.
tensormass::Result<tensormass::haptic::LoopReport> run_device(tensormass::haptic::Device& device,
                                                              const std::string& server, const std::atomic<bool>& stop);

namespace tensormass::haptic {
namespace {

TEST(Readme, ItsExampleDoesNotTouchTheDeviceWithoutAServer) {
  FakeDevice device;
  const std::atomic<bool> stop = true;
  const auto report = run_device(device, "127.0.0.1:1", stop);
  ASSERT_FALSE(report);
  EXPECT_EQ(report.error().code, ErrorCode::kCancelled);
  EXPECT_TRUE(device.forces_n.empty());
}

}  // namespace
}  // namespace tensormass::haptic
