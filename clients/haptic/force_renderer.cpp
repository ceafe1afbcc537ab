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
  model_ = feedback;
  if (feedback.largest_stiffness_n_per_m > options_.max_stiffness_n_per_m) {
    model_->stiffness_n_per_m *= options_.max_stiffness_n_per_m / feedback.largest_stiffness_n_per_m;
  }
  const double valid_for_s = std::min(feedback.valid_for_s, options_.max_valid_for_s);
  valid_until_ns_ = std::min(feedback.arrival_ns + static_cast<std::int64_t>(valid_for_s * kNsPerS),
                             feedback.client_time_ns + static_cast<std::int64_t>(options_.max_pose_age_s * kNsPerS));
}

ForceRenderer::Output ForceRenderer::render(const Eigen::Vector3d& position_m, std::int64_t now_ns) const {
  if (!model_) return {};
  const double stale_s = static_cast<double>(now_ns - valid_until_ns_) / kNsPerS;
  const double weight = stale_s <= 0.0 ? 1.0 : std::max(0.0, 1.0 - stale_s / options_.fade_s);
  Eigen::Vector3d force = model_->force_n - model_->stiffness_n_per_m * (position_m - model_->position_m);
  // Without a contact force there is no direction to clamp.
  if (const double norm = model_->force_n.norm(); norm > 0.0) {
    const Eigen::Vector3d direction = model_->force_n / norm;
    force -= std::min(0.0, force.dot(direction)) * direction;
  }
  return {weight * force, weight};
}

Eigen::Vector3d limit_force(const Eigen::Vector3d& wanted_n, const Eigen::Vector3d& applied_n, double dt_s,
                            const ForceLimits& limits) {
  if (!wanted_n.allFinite()) return Eigen::Vector3d::Zero();
  const Eigen::Vector3d change = shortened_to(wanted_n - applied_n, limits.max_slew_n_per_s * dt_s);
  const Eigen::Vector3d limited = shortened_to(applied_n + change, limits.max_force_n);
  return limited.allFinite() ? limited : Eigen::Vector3d::Zero();
}

}  // namespace tensormass::haptic
