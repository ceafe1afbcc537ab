#pragma once

// Real-time scheduling of the calling thread. Threads that it starts later inherit it.

#include "core/result.h"

namespace tensormass::haptic {

/// SCHED_FIFO priorities: above ordinary programs, below the kernel's own threads (50 and up).
inline constexpr int kLinkPriority = 39;
inline constexpr int kLoopPriority = 40;
inline constexpr int kWatchdogPriority = 41;

/// Puts the calling thread under SCHED_FIFO and sets its timer slack to 1 ns. Fails without the privilege, and the
/// error says how to grant it; the timer slack is set anyway. A machine with a free core can do without.
Result<void> request_realtime(int priority);

}  // namespace tensormass::haptic
