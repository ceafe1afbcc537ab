#pragma once

// Force and torques on the hand from the server's local model, and their last limits. Pure: the caller passes the time,
// nothing is sent or written, nothing fails.
//
// Symbols: p device position [m], F force [N], K stiffness [N/m], w weight of the model (1 valid, 0 expired), s
// progress of the fade after a recovery (0 to 1).

#include <cstdint>
#include <optional>

#include <Eigen/Core>

#include "haptic/feedback.h"
#include "haptic/point_contact.h"
#include "haptic/secant_stiffness.h"
#include "haptic/slipping_spring.h"

namespace tensormass::haptic {

struct ForceRendererOptions {
  /// Time in which a stale force falls linearly to zero, in which a renewed one returns, and in which a force that
  /// jumps in a recovery is reached [s]. Much longer than a loop period, so that the hand is not jerked. Much shorter
  /// than a reaction time (about 150 ms), so that the hand does not lean on vanished tissue.
  double fade_s = 0.05;
  /// Largest age of the answered pose [s]. A feedback that answers an older pose is stale even if it has just arrived:
  /// poses no longer reach the server, so the model's anchor no longer follows the hand.
  double max_pose_age_s = 0.5;
  /// Upper bound on the model's own valid_for_s [s].
  double max_valid_for_s = 0.5;
  /// Usually DeviceInfo::max_stiffness_n_per_m. Stiffer tissue is scaled down to it, force and stiffness alike. If only
  /// the stiffness were scaled, the rest of the spring would come with the next feedback, which is late.
  double max_stiffness_n_per_m = 2000.0;
  /// Usually DeviceInfo::max_angular_stiffness_n_m_per_rad. See PointContact.
  double max_angular_stiffness_n_m_per_rad = 2.0;
  /// See SecantStiffness. Far above the resolution of common devices, far below the depth of a press.
  double min_secant_move_m = 2e-4;
};

/// Evaluates the server's local model at the device's position. The model changes only once in a simulation step:
///
///     F(p) = w (force_n − K (p − position_m))
///
/// K is the model's, raised along force_n to the stiffness that SecantStiffness estimates. The weight w is 1 while the
/// model is valid, then falls linearly to 0 in fade_s. A renewed model raises w at the same rate, so that the returning
/// force does not kick a hand that has sunk in. Contact pushes and never pulls: when the hand leaves the tissue between
/// two steps, the part of F along force_n is clamped at zero.
///
/// A step of a recovery (ToolFeedback.recovering) and the one after it may jump by more than tissue does. The hand then
/// goes in fade_s from the force F₀ that it felt last to that of the new model:
///
///     F = (1 − s) F₀ + s F(p)
///
/// A blade has a spring that slips instead of K (SlippingSpring). Its force is bounded, so only its stiffness is
/// bounded by max_stiffness_n_per_m, and SecantStiffness does not count.
///
/// The torque follows from the same model (PointContact). The jaws' load has none and is held. Both have the weight w
/// and fade like the force.
class ForceRenderer {
 public:
  explicit ForceRenderer(const ForceRendererOptions& options) : options_(options), secant_(options.min_secant_move_m) {}

  /// Replaces the model. `feedback` must have passed decode_feedback().
  void update(const Feedback& feedback);

  struct Output {
    Eigen::Vector3d force_n = Eigen::Vector3d::Zero();
    Eigen::Vector3d torque_n_m = Eigen::Vector3d::Zero();
    double jaw_torque_n_m = 0.0;
    /// w: 1 valid, 0 expired.
    double weight = 0.0;
    /// The model has expired.
    bool stale = false;
  };
  /// Force and torques at this place and `now_ns`, which become the ones that the hand felt last. Before the first
  /// update: zero, with weight 0.
  Output render(const Eigen::Vector3d& position_m, const Eigen::Quaterniond& orientation, std::int64_t now_ns);

 private:
  double weight(std::int64_t now_ns) const;
  Output of_model(const Eigen::Vector3d& position_m, const Eigen::Quaterniond& orientation, std::int64_t now_ns);

  ForceRendererOptions options_;
  SecantStiffness secant_;
  std::optional<Feedback> model_;
  PointContact contact_;
  SlippingSpring blade_;
  std::int64_t valid_until_ns_ = 0;
  // w when the newest model arrived. It rises from there.
  std::int64_t renewed_ns_ = 0;
  double weight_at_renewal_ = 1.0;
  Output felt_;
  // What the hand felt when the newest model of a recovery arrived. The fade starts there.
  std::optional<Output> before_recovery_;
  std::int64_t fade_from_ns_ = 0;
};

struct ForceLimits {
  double max_force_n = 3.0;
  double max_slew_n_per_s = 300.0;
};

/// Limits a force or a torque: first its change from `applied` to `max_change`, then its magnitude to `max`. Returns
/// zero at once if `wanted` is not finite or a limit is NaN. All have one unit.
Eigen::Vector3d limit(const Eigen::Vector3d& wanted, const Eigen::Vector3d& applied, double max_change, double max);

/// The same for a force: its change is at most max_slew_n_per_s · dt_s, its magnitude max_force_n.
Eigen::Vector3d limit_force(const Eigen::Vector3d& wanted_n, const Eigen::Vector3d& applied_n, double dt_s,
                            const ForceLimits& limits);

}  // namespace tensormass::haptic
