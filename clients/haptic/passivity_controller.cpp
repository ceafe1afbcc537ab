#include "haptic/passivity_controller.h"

#include <algorithm>

namespace tensormass::haptic {

Eigen::Vector3d PassivityController::apply(const Eigen::Vector3d& moved, const Eigen::Vector3d& held,
                                           const Eigen::Vector3d& wanted, double period_s) {
  energy_j_ = std::min(energy_j_ - held.dot(moved), options_.max_stored_energy_j);

  const Eigen::Vector3d velocity = moved / period_s;
  const double speed_squared = velocity.squaredNorm();
  if (energy_j_ >= 0.0 || speed_squared == 0.0) return wanted;
  const double damping = std::min(-energy_j_ / (speed_squared * period_s), options_.max_damping);
  return wanted - damping * velocity;
}

}  // namespace tensormass::haptic
