#include "daemon_process.h"

namespace tensormass::daemon_tests {
namespace {

struct Outcome {
  int status = 0;
  std::string output;
};

Outcome check(std::vector<std::string> arguments, const std::vector<std::string>& environment = {}) {
  const TemporaryFolder folder;
  arguments.insert(arguments.begin(), {TENSORMASSD, "--check-config"});
  Process process(arguments, folder / "output", environment);
  const int status = process.wait();
  return {status, read_file(folder / "output")};
}

bool has_line(const std::string& text, const std::string& line) {
  return ("\n" + text).find("\n" + line + "\n") != std::string::npos;
}

TEST(Settings, BindLoopbackByDefault) {
  const Outcome outcome = check({});
  EXPECT_EQ(outcome.status, 0);
  EXPECT_TRUE(has_line(outcome.output, "control=\"127.0.0.1:50051\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "zeromq-publish=\"tcp://127.0.0.1:50052\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "zeromq-pose=\"tcp://127.0.0.1:50053\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "zenoh-listen=\"tcp/127.0.0.1:7447\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "metrics=\"off\"")) << outcome.output;
}

TEST(Settings, FlagsOverrideTheEnvironmentWhichOverridesTheFile) {
  const TemporaryFolder folder;
  const std::string file = (folder / "settings.toml").string();
  std::ofstream(file) << "server-name = \"file\"\ncontrol = \"127.0.0.1:1\"\nlog-level = \"error\"\n";
  const Outcome outcome = check({"--config", file, "--server-name", "flag"},
                                {"TENSORMASS_SERVER_NAME=environment", "TENSORMASS_CONTROL=127.0.0.1:2"});
  EXPECT_EQ(outcome.status, 0);
  EXPECT_TRUE(has_line(outcome.output, "server-name=\"flag\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "control=\"127.0.0.1:2\"")) << outcome.output;
  EXPECT_TRUE(has_line(outcome.output, "log-level=\"error\"")) << outcome.output;
}

TEST(Settings, ThePrintedSettingsAreAValidConfigFile) {
  const TemporaryFolder folder;
  const std::string file = (folder / "settings.toml").string();
  const Outcome first = check({"--server-name", "theatre-1", "--zenoh-listen", "off", "--cpu-threads", "3"});
  std::ofstream(file) << first.output;
  const Outcome second = check({"--config", file});
  EXPECT_EQ(second.status, 0);
  EXPECT_EQ(second.output, first.output);
}

TEST(Settings, AnInvalidSettingIsRefusedByName) {
  const TemporaryFolder folder;
  const std::string file = (folder / "settings.toml").string();
  std::ofstream(file) << "nonsense = 1\n";
  const std::vector<std::pair<std::vector<std::string>, std::string>> cases{
      {{"--config", file}, "nonsense"},
      {{"--config", (folder / "none.toml").string()}, "none.toml"},
      {{"--backend", "tpu"}, "--backend"},
      {{"--cpu-threads", "0"}, "--cpu-threads"},
      {{"--gpu-scenes", "0"}, "--gpu-scenes"},
      {{"--zenoh-sessions", "0"}, "--zenoh-sessions"},
      {{"--max-scene-mib", "-1"}, "--max-scene-mib"},
      {{"--max-memory-mib", "much"}, "--max-memory-mib"},
      {{"--max-load-s", "0"}, "--max-load-s"},
      {{"--max-load-s", "nan"}, "--max-load-s"},
      {{"--control", "localhost"}, "--control"},
      {{"--control", "127.0.0.1:65536"}, "--control"},
      {{"--zeromq-publish", "udp://127.0.0.1:1"}, "--zeromq-publish"},
      {{"--zeromq-pose", "off"}, "--zeromq-pose"},
      {{"--zenoh-listen", "127.0.0.1:7447"}, "--zenoh-listen"},
      {{"--metrics", "9464"}, "--metrics"},
      {{"--metrics", "0.0.0.0:9464"}, "other machines can reach '0.0.0.0:9464'"},
      {{"--metrics", "[::]:9464"}, "let other machines scrape the gateway"},
      {{"--server-name", "a/b"}, "--server-name"},
      {{"--max-state-mib", "0"}, "--max-state-mib"},
      {{"--health", "localhost"}, "--health"},
      {{"--log-level", "loud"}, "--log-level"},
      {{"--nonsense"}, "--nonsense"},
  };
  for (const auto& [arguments, named] : cases) {
    const Outcome outcome = check(arguments);
    EXPECT_EQ(outcome.status, 2) << arguments[0];
    EXPECT_NE(outcome.output.find(named), std::string::npos) << outcome.output;
  }
}

TEST(Settings, TheEnvironmentIsCheckedToo) {
  const Outcome outcome = check({}, {"TENSORMASS_BACKEND=tpu"});
  EXPECT_EQ(outcome.status, 2);
  EXPECT_NE(outcome.output.find("--backend"), std::string::npos) << outcome.output;
}

}  // namespace
}  // namespace tensormass::daemon_tests
