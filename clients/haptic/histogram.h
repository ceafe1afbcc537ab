#pragma once

// Histogram of durations [ns] of fixed size. Not thread-safe; the loop's thread owns it. Nothing fails.

#include <array>
#include <cstddef>
#include <cstdint>

namespace tensormass::haptic {

/// Counts durations in buckets that are 1/32 of an octave wide: 3 % resolution from 1 ns to 18 min. The size does not
/// grow with the run, and the counts of several clients can be added.
class Histogram {
 public:
  static constexpr std::size_t kSubBits = 5;
  static constexpr std::size_t kSubCount = std::size_t{1} << kSubBits;
  static constexpr std::size_t kBucketCount = (40 - kSubBits + 1) * kSubCount;

  /// A negative duration counts as 0, one beyond the range counts in the last bucket.
  void add(std::int64_t duration_ns);

  std::uint64_t count() const { return count_; }
  /// Smallest upper bound [ns] of a bucket that at least `fraction` of the durations do not exceed. 0 if empty.
  std::int64_t percentile_ns(double fraction) const;
  std::int64_t max_ns() const { return max_ns_; }
  const std::array<std::uint64_t, kBucketCount>& buckets() const { return buckets_; }
  /// Largest duration [ns] that bucket `index` counts.
  static std::int64_t upper_ns(std::size_t index);

 private:
  std::array<std::uint64_t, kBucketCount> buckets_{};
  std::uint64_t count_ = 0;
  std::int64_t max_ns_ = 0;
};

}  // namespace tensormass::haptic
