#pragma once

#include <functional>
#include <optional>
#include <vector>

#include "haptic/clock.h"
#include "haptic/device.h"
#include "haptic/link.h"

namespace tensormass::haptic {

/// A clock that advances only when a test or the loop asks.
class FakeClock final : public Clock {
 public:
  std::int64_t now_ns() override { return now_ns_; }
  void sleep_until_ns(std::int64_t deadline_ns) override {
    now_ns_ = std::max(now_ns_, deadline_ns) + lateness_ns;
    if (on_wake) on_wake(now_ns_);
  }
  void advance_s(double seconds) { now_ns_ += static_cast<std::int64_t>(seconds * kNsPerS); }

  /// Added to every wake-up [ns].
  std::int64_t lateness_ns = 0;
  std::function<void(std::int64_t)> on_wake;

 private:
  std::int64_t now_ns_ = 1'000'000'000;
};

/// A device whose pose a test sets; records the forces.
class FakeDevice final : public Device {
 public:
  Result<void> open() override { return {}; }
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override {
    if (broken) return fail(ErrorCode::kUnavailable, "fake device: unplugged");
    if (on_read) on_read();
    return pose;
  }
  Result<void> write_force(const Eigen::Vector3d& force_n) override {
    forces_n.push_back(force_n);
    return {};
  }
  void close() noexcept override {}

  DevicePose pose;
  bool broken = false;
  /// Called before each read; may change `pose`.
  std::function<void()> on_read;
  std::vector<Eigen::Vector3d> forces_n;

 private:
  DeviceInfo info_{"fake", 10.0, 2000.0, 20.0};
};

/// The same with a wrist and a gripper; records the wrenches.
class FakeWrist final : public Device {
 public:
  Result<void> open() override { return {}; }
  const DeviceInfo& info() const override { return info_; }
  Result<DevicePose> read() override {
    if (on_read) on_read();
    return pose;
  }
  Result<void> write_force(const Eigen::Vector3d& force_n) override { return write({force_n}); }
  Result<void> write(const Wrench& wrench) override {
    wrenches.push_back(wrench);
    return {};
  }
  void close() noexcept override {}

  DevicePose pose{Eigen::Vector3d::Zero(), Eigen::Quaterniond::Identity(), 0.3};
  std::function<void()> on_read;
  std::vector<Wrench> wrenches;

 private:
  DeviceInfo info_{"wrist", 10.0, 2000.0, 20.0, 0.4, 5.0, 0.05, 0.3, 0.05};
};

/// A server in the loop's thread. `answer` is called with each pose; the feedback that it returns is received next.
class FakeLink final : public Link {
 public:
  bool send(const OutgoingPose& pose) override {
    sent.push_back(pose);
    if (answer) {
      if (auto feedback = answer(pose)) newest = feedback;
    }
    return takes_poses;
  }
  std::optional<Feedback> receive() override { return std::exchange(newest, std::nullopt); }
  std::uint64_t malformed() const override { return 0; }

  std::function<std::optional<Feedback>(const OutgoingPose&)> answer;
  bool takes_poses = true;
  std::optional<Feedback> newest;
  std::vector<OutgoingPose> sent;
};

/// Returns feedback that answers `pose` without delay, with zero force and stiffness.
inline Feedback answer_to(const OutgoingPose& pose, std::uint64_t step) {
  Feedback feedback;
  feedback.step = step;
  feedback.pose_sequence = pose.sequence;
  feedback.client_id = pose.client_id;
  feedback.client_time_ns = pose.client_time_ns;
  feedback.arrival_ns = pose.client_time_ns;
  feedback.position_m = pose.pose.position_m;
  feedback.orientation = pose.pose.orientation;
  feedback.valid_for_s = 0.02;
  return feedback;
}

}  // namespace tensormass::haptic
