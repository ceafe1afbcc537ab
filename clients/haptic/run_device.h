#pragma once

#include <atomic>

#include "core/result.h"
#include "haptic/device.h"
#include "haptic/link.h"
#include "haptic/loop.h"

namespace tensormass::haptic {

/// A force that the loop has not renewed for this long [s] is set to zero.
inline constexpr double kWatchdogTimeoutS = 0.05;

/// Runs `device` on the tool at the other end of `link`: opens it, runs a Loop under a Watchdog and closes it.
///
/// The calling thread becomes the loop's thread, under SCHED_FIFO if the machine allows it. Call request_realtime()
/// before to hear why it does not. Returns after options.duration_s or soon after `stop` is set.
///
/// `watchdog_timeout_s` must be at least two periods of the loop. Fails if the device does not open, a read or a write
/// fails, or its poses stay invalid (kMaxInvalidPosesInARow). The force is zero and the device closed in every case but
/// the first. An unreachable server is not a failure: feedback_received of the report is then 0.
Result<LoopReport> run_device(Device& device, Link& link, const LoopOptions& options, const std::atomic<bool>& stop,
                              double watchdog_timeout_s = kWatchdogTimeoutS);

}  // namespace tensormass::haptic
