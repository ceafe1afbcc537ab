#pragma once

#include <algorithm>
#include <cstdint>

#include "model/settings.h"
#include "solver/step_result.h"

/// Decides which solves of a scene have a coarse level (solver/coarse_level.h).
namespace tensormass::backend {

/// Which plain solves of more than model::kCoarseFromIterations would have been better with a coarse level: those of
/// more than `iterations`, and those that ended at their limit with a relative error above `error` in the energy norm.
struct CoarsePrice {
  std::uint32_t iterations;
  double error;
};
/// The price where a solve runs by stages: by a count of operations the coarse level costs a CPU as much as about 30
/// iterations.
inline constexpr CoarsePrice kCoarseByStages{model::kCoarseFromIterations, 0};
/// The price where a GPU has a fused solve: on an H200 a step with the coarse level takes 0.6 to 2.8 ms, as long as 450
/// to 900 iterations (tests/bench/bodies.py).
inline constexpr CoarsePrice kCoarseBesideFused{512, 0.3};

/// Follows the iterations of a scene's solves. It depends on nothing else, so a replay decides alike.
///
///   a plain solve took long (CoarsePrice)                       the coarse level is on for the next kFirstHeld solves
///   these are over                                              a plain solve tries whether it is still needed
///   that took as many again                                     it is on for twice as many, up to kFirstHeld · 2^kMost
///   a solve with it failed                                      it is off for the next kBarred, whatever they take
///
/// Only a plain solve tells what solves would take without it. A soft organ that falls at first, or that a fast hand
/// stirs, must not pay for it for ever. A ligament always needs it, and pays ever less for the trials.
class CoarseSwitch {
 public:
  /// state: of another one.
  explicit CoarseSwitch(std::uint32_t state = 0)
      : left_(std::min(state & kLeftBits, kFirstHeld << kMost)),
        doublings_(std::min(state >> kDoublingsAt & 0xFF, kMost)),
        is_barred_((state >> kBarredAt & 1) != 0 && left_ > 0) {}

  /// Says whether the next solve has a coarse level.
  bool is_on(const model::Settings& settings) const {
    return settings.coarse_use == model::CoarseUse::kAlways ||
           (settings.coarse_use == model::CoarseUse::kAutomatic && left_ > 0 && !is_barred_);
  }
  /// Takes a solve. error: solver::missing_share
  void take_solve(std::uint32_t iterations, double error, const CoarsePrice& price) {
    const bool took_long =
        iterations > model::kCoarseFromIterations && (iterations > price.iterations || error > price.error);
    if (left_ > 0) {
      if (--left_ == 0) is_barred_ = false;
    } else if (took_long) {
      left_ = kFirstHeld << doublings_;
      doublings_ = std::min(doublings_ + 1, kMost);
    } else {
      doublings_ = 0;
    }
  }
  /// Returns whether a step must be made again, by a solve with a coarse level or without. was_on: its solve had one.
  ///
  /// 1. It ended above its tolerance, and the next solve has a coarse level. So no step is published unsolved only
  ///    because the last one did not need it.
  /// 2. It failed with a coarse level that turned on by itself: a scene that holds without one must not stop with it.
  bool repeats(const model::Settings& settings, const solver::StepResult& result, bool was_on) {
    const bool above = result.cg_relative_residual > settings.cg_tolerance;
    if (!was_on) return is_on(settings) && result.finite && !result.negative_curvature && above;
    const bool failed = !result.finite || result.cg_relative_residual > 1 || (result.negative_curvature && above);
    if (!failed || settings.coarse_use != model::CoarseUse::kAutomatic) return false;
    left_ = kBarred;
    is_barred_ = true;
    return true;
  }
  /// Returns what another one goes on from.
  std::uint32_t state() const {
    return left_ | doublings_ << kDoublingsAt | static_cast<std::uint32_t>(is_barred_) << kBarredAt;
  }

 private:
  static constexpr std::uint32_t kFirstHeld = 64, kMost = 6, kBarred = 256;
  static constexpr std::uint32_t kLeftBits = 0xFFFF, kDoublingsAt = 16, kBarredAt = 24;

  std::uint32_t left_;       // solves for which it stays on, or off if it is barred
  std::uint32_t doublings_;  // trials on end that took many iterations
  bool is_barred_;
};

}  // namespace tensormass::backend
