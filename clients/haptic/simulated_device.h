#pragma once

// A device without hardware, for tests, demos and load. Units: kg, m, N, s, rad, N m, kg m². Called by one thread at a
// time, as every Device. open() fails on options without meaning; read and write fail before open().

#include <optional>

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
  /// The same for rotations: of the grip about each axis, and of the jaws about their hinge.
  double inertia_kg_m2 = 5e-4;
  double angular_damping_n_m_s = 1e-3;
  double hand_angular_stiffness_n_m_per_rad = 2.0;
  double hand_angular_damping_n_m_s = 0.03;
  /// Angle at which the fingers hold the jaws, zero to kMaxJawAngleRad. Absent: the device has no jaws.
  std::optional<double> jaw_angle_rad = std::nullopt;
  /// The hand holds the device's button down while it circles.
  bool presses_button = false;
  DeviceInfo info{"simulated", 8.0, 2000.0, 20.0, 0.5, 2.0, 0.05, 0.5, 0.05};
};

/// Exact motion of m x'' = u − k x − c x' over a fixed step, for a constant u. For a rotation read inertia for m.
struct Oscillator {
  // (x, x')ᵀ after a step = transition (x, x')ᵀ + input · u / m.
  Eigen::Matrix2d transition;
  Eigen::Vector2d input;
};

/// A point mass held by a scripted hand:
///
///     m x'' = F + k (target − x) + c (target' − x') − b x'
///
/// x position, m mass, F written force (held between writes), k and c stiffness and damping of the grip, b friction.
/// The grip's rotation vector and the jaws' angle move in the same way under the written torques. They are held at no
/// rotation and at jaw_angle_rad. A rotation vector stands for a rotation only while it is small, as a hand keeps it.
/// Each sub-step is the exact solution for a constant input. The device therefore adds no energy and stays stable for
/// every hand.
class SimulatedDevice final : public Device {
 public:
  /// `clock` must outlive the device.
  SimulatedDevice(const SimulatedDeviceOptions& options, const HandScript& script, Clock& clock);

  Result<void> open() override;
  const DeviceInfo& info() const override { return options_.info; }
  Result<DevicePose> read() override;
  Result<void> write_force(const Eigen::Vector3d& force_n) override { return write({force_n}); }
  Result<void> write(const Wrench& wrench) override;
  void close() noexcept override;

  /// The force on the hand now [N].
  const Eigen::Vector3d& held_force_n() const { return held_.force_n; }
  const Eigen::Vector3d& velocity_m_per_s() const { return velocity_m_per_s_; }
  const Eigen::Vector3d& angular_velocity_rad_per_s() const { return turning_rad_per_s_; }

 private:
  void advance_to_now();
  void step(double time_s);

  SimulatedDeviceOptions options_;
  HandScript script_;
  Clock& clock_;
  bool open_ = false;
  std::int64_t start_ns_ = 0;
  std::int64_t steps_done_ = 0;
  Oscillator translation_;
  Oscillator rotation_;
  Eigen::Vector3d position_m_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d velocity_m_per_s_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d turn_rad_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d turning_rad_per_s_ = Eigen::Vector3d::Zero();
  double jaws_rad_ = 0.0;
  double jaws_rad_per_s_ = 0.0;
  Wrench held_;
};

}  // namespace tensormass::haptic
