#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <vector>

#include "core/assert.h"
#include "world/duration_counts.h"

namespace tensormass::world {

using Clock = std::chrono::steady_clock;

/// The schedule of a scene that runs at a fixed rate. Used by the loop's thread only.
///
/// Step n should start n periods after the first one, whenever earlier steps ended. After a late step, the next ones
/// start at once until the schedule is met again. If steps take longer than the period, that debt would grow without
/// end, and the first fast steps would then run in a burst. The debt is therefore at most kMaxBacklog; beyond it,
/// simulated time slows down.
///
///     begin()      the time at which the coming step should start
///     deadline     begin() + period: a step that ends by then is in time, because the next one can still start on time
class StepClock {
 public:
  explicit StepClock(double rate_hz)
      : period_(std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / rate_hz))) {
    TM_ASSERT(period_ > Clock::duration::zero(), "a rate is positive and has a period of at least a tick");
  }

  /// Schedules the coming step for `now`, and forgets any backlog.
  void restart(Clock::time_point now) { begin_ = now; }
  Clock::duration period() const { return period_; }
  /// The time at which the coming step should start.
  Clock::time_point begin() const { return begin_; }
  /// Notes that the coming step ended `now` and schedules the next one. Returns true if it met its deadline.
  bool finish(Clock::time_point now) {
    begin_ += period_;
    const bool in_time = now <= begin_;
    begin_ = std::max(begin_, now - kMaxBacklog);
    return in_time;
  }

 private:
  static constexpr Clock::duration kMaxBacklog = std::chrono::milliseconds(20);
  const Clock::duration period_;
  Clock::time_point begin_{};
};

/// Step times, reached rate and missed deadlines of a scene since its load. The loop writes them and any thread reads
/// them, without a lock: each number is an atomic, and a reader may see numbers of two steps next to each other.
class StepStatistics {
 public:
  struct Percentiles {
    double p50_s = 0, p99_s = 0, max_s = 0;
  };

  /// Adds a step that took `step_time` and ended at `end`. in_time: it met its deadline.
  void add(Clock::duration step_time, Clock::time_point end, bool in_time) {
    TM_ASSERT(step_time >= Clock::duration::zero(), "a step ends after its start");
    times_s_[static_cast<std::size_t>(count_.load(std::memory_order_relaxed)) % kWindow].store(
        std::chrono::duration<float>(step_time).count(), std::memory_order_relaxed);
    count_.fetch_add(1, std::memory_order_release);
    times_.add(std::chrono::duration_cast<std::chrono::nanoseconds>(step_time).count());
    if (!in_time) missed_.fetch_add(1, std::memory_order_relaxed);
    if (window_steps_++ == 0) {
      window_begin_ = end;
    } else if (const double elapsed_s = std::chrono::duration<double>(end - window_begin_).count(); elapsed_s >= 1) {
      reached_rate_hz_.store(static_cast<double>(window_steps_ - 1) / elapsed_s, std::memory_order_relaxed);
      window_steps_ = 1;
      window_begin_ = end;
    }
  }
  /// Measures the rate anew, because a pause must not count as slow steps.
  void interrupt() {
    window_steps_ = 0;
    reached_rate_hz_.store(0, std::memory_order_relaxed);
  }

  std::uint64_t missed_deadlines() const { return missed_.load(std::memory_order_relaxed); }
  /// Rate over the last full second or longer [Hz]; 0 before the first.
  double reached_rate_hz() const { return reached_rate_hz_.load(std::memory_order_relaxed); }
  /// All step times.
  const DurationCounts& times() const { return times_; }
  /// Percentiles of the last kWindow step times [s]; 0 before the first step. Allocates.
  Percentiles percentiles() const {
    const std::size_t filled = std::min<std::size_t>(count_.load(std::memory_order_acquire), kWindow);
    if (filled == 0) return {};
    std::vector<float> sorted(filled);
    for (std::size_t i = 0; i < filled; ++i) sorted[i] = times_s_[i].load(std::memory_order_relaxed);
    std::sort(sorted.begin(), sorted.end());
    return {sorted[filled / 2], sorted[filled * 99 / 100], sorted.back()};
  }

 private:
  static constexpr std::size_t kWindow = 1024;  // steps
  std::array<std::atomic<float>, kWindow> times_s_{};
  std::atomic<std::uint64_t> count_{0}, missed_{0};
  DurationCounts times_;
  std::atomic<double> reached_rate_hz_{0};
  std::uint64_t window_steps_ = 0;
  Clock::time_point window_begin_{};
};

}  // namespace tensormass::world
