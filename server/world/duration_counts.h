#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>

#include "core/duration_buckets.h"

namespace tensormass::world {

/// Counts durations in fixed buckets. One thread adds, without a lock and without an allocation, and any thread reads.
/// Counts only grow, so the difference of two readings holds the durations between them.
class DurationCounts {
 public:
  void add(std::int64_t duration_ns) {
    counts_[DurationBuckets::index_of(duration_ns)].fetch_add(1, std::memory_order_relaxed);
    sum_ns_.fetch_add(duration_ns, std::memory_order_relaxed);
    if (duration_ns > max_ns_.load(std::memory_order_relaxed)) max_ns_.store(duration_ns, std::memory_order_relaxed);
  }

  std::uint64_t count(std::size_t bucket) const { return counts_[bucket].load(std::memory_order_relaxed); }
  /// Sum of all durations.
  std::int64_t sum_ns() const { return sum_ns_.load(std::memory_order_relaxed); }
  /// The longest duration; 0 before the first.
  std::int64_t max_ns() const { return max_ns_.load(std::memory_order_relaxed); }

 private:
  std::array<std::atomic<std::uint64_t>, DurationBuckets::kCount> counts_{};
  std::atomic<std::int64_t> sum_ns_{0}, max_ns_{0};
};

}  // namespace tensormass::world
