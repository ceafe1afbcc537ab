#pragma once

// A device without hardware, for tests, demos and load. Units: kg, m, N, s. Called by one thread at a time, as every
// Device. open() fails on options without meaning; read and write fail before open().

#include <Eigen/Core>

#include "haptic/clock.h"
#include "haptic/device.h"
#include "haptic/hand_script.h"

namespace tensormass::haptic {

struct SimulatedDeviceOptions {
  /// Moving mass of device and hand together.
  double mass_kg = 0.1;
  /// The device's own viscous friction.
  double damping_n_s_per_m = 1.0;
  /// Spring and damper between the script's target and the device: the hand's grip.
  double hand_stiffness_n_per_m = 300.0;
  double hand_damping_n_s_per_m = 8.0;
  DeviceInfo info{"simulated", 8.0, 2000.0, 20.0};
};

/// A point mass held by a scripted hand:
///
///     m x'' = F + k (target − x) + c (target' − x') − b x'
///
/// x position, m mass, F written force (held between writes), k and c stiffness and damping of the grip, b friction.
/// Each sub-step is the exact solution for a constant input. The device therefore adds no energy and stays stable for
/// every hand.
class SimulatedDevice final : public Device {
 public:
  /// `clock` must outlive the device.
  SimulatedDevice(const SimulatedDeviceOptions& options, const HandScript& script, Clock& clock);

  Result<void> open() override;
  const DeviceInfo& info() const override { return options_.info; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override;
  void close() noexcept override;

  /// The force on the hand now [N].
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
