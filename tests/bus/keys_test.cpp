#include "bus/keys.h"

#include <gtest/gtest.h>

namespace tensormass::bus {
namespace {

TEST(Keys, MatchTheProtocol) {
  EXPECT_EQ(topology_key("host", "demo"), "tensormass/host/demo/topology");
  EXPECT_EQ(frame_key("host", "demo"), "tensormass/host/demo/frame");
  EXPECT_EQ(status_key("host", "demo"), "tensormass/host/demo/status");
  EXPECT_EQ(changes_key("host", "demo"), "tensormass/host/demo/changes");
  EXPECT_EQ(events_key("host", "demo"), "tensormass/host/demo/events");
  EXPECT_EQ(feedback_key("host", "demo", "probe"), "tensormass/host/demo/tool/probe/feedback");
  EXPECT_EQ(pose_key("host", "demo", "probe"), "tensormass/host/demo/tool/probe/pose");
}

TEST(Keys, ParsesThePoseKeyThatItBuilt) {
  const std::string key = pose_key("host", "a-scene_1", "left-probe");
  const auto address = parse_pose_key("host", key);
  ASSERT_TRUE(address);
  EXPECT_EQ(address->scene, "a-scene_1");
  EXPECT_EQ(address->tool, "left-probe");
}

TEST(Keys, RefusesEveryOtherKeyAsAPoseKey) {
  const std::string longest(limits::kMaxNameLength, 'x');
  ASSERT_TRUE(parse_pose_key("host", pose_key("host", longest, "probe")));
  for (const std::string& key :
       {std::string(), std::string("tensormass"), std::string("tensormass/host"), pose_key("other", "demo", "probe"),
        pose_key("hos", "demo", "probe"), pose_key("host", "", "probe"), pose_key("host", "demo", ""),
        pose_key("host", "demo/x", "probe"), pose_key("host", "demo", "a/b"), pose_key("host", "*", "probe"),
        pose_key("host", longest + "x", "probe"), feedback_key("host", "demo", "probe"), frame_key("host", "demo"),
        pose_key("host", "demo", "probe") + "/pose", pose_key("host", "demo", "probe") + " ",
        std::string("x").append(pose_key("host", "demo", "probe")),
        std::string("tensormass/host/demo/tools/probe/pose")}) {
    EXPECT_FALSE(parse_pose_key("host", key)) << key;
  }
}

TEST(Keys, KnowsTheStreamsThatAServerPublishes) {
  for (const std::string& key :
       {topology_key("host", "demo"), frame_key("host", "demo"), status_key("host", "demo"),
        changes_key("host", "demo"), events_key("host", "demo"), feedback_key("host", "demo", "probe")}) {
    EXPECT_TRUE(is_stream_key("host", key)) << key;
    EXPECT_FALSE(is_stream_key("other", key)) << key;
    EXPECT_FALSE(is_stream_key("host", key + "x")) << key;
    EXPECT_FALSE(is_stream_key("host", key + '\0')) << key;
    EXPECT_FALSE(is_stream_key("host", key.substr(0, key.size() - 1))) << key;
  }
  for (const std::string& key : {std::string(), std::string("tensormass/host/"), pose_key("host", "demo", "probe"),
                                 frame_key("host", ""), frame_key("host", "*"), feedback_key("host", "demo", ""),
                                 frame_key("host", std::string(limits::kMaxNameLength + 1, 'x'))}) {
    EXPECT_FALSE(is_stream_key("host", key)) << key;
  }
}

TEST(Names, AllowOnlyLettersDigitsUnderscoreAndHyphen) {
  EXPECT_TRUE(is_valid_name("aZ09_-"));
  for (const char* name : {"", "a b", "a/b", "a.b", "\xc3\xa4", "a\n", "a*"}) EXPECT_FALSE(is_valid_name(name)) << name;
}

}  // namespace
}  // namespace tensormass::bus
