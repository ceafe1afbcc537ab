#include "haptic/realtime.h"

#include <pthread.h>
#include <sched.h>
#include <sys/prctl.h>

#include <cstring>

namespace tensormass::haptic {

Result<void> request_realtime(int priority) {
  prctl(PR_SET_TIMERSLACK, 1UL);
  sched_param parameters{};
  parameters.sched_priority = priority;
  if (const int error = pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameters); error != 0) {
    return fail(ErrorCode::kUnavailable, std::string("no real-time scheduling (") + std::strerror(error) +
                                             "): wake-ups depend on the machine's load; allow it with ulimit -r " +
                                             std::to_string(kWatchdogPriority) + " or CAP_SYS_NICE");
  }
  return {};
}

}  // namespace tensormass::haptic
