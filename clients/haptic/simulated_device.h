#pragma once

#include <Eigen/Core>

#include "haptic/clock.h"
#include "haptic/device.h"
#include "haptic/hand_script.h"

namespace tensormass::haptic {

struct SimulatedDeviceOptions {
  /// Of the moving end of the device together with the hand's.
  double mass_kg = 0.1;
  /// The device's own friction, against the ground.
  double damping_n_s_per_m = 1.0;
  /// The hand holds the device by a spring and a damper on the script's target.
  double hand_stiffness_n_per_m = 300.0;
  double hand_damping_n_s_per_m = 8.0;
  DeviceInfo info{"simulated", 8.0, 2000.0, 20.0};
};

/// A point mass held by a scripted hand:
///
///     m x'' = F + k (target − x) + c (target' − x') − b x'
///
/// F is the written force, held between writes as a real device holds it. The motion over each sub-step is the exact
/// solution for a constant input, so the device adds no energy of its own and stays stable for any hand.
class SimulatedDevice final : public Device {
 public:
  /// `clock` outlives the device.
  SimulatedDevice(const SimulatedDeviceOptions& options, const HandScript& script, Clock& clock);

  Result<void> open() override;
  const DeviceInfo& info() const override { return options_.info; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override;
  void close() noexcept override;

  /// The force that the hand feels now.
  const Eigen::Vector3d& held_force_n() const { return force_n_; }
  const Eigen::Vector3d& velocity_m_per_s() const { return velocity_m_per_s_; }

 private:
  void advance_to_now();
  void step(double time_s);

  SimulatedDeviceOptions options_;
  HandScript script_;
  Clock& clock_;
  bool open_ = false;
  std::int64_t start_ns_ = 0;
  std::int64_t steps_done_ = 0;
  // (x, x')ᵀ after a sub-step = transition_ (x, x')ᵀ + input_ · (force per mass).
  Eigen::Matrix2d transition_;
  Eigen::Vector2d input_;
  Eigen::Vector3d position_m_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d velocity_m_per_s_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d force_n_ = Eigen::Vector3d::Zero();
};

}  // namespace tensormass::haptic
