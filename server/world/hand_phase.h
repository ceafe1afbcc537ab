#pragma once

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <limits>

#include "world/tool.h"

namespace tensormass::world {

/// The phase of steps beside a hand: when a step may start ahead of its schedule, because the pose that it waits for
/// has come. Used by the loop's thread only.
///
/// Poses and steps have clocks of their own. A step that starts by its schedule finds a pose that has waited for half a
/// period of the step, on average. So steps are locked to poses: each starts as soon as the pose is there that is
/// expected to be the last one before its schedule, and its force leaves earlier by the time that the pose would have
/// waited.
///
///     poses            |       |       |       |            one each pose_period
///     by schedule      .   #####    .  .  #####
///     with the hand    #####   .       #####   .            '.': a pose waits, '#': a step
///
///     lead of a step   ├── margin ──┼────── pose_period or period ──────┤
///                      0: schedule                                      reach: from here on a pose starts the step
///
/// 1. Leads are between a margin and the margin plus a period. A pose that is expected within the margin before the
///    schedule might come after it: the step would have started without it, and the pose would wait for that step and
///    the next. So the pose before it starts the step. Poses that come as irregularly as the margin is wide keep the
///    lock, at equal rates too.
/// 2. The schedule itself (StepClock) never moves, so the mean rate, missed deadlines and simulated time stay as they
///    are. No step starts after its time, and nothing waits for a pose.
/// 3. No step starts more than 1 + 1 / kMarginParts periods before its time, whatever a client sends. Simulated time is
///    ahead of real time by that much at most.
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
  /// Notes by how much a step starts ahead of its schedule; below zero: after it.
  void take_lead(Clock::duration lead) { lead_ += (lead - lead_) / kSmoothing; }

  /// From when on a pose may start the step that is scheduled for `begin`.
  Clock::time_point listen_from(Clock::time_point begin) const { return begin - reach(); }
  /// Whether a pose that arrived at `arrived` starts the step that is scheduled for `begin`: no step has used it, and
  /// the next one is expected within the margin or later.
  bool starts(Clock::time_point arrived, Clock::time_point begin) const {
    return arrived > last_.arrived && begin - arrived <= reach();
  }

  /// Mean period of the last poses; zero: not known.
  Clock::duration pose_period() const { return pose_period_ == kUnknown ? Clock::duration::zero() : pose_period_; }
  /// Mean lead of the last steps.
  Clock::duration lead() const { return lead_; }

  /// Share of the shorter period, of poses or of steps, by which a pose may come early or late.
  static constexpr Clock::rep kMarginParts = 4;

 private:
  static constexpr Clock::duration kUnknown = Clock::duration::max();
  /// A client whose numbers jump by more, or that was silent for so long, has a new rhythm.
  static constexpr std::uint64_t kMaxMissed = 1000;
  static constexpr Clock::duration kForgotten = std::chrono::milliseconds(500);
  /// A mean is of about so many.
  static constexpr Clock::rep kSmoothing = 8;

  /// Time before the schedule within which a pose starts the step.
  Clock::duration reach() const {
    if (pose_period_ == kUnknown) return step_period_;
    const Clock::duration period = std::min(step_period_, pose_period_);
    return period + period / kMarginParts;
  }

  Clock::duration step_period_;
  Clock::duration pose_period_ = kUnknown;
  Clock::duration lead_{};
  PoseStamp last_;  // that of the newest pose that a step used
};

}  // namespace tensormass::world
