#pragma once

#include <algorithm>
#include <bit>
#include <cstddef>
#include <cstdint>

namespace tensormass {

/// Buckets of durations [ns], 1/32 of an octave wide, like those of HdrHistogram. A bucket's upper bound exceeds the
/// durations in it by at most 1/32, from 1 ns to 18 min. The number of buckets does not grow with the run, and counts
/// of several clients or scenes can be added.
///
///     index            width of a bucket
///     0 to 63          1 ns
///     64 to 95         2 ns
///     ...              each octave has 32 buckets, twice as wide as those before
///     1120 to 1151     2^34 ns
///
/// DurationHistogram in stream.proto and `DurationHistogram` of the SDK have the same buckets.
struct DurationBuckets {
  static constexpr std::size_t kSubBits = 5;
  static constexpr std::size_t kSubCount = std::size_t{1} << kSubBits;
  static constexpr std::size_t kMaxWidth = 40;  // bits of the largest duration
  static constexpr std::size_t kCount = (kMaxWidth - kSubBits + 1) * kSubCount;

  /// Index of the bucket that counts a duration. A negative one counts as 0, one beyond the range in the last bucket.
  static constexpr std::size_t index_of(std::int64_t duration_ns) {
    const auto value = static_cast<std::uint64_t>(std::max<std::int64_t>(duration_ns, 0));
    const std::size_t width = std::bit_width(value);
    const std::size_t shift = width > kSubBits + 1 ? width - (kSubBits + 1) : 0;
    return std::min(shift * kSubCount + static_cast<std::size_t>(value >> shift), kCount - 1);
  }

  /// Largest duration [ns] that bucket `index` counts.
  static constexpr std::int64_t upper_ns(std::size_t index) {
    const std::size_t shift = index < 2 * kSubCount ? 0 : index / kSubCount - 1;
    const std::size_t mantissa = index - shift * kSubCount;
    return static_cast<std::int64_t>(((mantissa + 1) << shift) - 1);
  }
};

}  // namespace tensormass
