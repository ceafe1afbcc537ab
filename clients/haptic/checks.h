#pragma once

// Checks of values that come from outside: options, devices, feedback. Pure functions, for any thread.

#include <cmath>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "core/limits.h"

namespace tensormass::haptic {

inline bool is_positive(double value) { return std::isfinite(value) && value > 0.0; }
inline bool is_not_negative(double value) { return std::isfinite(value) && value >= 0.0; }

/// True if every coordinate is finite and within the largest length of the protocol [m].
inline bool is_position(const Eigen::Vector3d& position_m) {
  return position_m.allFinite() && position_m.cwiseAbs().maxCoeff() <= limits::kMaxLength;
}

/// True if the quaternion's length is off 1 by less than 1 %, as the protocol asks. False if it is not finite.
inline bool is_rotation(const Eigen::Quaterniond& orientation) { return std::abs(orientation.norm() - 1.0) < 0.01; }

}  // namespace tensormass::haptic
