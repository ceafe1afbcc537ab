#pragma once

#include "core/result.h"

namespace tensormass::haptic {

/// SCHED_FIFO priorities: above ordinary programs, below the kernel's own threads (50 and up).
inline constexpr int kLinkPriority = 39;
inline constexpr int kLoopPriority = 40;
inline constexpr int kWatchdogPriority = 41;

/// Puts the calling thread under SCHED_FIFO and its timer slack to 1 ns (which needs no privilege and is set in any
/// case). The error says what to do; going on without is fine on a machine with a free core.
Result<void> request_realtime(int priority);

}  // namespace tensormass::haptic
