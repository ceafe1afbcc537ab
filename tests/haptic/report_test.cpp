#include <gtest/gtest.h>

#include <google/protobuf/struct.pb.h>
#include <google/protobuf/util/json_util.h>

#include "haptic/report.h"

namespace tensormass::haptic {
namespace {

TEST(Report, JsonHoldsCountsPercentilesAndBuckets) {
  LoopReport report;
  report.ticks = 12;
  report.last_sequence_sent = 12;
  for (int i = 0; i < 3; ++i) report.round_trip.add(2'000'000);
  google::protobuf::Struct json;
  ASSERT_TRUE(google::protobuf::util::JsonStringToMessage(
                  to_json(report, {"127.0.0.1:1", "de\"mo", "probe", "zeromq", "simulated"}), &json)
                  .ok());
  EXPECT_EQ(json.fields().at("scene").string_value(), "de\"mo");
  EXPECT_EQ(json.fields().at("ticks").number_value(), 12.0);
  const auto& latency = json.fields().at("pose_to_force").struct_value().fields();
  EXPECT_EQ(latency.at("count").number_value(), 3.0);
  EXPECT_NEAR(latency.at("p99_s").number_value(), 0.002, 1e-12);
  ASSERT_EQ(latency.at("buckets").list_value().values_size(), 1);
  EXPECT_EQ(latency.at("buckets").list_value().values(0).list_value().values(1).number_value(), 3.0);
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
