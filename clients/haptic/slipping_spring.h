#pragma once

// What holds a blade along the direction in which it cuts: a spring whose end slips at a limit. Pure, no thread,
// nothing fails.
//
// The server's local model of a scalpel is
//
//     F(p) = force_n − (f − f₀) c        f  = min(max(f₀ + k (x − s), 0), limit)
//                                        f₀ = −force_n · c,   x = (p − position_m) · c
//
// The slip s grows while f would exceed the limit, by as much as keeps f there. It never falls. So the spring takes
// energy and gives none, like Coulomb's friction, whatever the hand does between two feedbacks.
//
// A feedback answers a pose of the past. The end has slipped since then, by what the total S grew: s = S − S(then).
//
// Symbols: p position of the device [m], c direction [unit vector], k stiffness [N/m], s slip [m], S total slip [m], F
// force on the tool [N].

#include <array>
#include <cstddef>
#include <cstdint>

#include <Eigen/Core>

#include "haptic/feedback.h"

namespace tensormass::haptic {

class SlippingSpring {
 public:
  /// Takes the spring of a feedback. max_stiffness_n_per_m: bound of k.
  void update(const Feedback& feedback, double max_stiffness_n_per_m);

  /// Returns −(f − f₀) c at a place of the hand, and lets the end slip. Zero if nothing holds.
  Eigen::Vector3d change_n(const Eigen::Vector3d& position_m, std::int64_t now_ns);

 private:
  /// Returns the total slip at a time, or the oldest that is remembered [m].
  double slip_at(std::int64_t time_ns) const;

  /// Feedback that answers an older pose is stale (ForceRendererOptions::max_pose_age_s): half a second at 1 kHz.
  static constexpr std::size_t kMarks = 512;
  struct Mark {
    std::int64_t time_ns;
    double slip_m;  // total up to that time
  };

  YieldingModel spring_;
  Eigen::Vector3d position_m_ = Eigen::Vector3d::Zero();
  double start_n_ = 0.0;        // f₀
  double slip_before_m_ = 0.0;  // S when the pose was sent that the feedback answers
  double slip_m_ = 0.0;         // S now
  std::array<Mark, kMarks> marks_{};
  std::size_t mark_count_ = 0;  // written so far; the newest is at (mark_count_ − 1) mod kMarks
};

}  // namespace tensormass::haptic
