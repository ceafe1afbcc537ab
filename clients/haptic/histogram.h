#pragma once

// Histogram of durations [ns] of fixed size. Not thread-safe; the loop's thread owns it. Nothing fails.

#include <array>
#include <cstddef>
#include <cstdint>

#include "core/duration_buckets.h"

namespace tensormass::haptic {

/// Counts durations in DurationBuckets: 3 % resolution from 1 ns to 18 min.
class Histogram {
 public:
  static constexpr std::size_t kBucketCount = DurationBuckets::kCount;

  /// A negative duration counts as 0, one beyond the range counts in the last bucket.
  void add(std::int64_t duration_ns);

  std::uint64_t count() const { return count_; }
  /// Smallest upper bound [ns] of a bucket that at least `fraction` of the durations do not exceed. 0 if empty.
  std::int64_t percentile_ns(double fraction) const;
  std::int64_t max_ns() const { return max_ns_; }
  const std::array<std::uint64_t, kBucketCount>& buckets() const { return buckets_; }
  /// Largest duration [ns] that bucket `index` counts.
  static std::int64_t upper_ns(std::size_t index) { return DurationBuckets::upper_ns(index); }

 private:
  std::array<std::uint64_t, kBucketCount> buckets_{};
  std::uint64_t count_ = 0;
  std::int64_t max_ns_ = 0;
};

}  // namespace tensormass::haptic
