#pragma once

// The torque of a tool that touches at one point, between two answers of the server. Pure, no thread, nothing fails.
//
// The server sends no angular stiffness. A held torque would be late, and a late spring shakes the hand. Force F₀ and
// torque M₀ tell how far from the tool's origin the contact is, and the local stiffness K tells the rest:
//
//     r = F₀ × M₀ / |F₀|²          lever, across the force
//     C = M₀ − r × F₀              couple: what a single contact cannot explain
//     F_c = F(p) − K (δθ × r)      force at the contact, which moves by δθ × r as the hand turns by δθ
//     M = r × F_c + C
//
// M acts as a spring of the stiffness [r]ᵀ K [r]. A device bounds it: stiffer contact is scaled down, torque and
// stiffness alike. C is held, thus late. It is zero for one contact without friction, and small with friction.
//
// Symbols: p tool position [m], δθ rotation vector since the answer [rad], F force [N], M torque about p [N m].

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "haptic/feedback.h"

namespace tensormass::haptic {

class PointContact {
 public:
  /// No contact.
  PointContact() = default;
  /// `model` has the stiffness and the force that are rendered. `max_stiffness_n_m_per_rad`: usually
  /// DeviceInfo::max_angular_stiffness_n_m_per_rad.
  PointContact(const Feedback& model, double max_stiffness_n_m_per_rad);

  /// The torque on a hand of this orientation that feels `force_n`, the model's force at its place. Contact pushes and
  /// never pulls: F_c along F₀ is clamped at zero.
  Eigen::Vector3d torque_n_m(const Eigen::Vector3d& force_n, const Eigen::Quaterniond& orientation) const;

 private:
  Eigen::Vector3d lever_m_ = Eigen::Vector3d::Zero();
  Eigen::Vector3d couple_n_m_ = Eigen::Vector3d::Zero();
  // Unit vector along F₀, or zero.
  Eigen::Vector3d direction_ = Eigen::Vector3d::Zero();
  Eigen::Matrix3d stiffness_n_per_m_ = Eigen::Matrix3d::Zero();
  Eigen::Quaterniond orientation_ = Eigen::Quaterniond::Identity();
  double scale_ = 1.0;
};

}  // namespace tensormass::haptic
