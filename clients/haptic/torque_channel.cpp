#include "haptic/torque_channel.h"

#include "haptic/force_renderer.h"

namespace tensormass::haptic {

TorqueChannel::TorqueChannel(const TorqueOptions& options)
    : options_(options),
      passivity_({.max_stored_energy_j = options.max_stored_energy_j, .max_damping = options.max_damping_n_m_s}) {}

Eigen::Vector3d TorqueChannel::apply(const Eigen::Vector3d& turned_rad, const Eigen::Vector3d& held_n_m,
                                     const Eigen::Vector3d& wanted_n_m, double period_s) {
  if (!(options_.max_torque_n_m > 0.0)) return Eigen::Vector3d::Zero();
  const Eigen::Vector3d passive = passivity_.apply(turned_rad, held_n_m, wanted_n_m, period_s);
  return limit(passive, held_n_m, options_.max_slew_n_m_per_s * period_s, options_.max_torque_n_m);
}

double TorqueChannel::apply(double turned_rad, double held_n_m, double wanted_n_m, double period_s) {
  const Eigen::Vector3d axis = Eigen::Vector3d::UnitX();
  return apply(Eigen::Vector3d(turned_rad * axis), Eigen::Vector3d(held_n_m * axis), Eigen::Vector3d(wanted_n_m * axis),
               period_s)
      .x();
}

}  // namespace tensormass::haptic
