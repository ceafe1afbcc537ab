#include "haptic/histogram.h"

#include <algorithm>
#include <bit>
#include <cmath>

namespace tensormass::haptic {

void Histogram::add(std::int64_t duration_ns) {
  const auto value = static_cast<std::uint64_t>(std::max<std::int64_t>(duration_ns, 0));
  // The first 2 kSubCount buckets are 1 ns wide. Above them each octave has kSubCount buckets.
  const std::size_t width = std::bit_width(value);
  const std::size_t shift = width > kSubBits + 1 ? width - (kSubBits + 1) : 0;
  const std::size_t index = shift * kSubCount + static_cast<std::size_t>(value >> shift);
  ++buckets_[std::min(index, kBucketCount - 1)];
  ++count_;
  max_ns_ = std::max(max_ns_, static_cast<std::int64_t>(value));
}

std::int64_t Histogram::upper_ns(std::size_t index) {
  const std::size_t shift = index < 2 * kSubCount ? 0 : index / kSubCount - 1;
  const std::size_t mantissa = index - shift * kSubCount;
  return static_cast<std::int64_t>(((mantissa + 1) << shift) - 1);
}

std::int64_t Histogram::percentile_ns(double fraction) const {
  if (count_ == 0) return 0;
  const auto rank =
      std::max<std::uint64_t>(1, static_cast<std::uint64_t>(std::ceil(fraction * static_cast<double>(count_))));
  std::uint64_t seen = 0;
  for (std::size_t i = 0; i < kBucketCount; ++i) {
    seen += buckets_[i];
    if (seen >= rank) return std::min(upper_ns(i), max_ns_);
  }
  return max_ns_;
}

}  // namespace tensormass::haptic
