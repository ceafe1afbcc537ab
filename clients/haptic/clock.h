#pragma once

#include <cstdint>

namespace tensormass::haptic {

inline constexpr double kNsPerS = 1e9;

/// The loop's only source of time, so that tests can turn it by hand.
class Clock {
 public:
  virtual ~Clock() = default;
  /// Monotonic [ns]; its zero is arbitrary.
  virtual std::int64_t now_ns() = 0;
  /// Returns at or after `deadline_ns` of the same clock. May return early on a signal; the caller asks now_ns().
  virtual void sleep_until_ns(std::int64_t deadline_ns) = 0;
};

/// CLOCK_MONOTONIC with absolute deadlines: relative sleeps would add up their wake-up latency.
class MonotonicClock final : public Clock {
 public:
  std::int64_t now_ns() override;
  void sleep_until_ns(std::int64_t deadline_ns) override;
};

}  // namespace tensormass::haptic
