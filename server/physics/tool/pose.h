#pragma once

#include <array>

#include <Eigen/Geometry>

#include "core/limits.h"
#include "core/scalar.h"

namespace tensormass::physics {

/// Position, orientation and joints of a tool, on the host.
struct Pose {
  Vec3<double> position_m = Vec3<double>::Zero();
  std::array<double, 4> orientation{1, 0, 0, 0};              ///< unit quaternion, w x y z
  std::array<double, limits::kMaxToolJoints> joint_values{};  ///< rad or m; zero beyond the tool's joints
};

inline Eigen::Quaterniond rotation(const Pose& pose) {
  return {pose.orientation[0], pose.orientation[1], pose.orientation[2], pose.orientation[3]};
}

/// Returns the pose at a fraction of the way, exactly `from` at 0: straight for the position and the joints, about one
/// axis for the orientation.
inline Pose between(const Pose& from, const Pose& to, double fraction) {
  const Eigen::Quaterniond turned = rotation(from).slerp(fraction, rotation(to));
  Pose out{from.position_m + fraction * (to.position_m - from.position_m),
           {turned.w(), turned.x(), turned.y(), turned.z()},
           {}};
  for (std::size_t i = 0; i < out.joint_values.size(); ++i) {
    out.joint_values[i] = from.joint_values[i] + fraction * (to.joint_values[i] - from.joint_values[i]);
  }
  return out;
}

/// Returns the turn from one orientation to another: angle times axis, in the scene's frame, at most π [rad].
inline Vec3<double> rotation_vector(const Pose& from, const Pose& to) {
  Eigen::Quaterniond turn = rotation(to) * rotation(from).conjugate();
  if (turn.w() < 0) turn.coeffs() = -turn.coeffs();
  const double sine = turn.vec().norm();
  if (!(sine > 0)) return Vec3<double>::Zero();
  return turn.vec() * (2 * std::atan2(sine, turn.w()) / sine);
}

}  // namespace tensormass::physics
