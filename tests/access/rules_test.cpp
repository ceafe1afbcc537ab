#include "access/rules.h"

#include <set>
#include <string>

#include <gtest/gtest.h>

#include "bus/keys.h"
#include "bus/zenoh/access_control.h"
#include "tensormass/v1/control.pb.h"

/// The table of rights. tests/attack/test_access.py takes every role, call, key and transport to a daemon.
namespace tensormass::access {
namespace {

constexpr Subject kHand{Role::kHand, "demo", "probe"};

TEST(Rules, HaveEveryCallOfTheProtocolOnce) {
  std::multiset<std::string> wanted, found;
  const auto& service = *v1::GetVersionRequest::descriptor()->file()->FindServiceByName("Control");
  for (int i = 0; i < service.method_count(); ++i) {
    wanted.insert(std::string(service.full_name()) + "/" + std::string(service.method(i)->name()));
  }
  for (const Rule& rule : kCalls) found.emplace(rule.what);
  EXPECT_EQ(found, wanted);
}

TEST(Rules, HaveEveryKeyOfTheProtocol) {
  for (const std::string& key :
       {bus::topology_key("s", "demo"), bus::frame_key("s", "demo"), bus::status_key("s", "demo"),
        bus::changes_key("s", "demo"), bus::events_key("s", "demo"), bus::feedback_key("s", "demo", "probe")}) {
    const auto address = bus::parse_stream_key("s", key);
    ASSERT_TRUE(address) << key;
    EXPECT_NE(find_rule(kStreams, address->stream), nullptr) << key;
  }
  EXPECT_EQ(bus::pose_key("s", "demo", "*"), bus::scene_key("s", "demo", kPuts.front().what));
}

TEST(Rules, RefuseWhatTheyDoNotHave) {
  const Subject operator_{Role::kOperator, "", ""};
  EXPECT_FALSE(may_call(operator_, "tensormass.v1.Control/Unknown", "demo", ""));
  EXPECT_FALSE(may_call(operator_, "Control/GetVersion", "", ""));
  EXPECT_TRUE(may_call(operator_, "tensormass.v1.Control/GetVersion", "", ""));
}

TEST(Rules, GiveAHandItsOwnSceneAndTool) {
  EXPECT_TRUE(may_call(kHand, "tensormass.v1.Control/GetTopology", "demo", ""));
  EXPECT_FALSE(may_call(kHand, "tensormass.v1.Control/GetTopology", "demo2", ""));
  EXPECT_FALSE(may_call(kHand, "tensormass.v1.Control/GetTopology", "", ""));
  EXPECT_TRUE(may_call(kHand, "tensormass.v1.Control/GetFeedback", "demo", "probe"));
  EXPECT_FALSE(may_call(kHand, "tensormass.v1.Control/GetFeedback", "demo", "other"));
  EXPECT_FALSE(may_call(kHand, "tensormass.v1.Control/GetFeedback", "demo", ""));
  EXPECT_FALSE(may_call(kHand, "tensormass.v1.Control/MoveTool", "demo", "probe")) << "the operator's takeover";
  EXPECT_TRUE(allows(&kPuts.front(), kHand, "demo", "probe"));
  EXPECT_FALSE(allows(&kPuts.front(), kHand, "demo", "other"));
  // A viewer with a scene and a tool is a viewer.
  EXPECT_FALSE(allows(&kPuts.front(), {Role::kViewer, "demo", "probe"}, "demo", "probe"));
}

TEST(ZenohRules, NameEachClientAndNobodyElse) {
  const auto hand = std::make_shared<const Client>(Client{"h.00000001", Role::kHand, "demo", "probe", "", 0});
  const auto metrics = std::make_shared<const Client>(Client{"m.00000002", Role::kMetrics, "", "", "", 0});
  const std::string rules = bus::zenoh_access_control("s", {hand, metrics});
  for (const char* has : {R"("default_permission":"deny")", R"("cert_common_names":["h.00000001"])",
                          R"("key_exprs":["tensormass/s/demo/tool/probe/pose"])",
                          R"("tensormass/s/demo/tool/probe/feedback")", R"("key_exprs":["tensormass/s/*/status"])"}) {
    EXPECT_NE(rules.find(has), std::string::npos) << has << " in " << rules;
  }
  EXPECT_EQ(rules.find("m.00000002/put"), std::string::npos);
  EXPECT_NE(bus::zenoh_access_control("s", {}).find("\"deny\""), std::string::npos) << "nobody may do anything";
}

}  // namespace
}  // namespace tensormass::access
