#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace tensormass::haptic {

/// Counts durations in buckets whose width is 1/32 of their octave (3 % resolution, 1 ns to 18 min), so that any
/// length of run has the same small size, percentiles are always at hand, and counts of several clients can be added.
class Histogram {
 public:
  static constexpr std::size_t kSubBits = 5;
  static constexpr std::size_t kSubCount = std::size_t{1} << kSubBits;
  static constexpr std::size_t kBucketCount = (40 - kSubBits + 1) * kSubCount;

  /// Negative counts as 0, beyond the range as the last bucket.
  void add(std::int64_t duration_ns);

  std::uint64_t count() const { return count_; }
  /// The smallest upper bound [ns] of a bucket that at least `fraction` of the durations stay under; 0 if empty.
  std::int64_t percentile_ns(double fraction) const;
  std::int64_t max_ns() const { return max_ns_; }
  const std::array<std::uint64_t, kBucketCount>& buckets() const { return buckets_; }
  /// The largest duration that bucket `index` counts.
  static std::int64_t upper_ns(std::size_t index);

 private:
  std::array<std::uint64_t, kBucketCount> buckets_{};
  std::uint64_t count_ = 0;
  std::int64_t max_ns_ = 0;
};

}  // namespace tensormass::haptic
