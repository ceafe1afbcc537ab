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
///   otherwise                                                    one fewer
///
/// The coarse level stays on for so long because a solve without it may leave a step unsolved. A scene that comes to
/// rest for a moment must not lose it.
class CoarseSwitch {
 public:
  /// left: solves for which it stays on.
  explicit CoarseSwitch(std::uint32_t left = 0) : left_(std::min(left, kHeld)) {}

  /// Says whether the next solve has a coarse level.
  bool is_on(const model::Settings& settings) const {
    return settings.coarse_use == model::CoarseUse::kAlways ||
           (settings.coarse_use == model::CoarseUse::kAutomatic && left_ > 0);
  }
  /// Takes the iterations of a solve. was_on: it had a coarse level.
  void take_solve(std::uint32_t iterations, bool was_on) {
    if (iterations > (was_on ? kFewIterations : model::kCoarseFromIterations)) {
      left_ = kHeld;
    } else if (left_ > 0) {
      --left_;
    }
  }
  /// Returns whether a step must be made again because it ended above its tolerance, and the next solve has a coarse
  /// level. So no step is published unsolved only because the last one did not need the coarse level.
  /// was_on: the step's solve had one.
  bool repeats(const model::Settings& settings, const solver::StepResult& result, bool was_on) const {
    return !was_on && is_on(settings) && result.finite && !result.negative_curvature &&
           result.cg_relative_residual > settings.cg_tolerance;
  }
  std::uint32_t left() const { return left_; }

 private:
  static constexpr std::uint32_t kHeld = 256, kFewIterations = 8;
  std::uint32_t left_;
};

}  // namespace tensormass::backend
