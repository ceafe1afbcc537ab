#include <arpa/inet.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/stat.h>

#include <atomic>
#include <filesystem>
#include <random>
#include <set>

#include <zmq.hpp>

#include "bus/keys.h"
#include "bus/zenoh/session.h"
#include "daemon_process.h"
#include "support/scenes.h"
#include "tensormass/v1/event.pb.h"

namespace tensormass::daemon_tests {
namespace {

using Clock = std::chrono::steady_clock;

v1::Scene running_block(const std::string& name = "block") {
  v1::Scene scene = tests::block_with_probe();
  scene.set_name(name);
  scene.mutable_stepping()->set_lockstep(false);
  return scene;
}

/// Reads every message of one stream over ZeroMQ.
template <class Message>
class Reader {
 public:
  Reader(const std::string& endpoint, const std::string& key) : prefix_(key + '\0') {
    socket_.set(zmq::sockopt::linger, 0);
    socket_.set(zmq::sockopt::rcvtimeo, static_cast<int>(std::chrono::milliseconds(kDeadline).count()));
    socket_.set(zmq::sockopt::subscribe, prefix_);
    socket_.connect(endpoint);
  }
  /// Returns the next message; throws at the deadline.
  Message read() {
    zmq::message_t frame;
    if (!socket_.recv(frame)) throw std::runtime_error("no message arrived under " + prefix_);
    return parse(frame);
  }
  std::optional<Message> try_read() {
    zmq::message_t frame;
    if (!socket_.recv(frame, zmq::recv_flags::dontwait)) return std::nullopt;
    return parse(frame);
  }

 private:
  Message parse(const zmq::message_t& frame) const {
    Message message;
    EXPECT_TRUE(message.ParseFromString(std::string(frame.to_string_view().substr(prefix_.size()))));
    return message;
  }
  std::string prefix_;
  zmq::context_t context_{1};
  zmq::socket_t socket_{context_, zmq::socket_type::sub};
};

class PoseWriter {
 public:
  explicit PoseWriter(const std::string& endpoint) {
    socket_.set(zmq::sockopt::linger, 1000);
    socket_.connect(endpoint);
  }
  void send(const std::string& scene, std::uint64_t sequence, double x, double y, double z) {
    v1::ToolPose pose;
    pose.set_sequence(sequence);
    pose.set_client_id(1);
    tests::set(*pose.mutable_position_m(), x, y, z);
    socket_.send(zmq::buffer(bus::pose_key("local", scene, "probe") + '\0' + pose.SerializeAsString()));
  }

 private:
  zmq::context_t context_{1};
  zmq::socket_t socket_{context_, zmq::socket_type::push};
};

TEST(Daemon, ReportsEveryEndpointOnceItServes) {
  DaemonProcess daemon;
  const v1::GetVersionResponse version = daemon.version();
  EXPECT_EQ(version.backend(), "cpu");
  EXPECT_EQ(version.server(), "local");
  EXPECT_EQ(version.zeromq_publish_endpoint(), daemon.endpoint("zeromq_publish"));
  EXPECT_EQ(version.zeromq_pose_endpoint(), daemon.endpoint("zeromq_pose"));
  EXPECT_EQ(version.zenoh_locator(), daemon.endpoint("zenoh"));
  for (const char* name : {"control", "zeromq_publish", "zeromq_pose", "zenoh"}) {
    EXPECT_NE(daemon.endpoint(name).find("127.0.0.1:"), std::string::npos) << daemon.endpoint(name);
  }
  EXPECT_EQ(version.malformed_messages(), 0u);
  EXPECT_EQ(daemon.endpoint("metrics"), "");
}

TEST(Daemon, ReportsItsEndpointOfMetricsAndNamesOneThatIsTaken) {
  DaemonProcess daemon({"--metrics", "localhost:0"});
  const std::string endpoint = daemon.endpoint("metrics");
  EXPECT_TRUE(endpoint.starts_with("localhost:") && endpoint != "localhost:0") << endpoint;
  Process second({TENSORMASSD, "--backend", "cpu", "--control", "127.0.0.1:0", "--zeromq-publish", "off",
                  "--zeromq-pose", "off", "--zenoh-listen", "off", "--metrics", endpoint},
                 daemon.folder / "second");
  EXPECT_EQ(second.wait(), 1);
  const std::string log = read_file(daemon.folder / "second");
  EXPECT_NE(log.find(endpoint), std::string::npos) << log;
}

TEST(Daemon, HasNoEndpointForATransportThatIsOff) {
  DaemonProcess daemon({"--zeromq-publish", "off", "--zeromq-pose", "off", "--zenoh-listen", "off"});
  EXPECT_EQ(daemon.endpoint("zeromq_publish"), "");
  EXPECT_EQ(daemon.endpoint("zenoh"), "");
  EXPECT_NO_THROW(daemon.load(running_block()));
}

TEST(Daemon, ListensOnASocketFile) {
  const TemporaryFolder folder;
  const std::string publish = "ipc://" + (folder / "publish").string();
  DaemonProcess daemon({"--zeromq-publish", publish, "--zeromq-pose", "ipc://" + (folder / "pose").string()});
  EXPECT_EQ(daemon.endpoint("zeromq_publish"), publish);
  daemon.load(running_block());
  Reader<v1::Topology> topology(publish, bus::topology_key("local", "block"));
  EXPECT_EQ(topology.read().scene(), "block");
}

TEST(Daemon, APoseBecomesAForce) {
  DaemonProcess daemon;
  daemon.load(running_block());
  PoseWriter hand(daemon.endpoint("zeromq_pose"));
  Reader<v1::ToolFeedback> feedback(daemon.endpoint("zeromq_publish"), bus::feedback_key("local", "block", "probe"));
  hand.send("block", 1, 0.05, 0.05, 0.05);
  v1::ToolFeedback felt;
  ASSERT_TRUE(eventually([&] {
    felt = feedback.read();
    return felt.force_n().y() > 0.01;
  }));
  EXPECT_EQ(felt.pose_sequence(), 1u);
  EXPECT_EQ(felt.client_id(), 1u);
}

TEST(Daemon, StreamsAreTheSameOverZenoh) {
  DaemonProcess daemon;
  daemon.load(running_block());
  auto session = zenoh::Session::open({.connect = daemon.endpoint("zenoh")});
  ASSERT_TRUE(session) << session.error().message;
  std::atomic<int> frames{0}, statuses{0};
  v1::Frame frame;
  auto subscriber = session->subscribe("tensormass/local/block/*", [&](std::string_view key, std::string_view payload) {
    if (key.ends_with("/status")) ++statuses;
    if (!key.ends_with("/frame")) return;
    if (frames == 0) frame.ParseFromString(std::string(payload));
    ++frames;
  });
  ASSERT_TRUE(subscriber) << subscriber.error().message;
  EXPECT_TRUE(eventually([&] { return frames >= 10 && statuses >= 2; })) << frames << " " << statuses;

  v1::Topology topology;
  ASSERT_EQ(session->get("tensormass/local/block/topology", 5000,
                         [&](std::string_view, std::string_view payload) {
                           EXPECT_TRUE(topology.ParseFromString(std::string(payload)));
                         }),
            1u);
  ASSERT_EQ(topology.bodies_size(), 1);
  EXPECT_EQ(frame.positions().size(), 12 * std::size_t{topology.bodies(0).vertex_count()});
  EXPECT_EQ(frame.topology_version(), topology.version());
}

TEST(Daemon, LateJoinersGetChangesAndEventsWhole) {
  DaemonProcess daemon;
  daemon.load(running_block());
  const std::string publish = daemon.endpoint("zeromq_publish");
  const auto changes = Reader<v1::SurfaceChanges>(publish, bus::changes_key("local", "block")).read();
  EXPECT_EQ(changes.revision(), 0u);
  EXPECT_EQ(changes.bodies_size(), 0);
  Reader<v1::SceneEvents> early(publish, bus::events_key("local", "block"));
  EXPECT_EQ(early.read().topology_version(), changes.topology_version());
  for (int i = 0; i < 2; ++i) {
    grpc::ClientContext context;
    v1::ResetSceneRequest request;
    request.set_scene("block");
    v1::ResetSceneResponse response;
    ASSERT_TRUE(daemon.stub->ResetScene(&context, request, &response).ok());
  }
  const auto has_both = [](const v1::SceneEvents& events) {
    return events.events_size() == 2 && events.events(1).kind() == v1::SceneEvent::KIND_RESET;
  };
  EXPECT_TRUE(eventually([&] { return has_both(early.read()); }));
  EXPECT_TRUE(has_both(Reader<v1::SceneEvents>(publish, bus::events_key("local", "block")).read()));

  auto session = zenoh::Session::open({.connect = daemon.endpoint("zenoh")});
  ASSERT_TRUE(session) << session.error().message;
  v1::SceneEvents asked;
  ASSERT_EQ(session->get("tensormass/local/block/events", 5000,
                         [&](std::string_view, std::string_view payload) {
                           EXPECT_TRUE(asked.ParseFromString(std::string(payload)));
                         }),
            1u);
  EXPECT_TRUE(has_both(asked));
}

TEST(Daemon, APausedSceneStillPublishesItsStatus) {
  DaemonProcess daemon;
  daemon.load(running_block());
  grpc::ClientContext context;
  v1::PauseSceneRequest request;
  request.set_scene("block");
  v1::PauseSceneResponse response;
  ASSERT_TRUE(daemon.stub->PauseScene(&context, request, &response).ok());
  Reader<v1::SceneStatus> statuses(daemon.endpoint("zeromq_publish"), bus::status_key("local", "block"));
  for (int count = 0; count < 3;) {
    if (statuses.read().state() == v1::SceneStatus::STATE_PAUSED) ++count;
  }
}

/// Moves the probe into the block and waits until the feedback has a force.
void press(PoseWriter& hand, Reader<v1::ToolFeedback>& feedback) {
  hand.send("block", 1, 0.05, 0.05, 0.05);
  ASSERT_TRUE(eventually([&] { return feedback.read().force_n().y() > 0.01; }));
}

void expect_last_feedback_is_zero(Reader<v1::ToolFeedback>& feedback) {
  v1::ToolFeedback last;
  // The last feedback in the queue counts. ZeroMQ delivers the queued messages in order, even after the daemon exits.
  ASSERT_TRUE(eventually([&] {
    while (auto next = feedback.try_read()) last = *next;
    return last.has_force_n() && last.force_n().y() == 0;
  }));
  EXPECT_EQ(last.force_n().x(), 0);
  EXPECT_EQ(last.force_n().z(), 0);
  EXPECT_EQ(last.torque_n_m().x(), 0);
  ASSERT_EQ(last.local_model().stiffness_n_per_m_size(), 9);
  for (const double stiffness : last.local_model().stiffness_n_per_m()) EXPECT_EQ(stiffness, 0);
}

class StopSignal : public testing::TestWithParam<int> {};

TEST_P(StopSignal, SetsForcesToZeroAndExitsInTime) {
  DaemonProcess daemon;
  daemon.load(running_block());
  PoseWriter hand(daemon.endpoint("zeromq_pose"));
  Reader<v1::ToolFeedback> feedback(daemon.endpoint("zeromq_publish"), bus::feedback_key("local", "block", "probe"));
  press(hand, feedback);
  const auto start = Clock::now();
  daemon.process->kill(GetParam());
  EXPECT_EQ(daemon.process->wait(), 0) << daemon.log();
  EXPECT_LT(Clock::now() - start, std::chrono::seconds(2));
  expect_last_feedback_is_zero(feedback);
  EXPECT_FALSE(std::filesystem::exists(daemon.ready_file()));
  EXPECT_NE(daemon.log().find("stopped"), std::string::npos);
}

INSTANTIATE_TEST_SUITE_P(Signals, StopSignal, testing::Values(SIGTERM, SIGINT), [](const auto& test) {
  return std::string(test.param == SIGTERM ? "Terminate" : "Interrupt");
});

TEST(Daemon, UnloadingASceneSetsItsForcesToZero) {
  DaemonProcess daemon;
  daemon.load(running_block());
  PoseWriter hand(daemon.endpoint("zeromq_pose"));
  Reader<v1::ToolFeedback> feedback(daemon.endpoint("zeromq_publish"), bus::feedback_key("local", "block", "probe"));
  press(hand, feedback);
  grpc::ClientContext context;
  v1::UnloadSceneRequest request;
  request.set_scene("block");
  v1::UnloadSceneResponse response;
  ASSERT_TRUE(daemon.stub->UnloadScene(&context, request, &response).ok());
  expect_last_feedback_is_zero(feedback);
}

TEST(Daemon, ExitsInTimeDuringALongStepAndWithAStoppedClient) {
  DaemonProcess daemon;
  daemon.load(tests::block_with_probe());
  // A call that would step for minutes, and a stopped client on each transport.
  std::thread stepping([&] {
    grpc::ClientContext context;
    v1::StepSceneRequest request;
    request.set_scene("block");
    request.set_count(1'000'000);
    v1::StepSceneResponse response;
    EXPECT_EQ(daemon.stub->StepScene(&context, request, &response).error_code(), grpc::StatusCode::UNAVAILABLE);
  });
  EXPECT_TRUE(eventually([&] { return daemon.status("block").step() > 10; }));
  Process stopped(
      {BUS_SUBSCRIBER, daemon.endpoint("zeromq_publish"), daemon.endpoint("zenoh"), bus::frame_key("local", "block")},
      daemon.folder / "subscriber");
  EXPECT_TRUE(eventually([&] { return read_file(daemon.folder / "subscriber") == "r"; }));
  stopped.kill(SIGSTOP);
  const auto start = Clock::now();
  daemon.process->kill(SIGTERM);
  EXPECT_EQ(daemon.process->wait(), 0) << daemon.log();
  EXPECT_LT(Clock::now() - start, std::chrono::seconds(2));
  stepping.join();
}

TEST(Daemon, AStoppedClientDelaysNoOtherClient) {
  DaemonProcess daemon;
  v1::Scene light = tests::block_with_probe(false, 4);
  light.mutable_stepping()->set_lockstep(false);
  daemon.load(light);
  Process stopped(
      {BUS_SUBSCRIBER, daemon.endpoint("zeromq_publish"), daemon.endpoint("zenoh"), bus::frame_key("local", "block")},
      daemon.folder / "subscriber");
  ASSERT_TRUE(eventually([&] { return read_file(daemon.folder / "subscriber") == "r"; }));
  stopped.kill(SIGSTOP);
  Reader<v1::Frame> viewer(daemon.endpoint("zeromq_publish"), bus::frame_key("local", "block"));
  // Another viewer receives the frames of 200 steps while the stopped client reads nothing. A send that waited for the
  // stopped client would take seconds. The factor 2 leaves room for a busy machine.
  const auto start = Clock::now();
  const std::uint64_t first = viewer.read().step();
  while (viewer.read().step() < first + 200) continue;
  const double elapsed_s = std::chrono::duration<double>(Clock::now() - start).count();
  EXPECT_LT(elapsed_s, 2 * 200 / daemon.status("block").target_rate_hz());
}

/// Connects to the port at the end of `endpoint`, writes random bytes, and closes.
void write_garbage(const std::string& endpoint, std::uint32_t seed) {
  const int descriptor = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  address.sin_port = htons(static_cast<std::uint16_t>(std::stoi(endpoint.substr(endpoint.rfind(':') + 1))));
  ASSERT_EQ(connect(descriptor, reinterpret_cast<const sockaddr*>(&address), sizeof(address)), 0) << endpoint;
  std::mt19937 random(seed);
  std::string bytes(1000, '\0');
  for (char& byte : bytes) byte = static_cast<char>(random());
  send(descriptor, bytes.data(), bytes.size(), MSG_NOSIGNAL);
  close(descriptor);
}

TEST(Daemon, GarbageOnEveryEndpointIsCountedAndSurvived) {
  DaemonProcess daemon;
  daemon.load(running_block());
  std::uint64_t counted = 0;
  for (const char* name : {"control", "zeromq_publish", "zeromq_pose", "zenoh"}) {
    for (std::uint32_t seed = 1; seed <= 10; ++seed) write_garbage(daemon.endpoint(name), seed);
    EXPECT_TRUE(eventually([&] { return daemon.version().malformed_messages() >= counted + 10; })) << name;
    counted = daemon.version().malformed_messages();
  }
  PoseWriter hand(daemon.endpoint("zeromq_pose"));
  Reader<v1::ToolFeedback> feedback(daemon.endpoint("zeromq_publish"), bus::feedback_key("local", "block", "probe"));
  press(hand, feedback);
  EXPECT_NE(daemon.log().find("refused who="), std::string::npos) << daemon.log();
}

TEST(Daemon, AMalformedPoseIsCountedInTheStatusOfItsScene) {
  DaemonProcess daemon;
  daemon.load(running_block());
  zmq::context_t context(1);
  zmq::socket_t client(context, zmq::socket_type::push);
  client.set(zmq::sockopt::linger, 1000);
  client.connect(daemon.endpoint("zeromq_pose"));
  client.send(zmq::buffer(bus::pose_key("local", "block", "probe") + '\0' + "\xff\xff"));
  EXPECT_TRUE(eventually([&] { return daemon.status("block").poses_rejected() == 1; }));
  EXPECT_EQ(daemon.version().malformed_messages(), 1u);
}

TEST(Daemon, ASecondDaemonOnTheSamePortNamesThePort) {
  DaemonProcess first;
  Process second({TENSORMASSD, "--control", first.endpoint("control"), "--zeromq-publish", "off", "--zeromq-pose",
                  "off", "--zenoh-listen", "off"},
                 first.folder / "second");
  EXPECT_EQ(second.wait(), 1);
  const std::string log = read_file(first.folder / "second");
  EXPECT_NE(log.find(first.endpoint("control")), std::string::npos) << log;
}

TEST(Daemon, ATakenZenohPortIsReportedWithItsCauseAndNoSourcePath) {
  DaemonProcess first;
  Process second({TENSORMASSD, "--backend", "cpu", "--control", "127.0.0.1:0", "--zeromq-publish", "off",
                  "--zeromq-pose", "off", "--zenoh-listen", first.endpoint("zenoh")},
                 first.folder / "second");
  EXPECT_EQ(second.wait(), 1);
  const std::string log = read_file(first.folder / "second");
  EXPECT_NE(log.find(first.endpoint("zenoh")), std::string::npos) << log;
  EXPECT_NE(log.find("Address already in use"), std::string::npos) << log;
  EXPECT_EQ(log.find(".rs:"), std::string::npos) << log;
}

TEST(Daemon, TheReadyFileFollowsLinksAndReplacesOnlyRegularFiles) {
  TemporaryFolder folder;
  const auto arguments = [&](const std::string& ready_file) {
    return std::vector<std::string>{TENSORMASSD,
                                    "--backend",
                                    "cpu",
                                    "--control",
                                    "127.0.0.1:0",
                                    "--zeromq-publish",
                                    "off",
                                    "--zeromq-pose",
                                    "off",
                                    "--zenoh-listen",
                                    "off",
                                    "--ready-file",
                                    (folder / ready_file).string()};
  };
  ASSERT_EQ(mkfifo((folder / "fifo").c_str(), 0600), 0);
  Process refused(arguments("fifo"), folder / "log");
  EXPECT_EQ(refused.wait(), 1);
  EXPECT_NE(read_file(folder / "log").find("exists and is not a regular file"), std::string::npos);
  EXPECT_TRUE(std::filesystem::is_fifo(folder / "fifo"));

  std::ofstream(folder / "target") << "";
  std::filesystem::create_symlink(folder / "target", folder / "link");
  Process linked(arguments("link"), folder / "log");
  EXPECT_TRUE(eventually([&] { return !read_file(folder / "target").empty(); }));
  EXPECT_TRUE(std::filesystem::is_symlink(folder / "link"));
  linked.kill(SIGTERM);
  EXPECT_EQ(linked.wait(), 0);
  EXPECT_FALSE(std::filesystem::exists(folder / "target"));

  Process replaced(arguments("ready"), folder / "log");
  EXPECT_TRUE(eventually([&] { return std::filesystem::exists(folder / "ready"); }));
  std::ofstream(folder / "another") << "of another daemon";
  std::filesystem::rename(folder / "another", folder / "ready");
  replaced.kill(SIGTERM);
  EXPECT_EQ(replaced.wait(), 0);
  EXPECT_EQ(read_file(folder / "ready"), "of another daemon");
}

TEST(Daemon, ItsThreadsHaveNames) {
  TemporaryFolder folder;
  DaemonProcess daemon({"--state", (folder / "state").string(), "--metrics", "127.0.0.1:0"});
  daemon.load(running_block());
  const std::string own = "/proc/" + std::to_string(daemon.process->id()) + "/";
  const std::string program = read_file(own + "comm");
  std::set<std::string> names;
  int without = 0;
  for (const auto& thread : std::filesystem::directory_iterator(own + "task")) {
    const std::string name = read_file(thread.path() / "comm");
    names.insert(name.substr(0, name.size() - 1));
    without += name == program;
  }
  for (const char* name :
       {"doorkeeper", "relay", "publisher", "vitals", "metrics", "zeromq poses", "loop block", "keep block"}) {
    EXPECT_TRUE(names.contains(name)) << name << " of " << testing::PrintToString(names);
  }
  EXPECT_LE(without, 1) << "the main thread alone has the program's name: " << testing::PrintToString(names);
}

TEST(Daemon, LogsJson) {
  DaemonProcess daemon({"--log-format", "json"});
  daemon.process->kill(SIGTERM);
  daemon.process->wait();
  std::istringstream lines(daemon.log());
  int count = 0;
  for (std::string line; std::getline(lines, line); ++count) {
    google::protobuf::Struct object;
    ASSERT_TRUE(google::protobuf::util::JsonStringToMessage(line, &object).ok()) << line;
    EXPECT_FALSE(object.fields().at("time").string_value().empty());
    EXPECT_FALSE(object.fields().at("event").string_value().empty());
  }
  EXPECT_GE(count, 3);
}

}  // namespace
}  // namespace tensormass::daemon_tests
