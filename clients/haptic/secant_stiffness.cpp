#include "haptic/secant_stiffness.h"

#include <algorithm>
#include <cmath>

#include "haptic/clock.h"

namespace tensormass::haptic {
namespace {

// Feedbacks further apart are not compared: tissue relaxes in between, and the change of force would be taken for
// stiffness.
constexpr auto kMaxAgeNs = static_cast<std::int64_t>(0.2 * kNsPerS);
constexpr auto kForgetNs = static_cast<std::int64_t>(1.0 * kNsPerS);
// Weight of a new pair. Averages the noise of an iterative solver, and follows stiffening tissue within a few pairs.
constexpr double kGain = 0.5;

}  // namespace

double SecantStiffness::update(const Feedback& feedback) {
  const std::int64_t now_ns = feedback.client_time_ns;
  if (now_ns - last_contact_ns_ > kForgetNs) estimate_n_per_m_ = 0.0;
  const double force_n = feedback.force_n.norm();
  if (force_n == 0.0) {
    first_.reset();
    return 0.0;
  }
  last_contact_ns_ = now_ns;
  // A force that jumps in a recovery says nothing about the tissue.
  if (feedback.recovering) {
    first_.reset();
    return estimate_n_per_m_;
  }
  const Point second{feedback.position_m, feedback.force_n, now_ns};
  if (!first_ || now_ns - first_->client_time_ns > kMaxAgeNs) {
    first_ = second;
    return estimate_n_per_m_;
  }
  const Eigen::Vector3d direction = feedback.force_n / force_n;
  const double moved_m = (second.position_m - first_->position_m).dot(direction);
  if (std::abs(moved_m) >= min_move_m_) {
    const double secant = -(second.force_n - first_->force_n).dot(direction) / moved_m;
    estimate_n_per_m_ += kGain * (std::max(0.0, secant) - estimate_n_per_m_);
    first_ = second;
  }
  return estimate_n_per_m_;
}

}  // namespace tensormass::haptic
