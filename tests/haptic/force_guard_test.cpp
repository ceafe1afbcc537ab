#include <gtest/gtest.h>

#include <chrono>
#include <condition_variable>
#include <mutex>

#include "fakes.h"
#include "haptic/force_guard.h"

namespace tensormass::haptic {
namespace {

const Eigen::Vector3d kForce(0.0, 0.0, 1.5);

TEST(ForceGuard, SetsAForceToZeroThatIsNotRenewed) {
  FakeClock clock;
  FakeDevice device;
  ForceGuard guard(device, clock, 0.05);
  ASSERT_TRUE(guard.write({kForce}));
  clock.advance_s(0.05);
  guard.check();
  EXPECT_EQ(guard.trips(), 0u);
  EXPECT_EQ(guard.held().force_n, kForce);
  clock.advance_s(0.001);
  guard.check();
  EXPECT_EQ(guard.trips(), 1u);
  EXPECT_EQ(device.forces_n.back(), Eigen::Vector3d::Zero());
  EXPECT_TRUE(guard.held().is_zero());
  // Zero already, so no further write. The loop may resume.
  clock.advance_s(1.0);
  guard.check();
  EXPECT_EQ(guard.trips(), 1u);
  ASSERT_TRUE(guard.write({kForce}));
  EXPECT_EQ(device.forces_n.back(), kForce);
}

TEST(ForceGuard, ReleaseSetsTheForceToZeroAndRefusesLaterWrites) {
  FakeClock clock;
  FakeDevice device;
  ForceGuard guard(device, clock, 0.05);
  ASSERT_TRUE(guard.write({kForce}));
  guard.release();
  EXPECT_EQ(device.forces_n.back(), Eigen::Vector3d::Zero());
  EXPECT_FALSE(guard.write({kForce}));
  EXPECT_EQ(device.forces_n.back(), Eigen::Vector3d::Zero());
}

TEST(ForceGuard, EndsWithoutForce) {
  FakeClock clock;
  FakeDevice device;
  {
    ForceGuard guard(device, clock, 0.05);
    ASSERT_TRUE(guard.write({kForce}));
  }
  EXPECT_EQ(device.forces_n.back(), Eigen::Vector3d::Zero());
}

TEST(ForceGuard, SetsTorquesToZeroWithTheForce) {
  FakeClock clock;
  FakeWrist device;
  {
    ForceGuard guard(device, clock, 0.05);
    for (const Wrench& wrench : {Wrench{Eigen::Vector3d::Zero(), Eigen::Vector3d(0.0, 0.1, 0.0)},
                                 Wrench{Eigen::Vector3d::Zero(), Eigen::Vector3d::Zero(), -0.1}}) {
      ASSERT_TRUE(guard.write(wrench));
      EXPECT_FALSE(device.wrenches.back().is_zero());
      clock.advance_s(0.051);
      guard.check();
      EXPECT_TRUE(device.wrenches.back().is_zero());
      EXPECT_TRUE(guard.held().is_zero());
    }
    EXPECT_EQ(guard.trips(), 2u);
    ASSERT_TRUE(guard.write({kForce, kForce, 0.1}));
  }
  EXPECT_TRUE(device.wrenches.back().is_zero());
}

TEST(ForceGuard, ADeviceThatStatesATorqueButCannotWriteItIsAnError) {
  FakeClock clock;
  FakeDevice device;
  ForceGuard guard(device, clock, 0.05);
  const auto written = guard.write({kForce, kForce});
  ASSERT_FALSE(written);
  EXPECT_EQ(written.error().message, "fake: its info() states a torque, but it lacks write()");
  EXPECT_TRUE(device.forces_n.empty());
}

// Signals the arrival of a zero force.
class SignallingDevice final : public Device {
 public:
  Result<void> open() override { return {}; }
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override { return DevicePose{}; }
  Result<void> write_force(const Eigen::Vector3d& force_n) override {
    const std::scoped_lock lock(mutex_);
    zero_ = force_n.isZero(0.0);
    changed_.notify_all();
    return {};
  }
  void close() noexcept override {}

  bool wait_for_zero(std::chrono::seconds limit) {
    std::unique_lock lock(mutex_);
    return changed_.wait_for(lock, limit, [this] { return zero_; });
  }

 private:
  DeviceInfo info_;
  std::mutex mutex_;
  std::condition_variable changed_;
  bool zero_ = true;
};

TEST(Watchdog, SetsTheForceToZeroWhileTheLoopIsStuck) {
  MonotonicClock clock;
  SignallingDevice device;
  ForceGuard guard(device, clock, 0.005);
  const Watchdog watchdog(guard, 0.001);
  ASSERT_TRUE(guard.write({kForce}));
  EXPECT_TRUE(device.wait_for_zero(std::chrono::seconds(10)));
  EXPECT_EQ(guard.trips(), 1u);
}

}  // namespace
}  // namespace tensormass::haptic
