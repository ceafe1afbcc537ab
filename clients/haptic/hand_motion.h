#pragma once

// How the hand moves from one pose to the next: the motions whose products with force and torques are work. Pure.

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "haptic/device.h"

namespace tensormass::haptic {

struct HandMotion {
  Eigen::Vector3d moved_m = Eigen::Vector3d::Zero();
  /// Rotation vector in the scene's axes: the short way about one axis, at most half a turn.
  Eigen::Vector3d turned_rad = Eigen::Vector3d::Zero();
  /// Positive: the jaws opened. Zero if a pose lacks their angle.
  double jaws_opened_rad = 0.0;
};

/// Returns the rotation vector from one orientation to another, as in HandMotion. Neither needs unit length.
Eigen::Vector3d rotation_between(const Eigen::Quaterniond& from, const Eigen::Quaterniond& to);

/// Returns the motion between two valid poses.
HandMotion motion_between(const DevicePose& from, const DevicePose& to);

}  // namespace tensormass::haptic
