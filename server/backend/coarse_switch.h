#pragma once

#include <algorithm>
#include <cstdint>

#include "model/settings.h"
#include "solver/step_result.h"

/// Decides which solves of a scene have a coarse level (solver/coarse_level.h).
namespace tensormass::backend {

/// Follows the iterations of a scene's solves. It depends on nothing else, so a replay decides alike.
///
///   a plain solve took more than model::kCoarseFromIterations    the coarse level is on for the next kHeld solves
///   a solve with it took more than kFewIterations                again for the next kHeld
///   a solve with it failed                                       it is off for the next kHeld, whatever they take
///   otherwise                                                    one fewer
///
/// The coarse level stays on for so long because a solve without it may leave a step unsolved. A scene that comes to
/// rest for a moment must not lose it.
class CoarseSwitch {
 public:
  /// left: of another one.
  explicit CoarseSwitch(std::uint32_t left = 0) : left_(std::min(left, 2 * kHeld)) {}

  /// Says whether the next solve has a coarse level.
  bool is_on(const model::Settings& settings) const {
    return settings.coarse_use == model::CoarseUse::kAlways ||
           (settings.coarse_use == model::CoarseUse::kAutomatic && left_ > 0 && left_ <= kHeld);
  }
  /// Takes the iterations of a solve. was_on: it had a coarse level.
  void take_solve(std::uint32_t iterations, bool was_on) {
    if (left_ > kHeld) {
      if (--left_ == kHeld) left_ = 0;
    } else if (iterations > (was_on ? kFewIterations : model::kCoarseFromIterations)) {
      left_ = kHeld;
    } else if (left_ > 0) {
      --left_;
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
    left_ = 2 * kHeld;
    return true;
  }
  /// Solves for which it stays on; beyond kHeld: kHeld more than those for which it stays off.
  std::uint32_t left() const { return left_; }

 private:
  static constexpr std::uint32_t kHeld = 256, kFewIterations = 8;
  std::uint32_t left_;
};

}  // namespace tensormass::backend
