#include "haptic/passivity_controller.h"

#include <algorithm>

namespace tensormass::haptic {

Eigen::Vector3d PassivityController::apply(const Eigen::Vector3d& position_m, const Eigen::Vector3d& held_force_n,
                                           const Eigen::Vector3d& wanted_force_n, double period_s) {
  const Eigen::Vector3d moved_m = started_ ? Eigen::Vector3d(position_m - last_position_m_) : Eigen::Vector3d::Zero();
  started_ = true;
  last_position_m_ = position_m;
  energy_j_ = std::min(energy_j_ - held_force_n.dot(moved_m), options_.max_stored_energy_j);

  const Eigen::Vector3d velocity = moved_m / period_s;
  const double speed_squared = velocity.squaredNorm();
  if (energy_j_ >= 0.0 || speed_squared == 0.0) return wanted_force_n;
  const double damping = std::min(-energy_j_ / (speed_squared * period_s), options_.max_damping_n_s_per_m);
  return wanted_force_n - damping * velocity;
}

}  // namespace tensormass::haptic
