#include "haptic/force_renderer.h"

#include <algorithm>

#include "haptic/clock.h"

namespace tensormass::haptic {
namespace {

Eigen::Vector3d shortened_to(const Eigen::Vector3d& v, double length) {
  const double norm = v.norm();
  return norm <= length ? v : Eigen::Vector3d(v * (length / norm));
}

}  // namespace

void ForceRenderer::update(const Feedback& feedback) {
  // The first model starts at once: limit_force() raises its force from zero.
  weight_at_renewal_ = model_ ? weight(feedback.arrival_ns) : 1.0;
  // Each step of a recovery may jump, and so may the first step after it.
  const bool may_jump = model_ && (feedback.recovering || model_->recovering);
  if (may_jump) {
    before_recovery_ = felt_;
    fade_from_ns_ = feedback.arrival_ns;
  }
  renewed_ns_ = feedback.arrival_ns;
  model_ = feedback;
  double& largest = model_->largest_stiffness_n_per_m;
  blade_.update(feedback, options_.max_stiffness_n_per_m);
  const bool yields = feedback.yielding.limit_n > 0.0;
  if (const double raised = yields ? 0.0 : secant_.update(feedback) - largest; raised > 0.0) {
    // No eigenvalue exceeds the secant, because the addition has rank one.
    const Eigen::Vector3d direction = feedback.force_n.normalized();
    model_->stiffness_n_per_m += raised * direction * direction.transpose();
    largest += raised;
  }
  if (largest > options_.max_stiffness_n_per_m) {
    const double scale = options_.max_stiffness_n_per_m / largest;
    model_->force_n *= scale;
    model_->torque_n_m *= scale;
    model_->stiffness_n_per_m *= scale;
    largest = options_.max_stiffness_n_per_m;
  }
  contact_ = PointContact(*model_, options_.max_angular_stiffness_n_m_per_rad);
  const double valid_for_s = std::min(feedback.valid_for_s, options_.max_valid_for_s);
  valid_until_ns_ = std::min(feedback.arrival_ns + static_cast<std::int64_t>(valid_for_s * kNsPerS),
                             feedback.client_time_ns + static_cast<std::int64_t>(options_.max_pose_age_s * kNsPerS));
}

double ForceRenderer::weight(std::int64_t now_ns) const {
  const double stale_s = static_cast<double>(now_ns - valid_until_ns_) / kNsPerS;
  const double falling = stale_s <= 0.0 ? 1.0 : std::max(0.0, 1.0 - stale_s / options_.fade_s);
  // A model may arrive after the tick has read the clock.
  const double renewed_s = static_cast<double>(std::max<std::int64_t>(now_ns - renewed_ns_, 0)) / kNsPerS;
  const double rising = weight_at_renewal_ + renewed_s / options_.fade_s;
  return std::min(falling, rising);
}

ForceRenderer::Output ForceRenderer::render(const Eigen::Vector3d& position_m, const Eigen::Quaterniond& orientation,
                                            std::int64_t now_ns) {
  if (!model_) return {};
  felt_ = of_model(position_m, orientation, now_ns);
  if (!before_recovery_) return felt_;
  const double s = static_cast<double>(std::max<std::int64_t>(now_ns - fade_from_ns_, 0)) / kNsPerS / options_.fade_s;
  if (s >= 1.0) {
    before_recovery_.reset();
    return felt_;
  }
  const Output& before = *before_recovery_;
  felt_.force_n = (1.0 - s) * before.force_n + s * felt_.force_n;
  felt_.torque_n_m = (1.0 - s) * before.torque_n_m + s * felt_.torque_n_m;
  felt_.jaw_torque_n_m = (1.0 - s) * before.jaw_torque_n_m + s * felt_.jaw_torque_n_m;
  return felt_;
}

/// Force and torques of the newest model.
ForceRenderer::Output ForceRenderer::of_model(const Eigen::Vector3d& position_m, const Eigen::Quaterniond& orientation,
                                              std::int64_t now_ns) {
  const double w = weight(now_ns);
  Eigen::Vector3d force = model_->force_n - model_->stiffness_n_per_m * (position_m - model_->position_m);
  force += blade_.change_n(position_m, now_ns);
  // Without a contact force there is no direction to clamp.
  if (const double norm = model_->force_n.norm(); norm > 0.0) {
    const Eigen::Vector3d direction = model_->force_n / norm;
    force -= std::min(0.0, force.dot(direction)) * direction;
  }
  return {w * force, w * contact_.torque_n_m(force, orientation), w * model_->jaw_torque_n_m, w,
          now_ns > valid_until_ns_};
}

Eigen::Vector3d limit(const Eigen::Vector3d& wanted, const Eigen::Vector3d& applied, double max_change, double max) {
  if (!wanted.allFinite()) return Eigen::Vector3d::Zero();
  const Eigen::Vector3d change = shortened_to(wanted - applied, max_change);
  const Eigen::Vector3d limited = shortened_to(applied + change, max);
  return limited.allFinite() ? limited : Eigen::Vector3d::Zero();
}

Eigen::Vector3d limit_force(const Eigen::Vector3d& wanted_n, const Eigen::Vector3d& applied_n, double dt_s,
                            const ForceLimits& limits) {
  return limit(wanted_n, applied_n, limits.max_slew_n_per_s * dt_s, limits.max_force_n);
}

}  // namespace tensormass::haptic
