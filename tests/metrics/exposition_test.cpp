#include "metrics/exposition.h"

#include <limits>
#include <sstream>
#include <string>
#include <vector>

#include <fmt/format.h>
#include <gtest/gtest.h>

namespace tensormass::metrics {
namespace {

constexpr Family kTimes{"times_seconds", Type::kHistogram, "Times."};

std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

TEST(Exposition, WritesHelpTypeAndSamples) {
  Exposition out;
  out.begin({"things_total", Type::kCounter, "Things."});
  out.sample({}, std::uint64_t{18'000'000'000'000'000'001u});
  out.sample({{"kind", "a"}, {"of", "b"}}, 0.25);
  EXPECT_EQ(out.text(),
            "# HELP things_total Things.\n# TYPE things_total counter\nthings_total 18000000000000000001\n"
            "things_total{kind=\"a\",of=\"b\"} 0.25\n");
}

/// A name of a device, or of a scene in a daemon to come, is a stranger's.
TEST(Exposition, EscapesLabels) {
  Exposition out;
  out.begin({"x", Type::kGauge, "X."});
  out.sample({{"name", "a\"} 1\nfake 2\\"}}, std::uint64_t{3});
  EXPECT_EQ(lines_of(out.text()).back(), R"(x{name="a\"} 1\nfake 2\\"} 3)");
}

TEST(Exposition, WritesValuesThatAreNotFiniteAsPrometheusReadsThem) {
  Exposition out;
  out.begin({"x", Type::kGauge, "X."});
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  for (const double value : {std::numeric_limits<double>::quiet_NaN(), kInfinity, -kInfinity}) out.sample({}, value);
  const std::vector<std::string> lines = lines_of(out.text());
  EXPECT_EQ(lines[2], "x NaN");
  EXPECT_EQ(lines[3], "x +Inf");
  EXPECT_EQ(lines[4], "x -Inf");
}

TEST(Exposition, HistogramsAreCumulative) {
  world::DurationCounts counts;
  for (const std::int64_t duration_ns : {0, 40'000, 900'000, 900'000, 60'000'000, 2'000'000'000}) {
    counts.add(duration_ns);
  }
  Exposition out;
  out.begin(kTimes);
  out.histogram({{"scene", "a"}}, counts);
  const std::vector<std::string> lines = lines_of(out.text());
  ASSERT_EQ(lines.size(), 2 + kBucketsS.size() + 3);
  EXPECT_EQ(lines[2], R"(times_seconds_bucket{scene="a",le="5e-05"} 2)");
  EXPECT_EQ(lines[5], R"(times_seconds_bucket{scene="a",le="0.0005"} 2)");
  EXPECT_EQ(lines[6], R"(times_seconds_bucket{scene="a",le="0.001"} 4)");
  EXPECT_EQ(lines[12], R"(times_seconds_bucket{scene="a",le="0.1"} 5)");
  EXPECT_EQ(lines[15], R"(times_seconds_bucket{scene="a",le="1"} 5)");
  EXPECT_EQ(lines[16], R"(times_seconds_bucket{scene="a",le="+Inf"} 6)");
  EXPECT_EQ(lines[17], R"(times_seconds_sum{scene="a"} 2.06184)");
  EXPECT_EQ(lines[18], R"(times_seconds_count{scene="a"} 6)");
}

/// A duration never counts as shorter than it was, and beyond a bound it may count up to 1/32 early as longer.
TEST(Exposition, ABucketHoldsNothingLongerThanItsBound) {
  for (const double bound_s : kBucketsS) {
    world::DurationCounts counts;
    counts.add(static_cast<std::int64_t>(1e9 * bound_s) + 1);
    counts.add(static_cast<std::int64_t>(1e9 * bound_s * 31 / 32) - 1);
    Exposition out;
    out.begin(kTimes);
    out.histogram({}, counts);
    EXPECT_NE(out.text().find(fmt::format("le=\"{}\"}} 1\n", bound_s)), std::string::npos) << out.text();
  }
}

}  // namespace
}  // namespace tensormass::metrics
