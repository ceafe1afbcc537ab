#pragma once

// The haptic loop: a force every millisecond from a simulation that steps at 60 Hz or so on another machine.
//
//      hand                        this client, 1 kHz                          server, 60 Hz or so
//
//     +--------+  pose   +-------+  pose, 1 kHz    +------+   bus   +------------------------------+
//     | device |-------->| tick  |---------------->| Link |========>| takes the newest pose,       |
//     |        |         |       |                 |      |         | steps, publishes feedback:   |
//     |        |         |       |<----------------|      |<========| force F0, stiffness K at p0  |
//     +--------+         +-------+  newest feedback+------+   bus   +------------------------------+
//         ^                  |      once a step
//         |                  | pose p of this tick
//         |                  v
//         |         local model F0 − K (p − p0)      force_renderer.h
//         |                  v
//         |         passivity controller             passivity_controller.h
//         |                  v
//         |         limits of slew and magnitude     force_renderer.h
//         |   force, 1 kHz   v
//         +------------ ForceGuard                   force_guard.h (50 ms watchdog)
//
// Reasons:
// 1. A force that is itself transmitted is late by a step and the network, and a late spring is unstable. The tick
//    therefore evaluates the local model at its own pose. The network only renews the model.
// 2. Nothing in a tick waits for the network, so its jitter does not reach the hand.
// 3. The model jumps once a step and its anchor is late, so it can return more energy than the hand gave. The
//    passivity controller behind it dissipates the excess.
// 4. Torque and jaws' load take the same way beside the force, small and slow (torque_channel.h), and only to a device
//    that has them. The torque's local model is that of one point of contact (point_contact.h).
//
// 5. The device's button works the power of a tool with Tool.cautery, safely (power_switch.h). The loop's last pose has
//    no power, whatever ends the loop.
//
// Units: m, N, N m, s; ns on the Clock. Threading: run() blocks the thread that calls it. Other threads may only set
// `stop`. Only a failing device is an error. Without a server the model expires and the force fades to zero.

#include <atomic>
#include <cstdint>
#include <limits>
#include <optional>

#include "haptic/clock.h"
#include "haptic/device.h"
#include "haptic/force_guard.h"
#include "haptic/force_renderer.h"
#include "haptic/hand_motion.h"
#include "haptic/histogram.h"
#include "haptic/latency_tracker.h"
#include "haptic/link.h"
#include "haptic/passivity_controller.h"
#include "haptic/power_switch.h"
#include "haptic/torque_channel.h"

namespace tensormass::haptic {

/// Number of consecutive invalid poses after which the loop ends: 0.1 s at 1 kHz.
inline constexpr std::uint64_t kMaxInvalidPosesInARow = 100;

struct LoopOptions {
  double rate_hz = 1000.0;
  double duration_s = std::numeric_limits<double>::infinity();
  /// How long to wait for the echo of the last pose after the end [s]. The force is already zero then.
  double drain_s = 1.0;
  /// Tells this client's poses from others. 0: chosen at random for each loop.
  std::uint64_t client_id = 0;
  /// Known to this client and the server alone, so that no other client can use up its sequences or move the tool. 0:
  /// chosen at random for each loop.
  std::uint64_t session = 0;
  ForceRendererOptions renderer;
  ForceLimits limits;
  PassivityOptions passivity;
  /// Torque on the hand and on its jaws. A device that states none gets none.
  TorqueOptions torque;
  TorqueOptions jaws;
  /// ToolPose.level while DevicePose::pressed, 0 to 1. Above 0 only for a tool with Tool.cautery.
  double power_level = 0.0;
  /// Counts recoveries while the loop runs, for another thread that tells people; null: nobody asks. Must outlive the
  /// loop, which itself never writes to a terminal, because that may block.
  std::atomic<std::uint64_t>* recoveries = nullptr;
  /// Gets the id of another client that claims the tool, in the same way.
  std::atomic<std::uint64_t>* claimed_by = nullptr;
  /// Says whether the scene has the tool no more, in the same way. The loop goes on: the tool may be added again.
  std::atomic<bool>* removed = nullptr;
};

struct LoopReport {
  double seconds = 0.0;
  std::uint64_t ticks = 0;
  /// Deadlines that passed while an earlier tick was late. They are skipped.
  std::uint64_t missed_ticks = 0;
  /// Poses that the transport took at once.
  std::uint64_t poses_sent = 0;
  /// Poses that the transport did not take at once. The newest of them is sent when the server is back.
  std::uint64_t poses_not_taken = 0;
  /// Invalid poses of the device (see DevicePose): each costs a tick without force and is not sent.
  std::uint64_t poses_invalid = 0;
  std::uint64_t last_sequence_sent = 0;
  std::uint64_t last_sequence_echoed = 0;
  std::uint64_t feedback_received = 0;
  /// Steps whose feedback was replaced by a newer one on the way.
  std::uint64_t feedback_dropped = 0;
  /// Answers to another client's poses or to no pose. They are not rendered.
  std::uint64_t feedback_foreign = 0;
  /// Those of them in which the other client claims the tool, so that the server refuses this client's poses.
  std::uint64_t feedback_claimed = 0;
  /// Messages that could not be decoded.
  std::uint64_t feedback_malformed = 0;
  /// Ticks after the first feedback whose local model had expired, and how often such a period started.
  std::uint64_t stale_ticks = 0;
  std::uint64_t stale_episodes = 0;
  /// Feedbacks of recoveries (ToolFeedback.recovering), and how often such a period started.
  std::uint64_t recovering_feedbacks = 0;
  std::uint64_t recoveries = 0;
  std::uint64_t watchdog_trips = 0;
  /// Poses that asked for power.
  std::uint64_t poses_with_power = 0;
  double max_force_n = 0.0;
  /// Lowest energy that the passivity observer counted [J]. 0 if the virtual tissue was always passive.
  double min_energy_j = 0.0;
  /// Largest torque on the hand and on its jaws. Absent for a device that has none.
  std::optional<double> max_torque_n_m;
  std::optional<double> max_jaw_torque_n_m;
  /// Poses whose round trip was not timed; see LatencyTracker::forgotten().
  std::uint64_t poses_forgotten = 0;
  /// From sending a pose to the first feedback that answers it or a newer one.
  Histogram round_trip;
  /// Age of the answered pose when its feedback arrives.
  Histogram answered_pose_age;
  /// Parts of that age, for the first feedback that answers a pose. The server measures the first three; the transport
  /// is the rest, both ways.
  Histogram pose_wait;
  Histogram step_time;
  Histogram publication;
  Histogram transport;
  /// From the deadline of a tick to its wake-up.
  Histogram wake_up_lateness;
  /// From wake-up to the written force.
  Histogram tick_duration;
};

/// Runs one tick per period of a monotonic clock:
///
///     read the device -> send the pose -> take the newest feedback -> local model -> passivity -> limits -> write
///
/// An invalid pose (see DevicePose) sets the force to zero for its tick. It is not sent. The passivity controllers do
/// not get it either, because it would spoil the energy count for good. The next valid pose continues from there.
class Loop {
 public:
  /// All arguments except the options must outlive the loop, and the device must be open. DeviceInfo bounds the
  /// options.
  Loop(ForceGuard& guard, Link& link, Clock& clock, const LoopOptions& options);

  /// Runs for duration_s or until `stop`, then releases the guard (zero force) and waits for the last echo. Call once.
  /// Returns the device's error if a read or a write fails, or after kMaxInvalidPosesInARow.
  Result<LoopReport> run(const std::atomic<bool>& stop);

 private:
  Result<void> tick();
  /// A tick with an invalid pose: zero force, nothing sent.
  Result<void> tick_without(const DevicePose& invalid);
  void send(const DevicePose& pose, double level);
  /// Sends the last pose once more, without power, if it had power.
  void take_power_off();
  /// Force and torques for this pose, passive and within their limits.
  Wrench wrench_at(const DevicePose& pose, const ForceRenderer::Output& rendered);
  void report(const Wrench& wrench);
  void receive();
  void count_recovery(bool recovering);
  /// Waits for the echo of the last pose, for at most drain_s.
  void drain(const std::atomic<bool>& stop);

  ForceGuard& guard_;
  Link& link_;
  Clock& clock_;
  LoopOptions options_;
  double period_s_;
  ForceRenderer renderer_;
  PassivityController passivity_;
  TorqueChannel torque_;
  TorqueChannel jaws_;
  std::optional<DevicePose> last_pose_;
  PowerSwitch power_;
  double last_level_ = 0.0;
  /// The newest answer was one to this client's pose, and it is fresh.
  bool ours_ = false;
  LatencyTracker latency_;
  LoopReport report_;
  std::uint64_t last_step_ = 0;
  bool was_stale_ = false;
  bool was_recovering_ = false;
  std::uint64_t invalid_in_a_row_ = 0;
};

}  // namespace tensormass::haptic
