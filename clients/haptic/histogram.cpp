#include "haptic/histogram.h"

#include <algorithm>
#include <cmath>

namespace tensormass::haptic {

void Histogram::add(std::int64_t duration_ns) {
  ++buckets_[DurationBuckets::index_of(duration_ns)];
  ++count_;
  max_ns_ = std::max(max_ns_, duration_ns);
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
