#pragma once

// Keeps what is rendered from feeding energy to the hand. Pure, no thread, nothing fails.
//
// Symbols: n tick, x position [m], v velocity [m/s], F force held by the device [N], E energy given by the hand and not
// returned [J], T period of the loop [s], α damping [N s/m]. For a torque read rad for m, N m for N and N m s for N
// s/m.

#include <Eigen/Core>

namespace tensormass::haptic {

struct PassivityOptions {
  /// Upper bound on E [J]. Enough for the elastic energy of a press (3 N over 3 cm is 0.05 J), too little to hide an
  /// instability behind a long, dissipative contact.
  double max_stored_energy_j = 0.1;
  /// Upper bound on α [N s/m, for a torque N m s]; usually DeviceInfo::max_damping_n_s_per_m.
  double max_damping = 20.0;
};

/// Passivity observer and controller in the time domain (Hannaford and Ryu, IEEE Trans. Robotics and Automation 18(1),
/// 2002), for an impedance display: position in, force out. Its work is force · way or torque · rotation.
///
/// A local model that arrives late and jumps with every simulation step can return more energy than the hand gave. The
/// hand feels this as buzzing. The observer counts the energy. The count is exact, because the device holds its force
/// between two writes:
///
///     E_n = E_{n-1} − F_{n-1} · (x_n − x_{n-1})
///
/// E_n < 0 means that the virtual tissue has been active. The controller then adds the damping that removes the deficit
/// within the next period, α = −E_n / (|v|² T), bounded by the device. The rest stays in the count.
class PassivityController {
 public:
  explicit PassivityController(const PassivityOptions& options) : options_(options) {}

  /// Returns the force to apply next: `wanted` plus damping. Call once a period. `moved` is x_n − x_{n-1}, zero in the
  /// first period, and `held` the force that the device held meanwhile.
  Eigen::Vector3d apply(const Eigen::Vector3d& moved, const Eigen::Vector3d& held, const Eigen::Vector3d& wanted,
                        double period_s);

  /// E: energy that the hand has given and not got back [J].
  double energy_j() const { return energy_j_; }

 private:
  PassivityOptions options_;
  double energy_j_ = 0.0;
};

}  // namespace tensormass::haptic
