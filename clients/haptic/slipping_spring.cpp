#include "haptic/slipping_spring.h"

#include <algorithm>

namespace tensormass::haptic {

void SlippingSpring::update(const Feedback& feedback, double max_stiffness_n_per_m) {
  spring_ = feedback.yielding;
  spring_.stiffness_n_per_m = std::min(spring_.stiffness_n_per_m, max_stiffness_n_per_m);
  position_m_ = feedback.position_m;
  start_n_ = -feedback.force_n.dot(spring_.direction);
  slip_before_m_ = slip_at(feedback.client_time_ns);
}

Eigen::Vector3d SlippingSpring::change_n(const Eigen::Vector3d& position_m, std::int64_t now_ns) {
  const double k = spring_.stiffness_n_per_m, limit_n = spring_.limit_n;
  if (!(k > 0.0 && limit_n > 0.0)) return Eigen::Vector3d::Zero();
  const double x = (position_m - position_m_).dot(spring_.direction);
  const double wanted_n = start_n_ + k * (x - (slip_m_ - slip_before_m_));
  slip_m_ += std::max(wanted_n - limit_n, 0.0) / k;
  marks_[mark_count_++ % kMarks] = {now_ns, slip_m_};
  return (start_n_ - std::clamp(wanted_n, 0.0, limit_n)) * spring_.direction;
}

double SlippingSpring::slip_at(std::int64_t time_ns) const {
  const std::size_t oldest = mark_count_ > kMarks ? mark_count_ - kMarks : 0;
  for (std::size_t i = mark_count_; i > oldest; --i) {
    const Mark& mark = marks_[(i - 1) % kMarks];
    if (mark.time_ns <= time_ns || i - 1 == oldest) return mark.slip_m;
  }
  return slip_m_;
}

}  // namespace tensormass::haptic
