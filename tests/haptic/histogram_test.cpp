#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <vector>

#include "haptic/histogram.h"

namespace tensormass::haptic {
namespace {

TEST(Histogram, BucketsAreContiguousAndHoldTheirBounds) {
  for (std::size_t i = 0; i + 1 < Histogram::kBucketCount; ++i) {
    for (const std::int64_t inside : {i == 0 ? 0 : Histogram::upper_ns(i - 1) + 1, Histogram::upper_ns(i)}) {
      Histogram histogram;
      histogram.add(inside);
      ASSERT_EQ(histogram.buckets()[i], 1u) << inside << " ns";
    }
  }
}

TEST(Histogram, PercentilesAreWithinOneBucketOfTheSortedSample) {
  std::mt19937_64 random(7);
  std::lognormal_distribution<double> durations(12.0, 1.5);
  Histogram histogram;
  std::vector<std::int64_t> sample(10'000);
  for (auto& value : sample) {
    value = static_cast<std::int64_t>(durations(random));
    histogram.add(value);
  }
  std::sort(sample.begin(), sample.end());
  for (const double fraction : {0.5, 0.99, 0.999}) {
    const auto exact = static_cast<double>(sample[static_cast<std::size_t>(fraction * 10'000.0) - 1]);
    const auto estimate = static_cast<double>(histogram.percentile_ns(fraction));
    EXPECT_GE(estimate, exact);
    EXPECT_LE(estimate, exact * (1.0 + 1.0 / 32.0) + 1.0);
  }
  EXPECT_EQ(histogram.percentile_ns(1.0), sample.back());
  EXPECT_EQ(histogram.max_ns(), sample.back());
  EXPECT_EQ(histogram.count(), 10'000u);
}

TEST(Histogram, CountsDurationsOfAnySize) {
  Histogram histogram;
  EXPECT_EQ(histogram.percentile_ns(0.5), 0);
  histogram.add(-5);
  EXPECT_EQ(histogram.buckets().front(), 1u);
  histogram.add(std::numeric_limits<std::int64_t>::max());
  EXPECT_EQ(histogram.buckets().back(), 1u);
}

}  // namespace
}  // namespace tensormass::haptic
