#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <vector>

namespace tensormass::world {

using Clock = std::chrono::steady_clock;

/// The schedule of a scene that runs at a fixed rate. A step that begins late is made up for by the next ones beginning
/// at once; a scene that is too slow for its rate falls behind by kMaxBacklog at most and then simulated time slows.
class StepClock {
 public:
  explicit StepClock(double rate_hz)
      : period_(std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / rate_hz))) {}

  void restart(Clock::time_point now) { begin_ = now; }
  /// When the coming step is to begin.
  Clock::time_point begin() const { return begin_; }
  /// After a step that ended `now`: true if that was in time, before the next step's beginning.
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

/// Counts and times of the loop, written by it and read by anyone without a lock.
class StepStatistics {
 public:
  struct Percentiles {
    double p50_s = 0, p99_s = 0, max_s = 0;
  };

  void add(Clock::duration step_time, Clock::time_point end, bool in_time) {
    times_s_[static_cast<std::size_t>(count_.load(std::memory_order_relaxed)) % kWindow].store(
        std::chrono::duration<float>(step_time).count(), std::memory_order_relaxed);
    count_.fetch_add(1, std::memory_order_release);
    if (!in_time) missed_.fetch_add(1, std::memory_order_relaxed);
    if (window_steps_++ == 0) {
      window_begin_ = end;
    } else if (const double elapsed_s = std::chrono::duration<double>(end - window_begin_).count(); elapsed_s >= 1) {
      reached_rate_hz_.store(static_cast<double>(window_steps_ - 1) / elapsed_s, std::memory_order_relaxed);
      window_steps_ = 1;
      window_begin_ = end;
    }
  }
  /// After a pause: the rate is measured anew.
  void interrupt() {
    window_steps_ = 0;
    reached_rate_hz_.store(0, std::memory_order_relaxed);
  }

  std::uint64_t missed_deadlines() const { return missed_.load(std::memory_order_relaxed); }
  double reached_rate_hz() const { return reached_rate_hz_.load(std::memory_order_relaxed); }
  Percentiles percentiles() const {
    const std::size_t filled = std::min<std::size_t>(count_.load(std::memory_order_acquire), kWindow);
    if (filled == 0) return {};
    std::vector<float> sorted(filled);
    for (std::size_t i = 0; i < filled; ++i) sorted[i] = times_s_[i].load(std::memory_order_relaxed);
    std::sort(sorted.begin(), sorted.end());
    return {sorted[filled / 2], sorted[filled * 99 / 100], sorted.back()};
  }

 private:
  static constexpr std::size_t kWindow = 1024;
  std::array<std::atomic<float>, kWindow> times_s_{};
  std::atomic<std::uint64_t> count_{0}, missed_{0};
  std::atomic<double> reached_rate_hz_{0};
  std::uint64_t window_steps_ = 0;
  Clock::time_point window_begin_{};
};

}  // namespace tensormass::world
