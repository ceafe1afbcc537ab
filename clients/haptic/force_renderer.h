#pragma once

#include <cstdint>
#include <optional>

#include <Eigen/Core>

#include "haptic/feedback.h"

namespace tensormass::haptic {

struct ForceRendererOptions {
  /// A stale force falls linearly to zero in this time. Long against a loop period, so that the hand is not jerked;
  /// short against a reaction time (about 150 ms), so that the hand does not lean on a tissue that is gone.
  double fade_s = 0.05;
  /// A feedback that answers an older pose than this is stale however new it is: the way up is broken, and its anchor
  /// no longer follows the hand.
  double max_pose_age_s = 0.5;
  /// A local model is trusted no longer than this, whatever it says.
  double max_valid_for_s = 0.5;
  /// DeviceInfo::max_stiffness_n_per_m; a stiffer local model is scaled down to it.
  double max_stiffness_n_per_m = 2000.0;
};

/// Closes the haptic loop on the server's local model, which changes only once a simulation step:
///
///     force(p) = w (force_n − stiffness (p − position_m))
///
/// The weight w is 1 while the model is valid, then falls linearly to 0 in fade_s. Pushing contact does not pull: the
/// part of the force along the model's own force_n is not allowed to change sign when the hand leaves the tissue
/// between two steps.
///
/// Pure: time comes in as an argument, nothing is sent or written.
class ForceRenderer {
 public:
  explicit ForceRenderer(const ForceRendererOptions& options) : options_(options) {}

  void update(const Feedback& feedback);

  struct Output {
    Eigen::Vector3d force_n = Eigen::Vector3d::Zero();
    /// w: 1 valid, 0 gone.
    double weight = 0.0;
  };
  /// Zero with weight 0 before the first update.
  Output render(const Eigen::Vector3d& position_m, std::int64_t now_ns) const;

 private:
  ForceRendererOptions options_;
  std::optional<Feedback> model_;
  std::int64_t valid_until_ns_ = 0;
};

struct ForceLimits {
  double max_force_n = 3.0;
  double max_slew_n_per_s = 300.0;
};

/// `wanted_n` with its change from `applied_n` limited to the slew of `dt_s` and then its magnitude to the maximum.
/// A force that is not finite becomes zero at once; so does every force if a limit is not a number.
Eigen::Vector3d limit_force(const Eigen::Vector3d& wanted_n, const Eigen::Vector3d& applied_n, double dt_s,
                            const ForceLimits& limits);

}  // namespace tensormass::haptic
