#pragma once

#include <cmath>

#include <Eigen/Core>
#include <Eigen/Geometry>

#include "core/limits.h"

namespace tensormass::haptic {

inline bool is_positive(double value) { return std::isfinite(value) && value > 0.0; }
inline bool is_not_negative(double value) { return std::isfinite(value) && value >= 0.0; }

/// Finite and within the largest length that the protocol takes.
inline bool is_position(const Eigen::Vector3d& position_m) {
  return position_m.allFinite() && position_m.cwiseAbs().maxCoeff() <= limits::kMaxLength;
}

/// Less than 1 % off unit length, as the protocol asks; refuses what is not finite too.
inline bool is_rotation(const Eigen::Quaterniond& orientation) { return std::abs(orientation.norm() - 1.0) < 0.01; }

}  // namespace tensormass::haptic
