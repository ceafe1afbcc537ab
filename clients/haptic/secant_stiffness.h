#pragma once

// Stiffness of the tissue as successive feedbacks show it. Pure, no thread, nothing fails.
//
// The server's local model has Hertz's tangent of a half space, which is too soft for a thin or clamped organ. The rest
// of the stiffness then reaches the hand only with the next step's force: late, and a late spring feeds energy. Two
// feedbacks of one press tell the stiffness between them:
//
//     K_s = −(F₂ − F₁) · n / ((p₂ − p₁) · n)          n = F₂ / |F₂|
//
// Symbols: p tool position [m], F force on the tool [N], n its direction, K_s secant stiffness [N/m].

#include <cstdint>
#include <optional>

#include <Eigen/Core>

#include "haptic/feedback.h"

namespace tensormass::haptic {

/// Estimates the stiffness along the force. The estimate stays while the hand rests, and for a second without contact,
/// so that a tool that bounces keeps it. Later contact may be elsewhere and starts from zero. Feedback of a
/// recovery is not compared.
class SecantStiffness {
 public:
  /// `min_move_m`: shortest way along the force between two feedbacks that are compared [m]. Must be positive; infinity
  /// switches the estimate off.
  explicit SecantStiffness(double min_move_m) : min_move_m_(min_move_m) {}

  /// Takes a feedback and returns the estimate [N/m], which is not negative. Returns zero without contact and before
  /// the first pair.
  double update(const Feedback& feedback);

 private:
  struct Point {
    Eigen::Vector3d position_m;
    Eigen::Vector3d force_n;
    std::int64_t client_time_ns;
  };

  double min_move_m_;
  std::optional<Point> first_;
  std::int64_t last_contact_ns_ = 0;
  double estimate_n_per_m_ = 0.0;
};

}  // namespace tensormass::haptic
