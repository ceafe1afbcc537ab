#pragma once

// Keeps the rendered force from feeding energy to the hand. Pure, no thread, nothing fails.
//
// Symbols: n tick, x position [m], v velocity [m/s], F force held by the device [N], E energy given by the hand and not
// returned [J], T period of the loop [s], α damping [N s/m].

#include <Eigen/Core>

namespace tensormass::haptic {

struct PassivityOptions {
  /// Upper bound on E [J]. Enough for the elastic energy of a press (3 N over 3 cm is 0.05 J), too little to hide an
  /// instability behind a long, dissipative contact.
  double max_stored_energy_j = 0.1;
  /// Upper bound on α; usually DeviceInfo::max_damping_n_s_per_m.
  double max_damping_n_s_per_m = 20.0;
};

/// Passivity observer and controller in the time domain (Hannaford and Ryu, IEEE Trans. Robotics and Automation 18(1),
/// 2002), for an impedance display: position in, force out.
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

  /// Returns the force to apply next: `wanted_force_n` plus damping. Call once a period. `held_force_n` is the force
  /// that the device held since the last call.
  Eigen::Vector3d apply(const Eigen::Vector3d& position_m, const Eigen::Vector3d& held_force_n,
                        const Eigen::Vector3d& wanted_force_n, double period_s);

  /// E: energy that the hand has given and not got back [J].
  double energy_j() const { return energy_j_; }

 private:
  PassivityOptions options_;
  bool started_ = false;
  Eigen::Vector3d last_position_m_ = Eigen::Vector3d::Zero();
  double energy_j_ = 0.0;
};

}  // namespace tensormass::haptic
