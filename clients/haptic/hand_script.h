#pragma once

// Motion of a simulated hand that palpates. Units: m, s, in the scene's frame. Pure and immutable after create(), which
// fails on options without meaning.

#include <Eigen/Core>

#include "core/result.h"

namespace tensormass::haptic {

/// One cycle of palpation: from `home_m` to `contact_m`, on by `depth_m` along `direction`, in circles there, and back.
struct HandScriptOptions {
  Eigen::Vector3d home_m = Eigen::Vector3d::Zero();
  /// The tool's origin at first touch.
  Eigen::Vector3d contact_m = Eigen::Vector3d::Zero();
  /// Points into the tissue. Any length except zero.
  Eigen::Vector3d direction = -Eigen::Vector3d::UnitZ();
  double depth_m = 0.01;
  double circle_radius_m = 0.005;
  /// Number of circles in a cycle.
  double circle_count = 2.0;
  /// Duration of a cycle: 25 % approach, 15 % press, 40 % circles, 15 % lift, 5 % rest.
  double period_s = 4.0;
};

/// Target of the hand: a periodic path of minimum-jerk segments. Position and velocity are continuous, so the path
/// itself excites no oscillation.
class HandScript {
 public:
  struct Target {
    Eigen::Vector3d position_m;
    Eigen::Vector3d velocity_m_per_s;
  };

  /// Fails if a length or a time is not finite or has the wrong sign, or if the direction is zero. Names the option.
  static Result<HandScript> create(const HandScriptOptions& options);

  /// Target at `time_s` after the start of the first cycle.
  Target at(double time_s) const;
  /// True while the hand circles at the bottom of the press.
  bool circles(double time_s) const;

 private:
  explicit HandScript(const HandScriptOptions& options);
  /// Part of the cycle that is over, 0 to 1.
  double phase(double time_s) const;

  HandScriptOptions options_;
  Eigen::Vector3d bottom_m_;
  // Unit vectors that span the plane of the circles.
  Eigen::Vector3d tangent_u_;
  Eigen::Vector3d tangent_v_;
};

}  // namespace tensormass::haptic
