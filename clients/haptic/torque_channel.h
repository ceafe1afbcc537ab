#pragma once

// The last steps of a torque: that on the hand, or that on its jaws. Pure, no thread, nothing fails.
//
//     torque of the model, times w (force_renderer.h) -> passivity controller -> slew -> magnitude -> device
//
// The model of a torque is poorer than that of a force, and the jaws' load has none: a part of it is a late spring,
// which feeds energy to the hand. Reasons that it stays harmless:
// 1. The magnitude is small. A hand that holds a grip resists 0.1 N m without effort.
// 2. The slew limit turns the steps of a slow scene into ramps.
// 3. The passivity controller counts the work of this torque alone. Energy of a press does not pay for a rotation.
//
// Units: N m, rad, N m s, s, in the scene's axes.

#include <Eigen/Core>

#include "haptic/passivity_controller.h"

namespace tensormass::haptic {

struct TorqueOptions {
  /// Usually the device's. Zero: no torque.
  double max_torque_n_m = 0.1;
  /// A full torque comes in 20 ms, about a step of a scene at 60 Hz.
  double max_slew_n_m_per_s = 5.0;
  /// Upper bound on the observer's energy [J]: that of a spring at 0.1 N m and 0.2 rad.
  double max_stored_energy_j = 0.01;
  /// Usually the device's.
  double max_damping_n_m_s = 0.05;
};

class TorqueChannel {
 public:
  explicit TorqueChannel(const TorqueOptions& options);

  /// Returns the torque to apply next. Call once a period. `turned_rad` is the rotation vector since the last call,
  /// and `held_n_m` the torque that the device held meanwhile. Zero if `wanted_n_m` is not finite.
  Eigen::Vector3d apply(const Eigen::Vector3d& turned_rad, const Eigen::Vector3d& held_n_m,
                        const Eigen::Vector3d& wanted_n_m, double period_s);
  /// The same about one axis, as that of the jaws.
  double apply(double turned_rad, double held_n_m, double wanted_n_m, double period_s);

  /// Energy that the hand has given and not got back [J].
  double energy_j() const { return passivity_.energy_j(); }

 private:
  TorqueOptions options_;
  PassivityController passivity_;
};

}  // namespace tensormass::haptic
