#include "haptic/run_device.h"

#include <gtest/gtest.h>

#include <string>
#include <vector>

#include "fakes.h"

namespace tensormass::haptic {
namespace {

/// Records the calls in their order: "open", "read", "force", "zero", "close".
class RecordingDevice final : public Device {
 public:
  Result<void> open() override { return opens ? record("open") : fail(ErrorCode::kUnavailable, "not plugged in"); }
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override {
    if (++reads_ > reads_that_succeed) return fail(ErrorCode::kUnavailable, "unplugged");
    static_cast<void>(record("read"));
    return DevicePose{};
  }
  Result<void> write_force(const Eigen::Vector3d& force_n) override {
    return record(force_n.isZero(0.0) ? "zero" : "force");
  }
  void close() noexcept override { static_cast<void>(record("close")); }

  bool opens = true;
  int reads_that_succeed = 1'000'000;
  std::vector<std::string> calls;

 private:
  Result<void> record(const char* call) {
    calls.emplace_back(call);
    return {};
  }

  DeviceInfo info_{"recording", 10.0, 2000.0, 20.0};
  int reads_ = 0;
};

LoopOptions short_run() {
  LoopOptions options;
  options.duration_s = 0.02;
  options.drain_s = 0.0;
  return options;
}

/// Answers each pose with a force of 1 N.
void push(FakeLink& link) {
  link.answer = [](const OutgoingPose& pose) {
    Feedback feedback = answer_to(pose, pose.sequence);
    feedback.force_n = Eigen::Vector3d::UnitZ();
    return feedback;
  };
}

TEST(RunDevice, OpensTheDeviceRendersAForceAndClosesItWithoutForce) {
  RecordingDevice device;
  FakeLink link;
  push(link);
  const auto report = run_device(device, link, short_run(), false);
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_GT(report->max_force_n, 0.0);
  ASSERT_GE(device.calls.size(), 5u);
  EXPECT_EQ(device.calls.front(), "open");
  EXPECT_NE(std::find(device.calls.begin(), device.calls.end(), "force"), device.calls.end());
  EXPECT_EQ(device.calls[device.calls.size() - 2], "zero");
  EXPECT_EQ(device.calls.back(), "close");
  EXPECT_EQ(std::count(device.calls.begin(), device.calls.end(), "close"), 1);
}

TEST(RunDevice, ADeviceThatFailsIsClosedWithoutForceAndItsErrorReturned) {
  RecordingDevice device;
  device.reads_that_succeed = 5;
  FakeLink link;
  push(link);
  const auto report = run_device(device, link, short_run(), false);
  ASSERT_FALSE(report);
  EXPECT_EQ(report.error().message, "unplugged");
  EXPECT_EQ(device.calls[device.calls.size() - 2], "zero");
  EXPECT_EQ(device.calls.back(), "close");
}

TEST(RunDevice, ADeviceThatDoesNotOpenIsLeftAlone) {
  RecordingDevice device;
  device.opens = false;
  FakeLink link;
  const auto report = run_device(device, link, short_run(), false);
  ASSERT_FALSE(report);
  EXPECT_EQ(report.error().message, "not plugged in");
  EXPECT_TRUE(device.calls.empty());
  EXPECT_TRUE(link.sent.empty());
}

TEST(RunDevice, StopSetBeforehandSendsNoPose) {
  RecordingDevice device;
  FakeLink link;
  const auto report = run_device(device, link, LoopOptions{}, true);
  ASSERT_TRUE(report);
  EXPECT_TRUE(link.sent.empty());
  EXPECT_EQ(device.calls, (std::vector<std::string>{"open", "zero", "close"}));
}

}  // namespace
}  // namespace tensormass::haptic
