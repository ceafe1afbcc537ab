#include "haptic/point_contact.h"

#include <algorithm>

#include <Eigen/Eigenvalues>

#include "haptic/hand_motion.h"

namespace tensormass::haptic {
namespace {

// Longest lever [m]. Contacts whose forces cancel leave a torque without force, whose lever would be endless.
constexpr double kMaxLeverM = 0.2;

Eigen::Vector3d lever_of(const Eigen::Vector3d& force_n, const Eigen::Vector3d& torque_n_m) {
  const double square = force_n.squaredNorm();
  if (square == 0.0) return Eigen::Vector3d::Zero();
  const Eigen::Vector3d lever = force_n.cross(torque_n_m) / square;
  const double length = lever.norm();
  if (!lever.allFinite()) return Eigen::Vector3d::Zero();
  return length <= kMaxLeverM ? lever : Eigen::Vector3d(lever * (kMaxLeverM / length));
}

/// Largest eigenvalue of [r]ᵀ K [r].
double angular_stiffness(const Eigen::Vector3d& r, const Eigen::Matrix3d& stiffness) {
  Eigen::Matrix3d cross;
  cross << 0.0, -r.z(), r.y(), r.z(), 0.0, -r.x(), -r.y(), r.x(), 0.0;
  const Eigen::Matrix3d angular = cross.transpose() * stiffness * cross;
  return Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d>(angular, Eigen::EigenvaluesOnly).eigenvalues()(2);
}

}  // namespace

PointContact::PointContact(const Feedback& model, double max_stiffness_n_m_per_rad)
    : lever_m_(lever_of(model.force_n, model.torque_n_m)),
      couple_n_m_(model.torque_n_m - lever_m_.cross(model.force_n)),
      direction_(model.force_n.stableNormalized()),
      stiffness_n_per_m_(model.stiffness_n_per_m),
      orientation_(model.orientation) {
  const double stiffness = angular_stiffness(lever_m_, stiffness_n_per_m_);
  if (stiffness > max_stiffness_n_m_per_rad) scale_ = max_stiffness_n_m_per_rad / stiffness;
}

Eigen::Vector3d PointContact::torque_n_m(const Eigen::Vector3d& force_n, const Eigen::Quaterniond& orientation) const {
  const Eigen::Vector3d turned_rad = rotation_between(orientation_, orientation);
  Eigen::Vector3d force = force_n - stiffness_n_per_m_ * turned_rad.cross(lever_m_);
  force -= std::min(0.0, force.dot(direction_)) * direction_;
  return scale_ * (lever_m_.cross(force) + couple_n_m_);
}

}  // namespace tensormass::haptic
