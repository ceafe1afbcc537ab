#pragma once

#include <atomic>
#include <cstdint>
#include <limits>

#include "haptic/clock.h"
#include "haptic/device.h"
#include "haptic/force_guard.h"
#include "haptic/force_renderer.h"
#include "haptic/histogram.h"
#include "haptic/latency_tracker.h"
#include "haptic/link.h"
#include "haptic/passivity_controller.h"

namespace tensormass::haptic {

/// Invalid poses of a device in a row, after which the loop ends: a tenth of a second at 1 kHz.
inline constexpr std::uint64_t kMaxInvalidPosesInARow = 100;

struct LoopOptions {
  double rate_hz = 1000.0;
  double duration_s = std::numeric_limits<double>::infinity();
  /// After the end, with the force already at zero: how long to wait for the echo of the last pose.
  double drain_s = 1.0;
  /// 0: at random, one for each loop.
  std::uint64_t client_id = 0;
  ForceRendererOptions renderer;
  ForceLimits limits;
  PassivityOptions passivity;
};

struct LoopReport {
  double seconds = 0.0;
  std::uint64_t ticks = 0;
  /// Deadlines that passed while an earlier tick was late; they are skipped, not made up for.
  std::uint64_t missed_ticks = 0;
  /// Those that the transport took at once.
  std::uint64_t poses_sent = 0;
  /// Those that it did not; the newest of them goes when the server is back.
  std::uint64_t poses_not_taken = 0;
  /// Poses of the device that are none (see DevicePose), each with a tick without force; never sent.
  std::uint64_t poses_invalid = 0;
  std::uint64_t last_sequence_sent = 0;
  std::uint64_t last_sequence_echoed = 0;
  std::uint64_t feedback_received = 0;
  /// Steps whose feedback a newer one replaced on the way.
  std::uint64_t feedback_dropped = 0;
  /// Answers to another client's poses, or to none; not rendered.
  std::uint64_t feedback_foreign = 0;
  std::uint64_t feedback_malformed = 0;
  /// Ticks after the first feedback whose local model had run out, and how often that began.
  std::uint64_t stale_ticks = 0;
  std::uint64_t stale_episodes = 0;
  std::uint64_t watchdog_trips = 0;
  double max_force_n = 0.0;
  /// Most negative energy that the passivity observer saw; 0 if the tissue was passive throughout.
  double min_energy_j = 0.0;
  /// Poses whose round trip could not be timed; see LatencyTracker.
  std::uint64_t poses_forgotten = 0;
  Histogram round_trip;
  /// Age of the pose that a feedback answers, when the feedback arrives.
  Histogram answered_pose_age;
  /// Wake-up after the deadline.
  Histogram wake_up_lateness;
  /// Wake-up to force written.
  Histogram tick_duration;
};

/// The haptic loop: at a fixed rate against a monotonic clock
///
///     read the device -> send the pose -> take the newest feedback -> local model -> passivity -> limits -> write
///
/// The force of a tick comes from the pose of the same tick; the network only renews the local model, so its jitter
/// never enters the loop. Nothing in a tick waits for the network.
///
/// A pose that is none (not finite, no rotation) takes the force off for its tick and goes nowhere: neither to the
/// server nor into the passivity controller, whose energy it would spoil for good. The next good one goes on from
/// there.
class Loop {
 public:
  /// All outlive the loop; the guard's device is open. What its DeviceInfo says binds whatever the options say.
  Loop(ForceGuard& guard, Link& link, Clock& clock, const LoopOptions& options);

  /// Runs for duration_s or until `stop`, releases the guard (zero force) and drains. The error is the device's.
  Result<LoopReport> run(const std::atomic<bool>& stop);

 private:
  Result<void> tick();
  Result<void> tick_without(const DevicePose& invalid);
  void receive();
  void drain(const std::atomic<bool>& stop);

  ForceGuard& guard_;
  Link& link_;
  Clock& clock_;
  LoopOptions options_;
  double period_s_;
  ForceRenderer renderer_;
  PassivityController passivity_;
  LatencyTracker latency_;
  LoopReport report_;
  std::uint64_t last_step_ = 0;
  bool was_stale_ = false;
  std::uint64_t invalid_in_a_row_ = 0;
};

}  // namespace tensormass::haptic
