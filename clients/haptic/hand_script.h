#pragma once

#include <Eigen/Core>

#include "core/result.h"

namespace tensormass::haptic {

/// How a scripted hand palpates: from `home_m` to `contact_m`, `depth_m` beyond it along `direction`, around in
/// circles there, and back.
struct HandScriptOptions {
  Eigen::Vector3d home_m = Eigen::Vector3d::Zero();
  /// Where the tool first touches.
  Eigen::Vector3d contact_m = Eigen::Vector3d::Zero();
  /// Into the tissue; any length but zero.
  Eigen::Vector3d direction = -Eigen::Vector3d::UnitZ();
  double depth_m = 0.01;
  double circle_radius_m = 0.005;
  /// Circles in one cycle.
  double circle_count = 2.0;
  /// One cycle: 25 % approach, 15 % press, 40 % circles, 15 % lift, 5 % rest.
  double period_s = 4.0;
};

/// Where the scripted hand wants to be: a periodic path whose position and velocity are continuous (minimum-jerk
/// segments), so that the hand itself excites nothing.
class HandScript {
 public:
  struct Target {
    Eigen::Vector3d position_m;
    Eigen::Vector3d velocity_m_per_s;
  };

  /// Refuses lengths and times that are not finite or not positive, naming the option.
  static Result<HandScript> create(const HandScriptOptions& options);

  Target at(double time_s) const;

 private:
  explicit HandScript(const HandScriptOptions& options);

  HandScriptOptions options_;
  Eigen::Vector3d bottom_m_;
  // The circles' plane.
  Eigen::Vector3d tangent_u_;
  Eigen::Vector3d tangent_v_;
};

}  // namespace tensormass::haptic
