#pragma once

// Time for the loop and the device, as an interface so that tests can advance it. Times are in ns, any thread may ask,
// and nothing fails.

#include <cstdint>

namespace tensormass::haptic {

inline constexpr double kNsPerS = 1e9;

/// The loop's only source of time.
class Clock {
 public:
  virtual ~Clock() = default;
  /// Monotonic [ns]; its zero is arbitrary.
  virtual std::int64_t now_ns() = 0;
  /// Sleeps until `deadline_ns` of this clock. A signal may end the sleep early, so the caller checks now_ns().
  virtual void sleep_until_ns(std::int64_t deadline_ns) = 0;
};

/// CLOCK_MONOTONIC with absolute deadlines. Relative sleeps would accumulate their wake-up latency.
class MonotonicClock final : public Clock {
 public:
  std::int64_t now_ns() override;
  void sleep_until_ns(std::int64_t deadline_ns) override;
};

}  // namespace tensormass::haptic
