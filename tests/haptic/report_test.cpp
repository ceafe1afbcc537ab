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

TEST(Report, TextNamesTheLosses) {
  LoopReport report;
  report.last_sequence_sent = 12;
  report.last_sequence_echoed = 9;
  report.poses_not_taken = 2;
  report.poses_invalid = 3;
  const std::string text = to_text(report, {"s", "demo", "probe", "zeromq", "simulated"});
  EXPECT_NE(text.find("last 12 echoed 9, 2 not taken by the transport, 3 of the device invalid"), std::string::npos)
      << text;
  EXPECT_NE(to_json(report, {}).find(R"("poses_not_taken": 2, "poses_invalid": 3)"), std::string::npos);
}

TEST(Report, CountsRecoveriesAndNamesThemIfThereAreAny) {
  LoopReport report;
  EXPECT_EQ(to_text(report, {}).find("recover"), std::string::npos);
  report.recoveries = 2;
  report.recovering_feedbacks = 5;
  EXPECT_NE(to_text(report, {}).find("  recovery  2 recoveries, 5 feedbacks\n"), std::string::npos);
  EXPECT_NE(to_json(report, {}).find(R"("recovering_feedbacks": 5, "recoveries": 2, )"), std::string::npos);
  EXPECT_EQ(recovery_line(1),
            "the scene recovers from a step that could not be made as planned; the force fades to the new one");
  EXPECT_NE(recovery_line(3).find("planned (3 times since the last such line); "), std::string::npos);
}

TEST(Report, ShowsTorquesOnlyOfADeviceThatHasThem) {
  LoopReport report;
  EXPECT_EQ(to_json(report, {}).find("torque"), std::string::npos);
  EXPECT_EQ(to_text(report, {}).find("torque"), std::string::npos);
  report.max_torque_n_m = 0.0125;
  EXPECT_NE(to_json(report, {}).find(R"("min_energy_j": 0, "max_torque_n_m": 0.0125, "pose_to_force": )"),
            std::string::npos);
  EXPECT_TRUE(to_text(report, {}).ends_with("  torque    at most 0.0125 N m\n"));
  report.max_jaw_torque_n_m = 0.5;
  EXPECT_NE(to_json(report, {}).find(R"("max_jaw_torque_n_m": 0.5)"), std::string::npos);
  EXPECT_TRUE(to_text(report, {}).ends_with("at most 0.0125 N m; jaws at most 0.5000 N m\n"));
}

TEST(Report, ExplainsMissingAnswersFromTheScenesStatus) {
  v1::SceneStatus status;
  const auto why = [&](v1::SceneStatus::State state, std::uint64_t rejected) {
    status.set_state(state);
    status.set_poses_rejected(rejected);
    return why_unanswered(status, 5);
  };
  status.set_fault("step 7 left its bounds");
  EXPECT_NE(why(v1::SceneStatus::STATE_RUNNING, 305).find("refused poses of the scene meanwhile (300)"),
            std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_PAUSED, 6).find("refused poses of the scene meanwhile (1)"), std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_PAUSED, 5).find("paused"), std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_LOCKSTEP, 5).find("lockstep"), std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_FAULTED, 5).find("step 7 left its bounds"), std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_RUNNING, 5).find("ports"), std::string::npos);
  v1::ToolFeedback& tool = *status.add_tools();
  tool.set_tool("probe");
  tool.set_client_id(0x2b);
  tool.set_claimed(true);
  EXPECT_NE(why(v1::SceneStatus::STATE_RUNNING, 6).find("tool 'probe': another client (0x2b) claims the tool"),
            std::string::npos);
  EXPECT_NE(why(v1::SceneStatus::STATE_RUNNING, 5).find("ports"), std::string::npos) << "it refused no pose";
}

}  // namespace
}  // namespace tensormass::haptic
