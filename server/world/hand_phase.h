#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <limits>

#include "world/tool.h"

namespace tensormass::world {

/// When a step may start ahead of its schedule, because the pose that it waits for has come. Used by the loop's thread
/// only.
///
/// Poses and steps have clocks of their own. A step that starts by its schedule finds a pose that has waited for half a
/// period of the step, on average. But the last pose that can come before the schedule is known as soon as it is there:
/// the next one would be too late. The step then starts at once, and its force leaves earlier by the time that the pose
/// would have waited.
///
///     poses            |       |       |       |            one each pose_period
///     by schedule      .   #####    .  .  #####
///     with the hand    #####   .       #####   .            '.': a pose waits, '#': a step
///
/// Steps keep their schedule (StepClock): none starts after its time, and none more than a period before. So
/// simulated time is ahead of real time by less than a step.
class HandPhase {
 public:
  /// step_period: of the scene's schedule
  explicit HandPhase(Clock::duration step_period) : step_period_(step_period) {}

  /// Notes the pose that the coming step uses, of the tool that leads. A client numbers its poses, so those that the
  /// loop did not see count as well.
  void take(const PoseStamp& stamp) {
    const std::uint64_t count = stamp.sequence - last_.sequence;
    const bool follows = stamp.client_id == last_.client_id && count >= 1 && count <= kMaxMissed &&
                         stamp.arrived > last_.arrived && stamp.arrived - last_.arrived < kForgotten;
    if (!follows) {
      pose_period_ = kUnknown;
    } else {
      const auto period = (stamp.arrived - last_.arrived) / static_cast<Clock::rep>(count);
      pose_period_ = pose_period_ == kUnknown ? period : pose_period_ + (period - pose_period_) / kSmoothing;
    }
    last_ = stamp;
  }

  /// From when on a pose may start the step that is scheduled for `begin`.
  Clock::time_point listen_from(Clock::time_point begin) const { return begin - reach(); }
  /// Whether a pose that arrived at `arrived` starts the step that is scheduled for `begin`: no step has used it, and
  /// no later one is expected before.
  bool starts(Clock::time_point arrived, Clock::time_point begin) const {
    return arrived > last_.arrived && begin - arrived <= reach();
  }

 private:
  static constexpr Clock::duration kUnknown = Clock::duration::max();
  /// A client whose numbers jump by more, or that was silent for so long, has a new rhythm.
  static constexpr std::uint64_t kMaxMissed = 1000;
  static constexpr Clock::duration kForgotten = std::chrono::milliseconds(500);
  /// A period is the mean of about so many.
  static constexpr Clock::rep kSmoothing = 8;
  /// Part of a period by which a pose may come early or late. A pose that is expected that closely before the schedule
  /// is not waited for.
  static constexpr Clock::rep kJitter = 8;

  /// Time before the schedule within which a pose is the last.
  Clock::duration reach() const {
    return pose_period_ == kUnknown ? step_period_ : std::min(step_period_, pose_period_ + pose_period_ / kJitter);
  }

  Clock::duration step_period_;
  Clock::duration pose_period_ = kUnknown;
  PoseStamp last_;  // that of the newest pose that a step used
};

}  // namespace tensormass::world
