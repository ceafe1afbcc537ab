#include "core/duration_buckets.h"

#include <fstream>
#include <string>

#include <gtest/gtest.h>

namespace tensormass {
namespace {

TEST(DurationBuckets, AreContiguousAndHoldTheirBounds) {
  for (std::size_t i = 1; i < DurationBuckets::kCount; ++i) {
    const std::int64_t lowest = DurationBuckets::upper_ns(i - 1) + 1, highest = DurationBuckets::upper_ns(i);
    ASSERT_EQ(DurationBuckets::index_of(lowest), i);
    ASSERT_EQ(DurationBuckets::index_of(highest), i);
    ASSERT_LE(32 * (highest - lowest), lowest) << "the stated error";
  }
}

/// The SDK's test reads the same table.
TEST(DurationBuckets, AreThoseOfTheSdk) {
  std::ifstream table("tests/core/duration_buckets.csv");  // ctest runs in the root of the repository
  if (!table) GTEST_SKIP() << "run it in the root of the repository";
  std::string heading;
  std::getline(table, heading);
  EXPECT_EQ(heading, "duration_ns,bucket,upper_ns");
  std::int64_t duration_ns, upper_ns;
  std::size_t bucket, rows = 0;
  for (char comma; table >> duration_ns >> comma >> bucket >> comma >> upper_ns; ++rows) {
    EXPECT_EQ(DurationBuckets::index_of(duration_ns), bucket) << duration_ns << " ns";
    EXPECT_EQ(DurationBuckets::upper_ns(bucket), upper_ns) << "bucket " << bucket;
  }
  EXPECT_GT(rows, 20u);
}

}  // namespace
}  // namespace tensormass
