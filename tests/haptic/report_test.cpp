#include <gtest/gtest.h>

#include "haptic/report.h"

namespace tensormass::haptic {
namespace {

TEST(Report, JsonHoldsCountsPercentilesAndBuckets) {
  LoopReport report;
  report.ticks = 12;
  report.seconds = 0.25;
  for (int i = 0; i < 3; ++i) report.round_trip.add(63);
  const std::string json = to_json(report, {"127.0.0.1:1", "de\"mo", "probe", "zeromq", "simulated"});
  EXPECT_TRUE(json.starts_with(R"({"server": "127.0.0.1:1", "scene": "de\"mo", "tool": "probe")")) << json;
  EXPECT_NE(json.find(R"("seconds": 0.25, "ticks": 12, )"), std::string::npos) << json;
  EXPECT_NE(json.find(R"("pose_to_force": {"count": 3, "p50_s": 6.3e-08, "p99_s": 6.3e-08, "p999_s": 6.3e-08, )"
                      R"("max_s": 6.3e-08, "buckets": [[6.3e-08, 3]]})"),
            std::string::npos)
      << json;
  EXPECT_TRUE(json.ends_with("}}\n"));
}

TEST(Report, TextNamesWhatWasLost) {
  LoopReport report;
  report.last_sequence_sent = 12;
  report.last_sequence_echoed = 9;
  report.poses_not_taken = 2;
  const std::string text = to_text(report, {"s", "demo", "probe", "zeromq", "simulated"});
  EXPECT_NE(text.find("last 12 echoed 9, 2 not taken"), std::string::npos) << text;
}

}  // namespace
}  // namespace tensormass::haptic
