#include "haptic/run_device.h"

#include "haptic/clock.h"
#include "haptic/force_guard.h"
#include "haptic/realtime.h"

namespace tensormass::haptic {

Result<LoopReport> run_device(Device& device, Link& link, const LoopOptions& options, const std::atomic<bool>& stop,
                              double watchdog_timeout_s) {
  TM_RETURN_IF_ERROR(device.open());
  static_cast<void>(request_realtime(kLoopPriority));
  MonotonicClock clock;
  Result<LoopReport> report;
  {
    ForceGuard guard(device, clock, watchdog_timeout_s);
    // Ends before the guard, and both before the device closes: neither may touch a closed device.
    const Watchdog watchdog(guard, watchdog_timeout_s / 4);
    report = Loop(guard, link, clock, options).run(stop);
  }
  device.close();
  return report;
}

}  // namespace tensormass::haptic
