#pragma once

#include <Eigen/Core>

namespace tensormass::haptic {

struct PassivityOptions {
  /// The observer credits the tissue with at most this much stored energy [J]: enough for the elastic energy of a
  /// press (3 N over 3 cm is 0.05 J), too little to hide an instability behind a long, dissipative contact.
  double max_stored_energy_j = 0.1;
  /// DeviceInfo::max_damping_n_s_per_m.
  double max_damping_n_s_per_m = 20.0;
};

/// Passivity observer and controller in the time domain (Hannaford and Ryu, IEEE Trans. Robotics and Automation 18(1),
/// 2002), for an impedance display: position in, force out.
///
/// A local model that jumps with every simulation step, and arrives late, can return more energy than the hand put in;
/// that is what a hand feels as buzzing. The observer counts the energy that the hand gave. Because the device holds a
/// force between two writes, the count is exact:
///
///     E_n = E_{n-1} − F_{n-1} · (x_n − x_{n-1})
///
/// When E_n < 0 the virtual tissue has been active, and the controller adds the damping that takes the deficit back
/// within the next period, α = −E_n / (|v|² T), as far as the device can render it; the rest stays in the count.
class PassivityController {
 public:
  explicit PassivityController(const PassivityOptions& options) : options_(options) {}

  /// Once a period: where the device is, which force it held since the last call, and the force wanted next. Returns
  /// the force to apply.
  Eigen::Vector3d apply(const Eigen::Vector3d& position_m, const Eigen::Vector3d& held_force_n,
                        const Eigen::Vector3d& wanted_force_n, double period_s);

  /// What the hand has given and not got back [J].
  double energy_j() const { return energy_j_; }

 private:
  PassivityOptions options_;
  bool started_ = false;
  Eigen::Vector3d last_position_m_ = Eigen::Vector3d::Zero();
  double energy_j_ = 0.0;
};

}  // namespace tensormass::haptic
