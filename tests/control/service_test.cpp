#include <algorithm>
#include <atomic>
#include <chrono>
#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include <fmt/format.h>
#include <grpcpp/generic/generic_stub.h>
#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include "control/control_server.h"
#include "core/limits.h"
#include "support/grpc_channel.h"
#include "support/scenes.h"
#include "tensormass/v1/control.grpc.pb.h"

namespace tensormass::control {
namespace {

constexpr std::chrono::seconds kDeadline{60};

/// A server on a free port, and a client connected to it.
class ServiceTest : public testing::Test {
 protected:
  ServiceTest() {
    auto started = start("127.0.0.1:0");
    if (!started) throw std::runtime_error(started.error().message);
    server = std::move(*started);
    channel = tests::connected_channel(server->endpoint());
    stub = v1::Control::NewStub(channel);
  }

  Result<std::unique_ptr<ControlServer>> start(const std::string& address) {
    return ControlServer::start(
        address, registry, identity(), [] { return std::uint64_t{7}; },
        {.connection = [this](auto&&...) { ++refused; },
         .call =
             [this](bool by_role, const Refused& call) {
               const std::lock_guard lock(mutex);
               told.push_back(fmt::format("{} {} {} {}", by_role, call.what, call.scene, call.reason));
             }},
        nullptr, [] { return std::string("x 1\n"); });
  }

  static v1::GetVersionResponse identity() {
    v1::GetVersionResponse response;
    response.set_server("test");
    response.set_zenoh_locator("tcp/127.0.0.1:1");
    return response;
  }

  template <class Request, class Response>
  grpc::Status call(grpc::Status (v1::Control::Stub::*method)(grpc::ClientContext*, const Request&, Response*),
                    const Request& request, Response& response) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + kDeadline);
    return (stub.get()->*method)(&context, request, &response);
  }

  /// Calls and returns the status code alone. Checks that every error has a message.
  template <class Request, class Response>
  grpc::StatusCode code(grpc::Status (v1::Control::Stub::*method)(grpc::ClientContext*, const Request&, Response*),
                        const Request& request) {
    Response response;
    const grpc::Status status = call(method, request, response);
    EXPECT_EQ(status.ok(), status.error_message().empty()) << status.error_message();
    return status.error_code();
  }

  v1::SceneReport load(const v1::Scene& scene) {
    v1::LoadSceneRequest request;
    *request.mutable_scene() = scene;
    v1::LoadSceneResponse response;
    const grpc::Status status = call(&v1::Control::Stub::LoadScene, request, response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response.report();
  }

  template <class Request>
  static Request of_scene(const std::string& name) {
    Request request;
    request.set_scene(name);
    return request;
  }

  SceneRegistry registry{{.backend = world::BackendChoice::kCpu, .cpu_threads = 1}, [] {}};
  std::atomic<int> refused{0};
  std::mutex mutex;
  std::vector<std::string> told;  // guarded by mutex
  std::unique_ptr<ControlServer> server;
  std::shared_ptr<grpc::Channel> channel;
  std::unique_ptr<v1::Control::Stub> stub;
};

using Stub = v1::Control::Stub;

TEST_F(ServiceTest, GetMetricsReturnsTheText) {
  v1::GetMetricsResponse response;
  ASSERT_TRUE(call(&Stub::GetMetrics, v1::GetMetricsRequest(), response).ok());
  EXPECT_EQ(response.text(), "x 1\n");
}

TEST_F(ServiceTest, TellsOfEachCallThatIsRefused) {
  EXPECT_EQ(code(&Stub::StepScene, of_scene<v1::StepSceneRequest>("liver")), grpc::StatusCode::INVALID_ARGUMENT);
  v1::InspectSceneRequest inspected;
  inspected.mutable_scene()->set_name("kidney");
  EXPECT_EQ(code(&Stub::InspectScene, inspected), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_EQ(code(&Stub::GetStatus, of_scene<v1::GetStatusRequest>("absent")), grpc::StatusCode::NOT_FOUND);
  const std::lock_guard lock(mutex);
  ASSERT_EQ(told.size(), 2u) << "a client that waits for its scene asks again and again";
  EXPECT_TRUE(told[0].starts_with("false tensormass.v1.Control/StepScene liver count: 0 is not within")) << told[0];
  EXPECT_TRUE(told[1].starts_with("false tensormass.v1.Control/InspectScene kidney ")) << told[1];
}

TEST_F(ServiceTest, GetVersionReturnsTheIdentity) {
  v1::GetVersionResponse response;
  ASSERT_TRUE(call(&Stub::GetVersion, v1::GetVersionRequest(), response).ok());
  EXPECT_EQ(response.server(), "test");
  EXPECT_EQ(response.zenoh_locator(), "tcp/127.0.0.1:1");
  EXPECT_EQ(response.malformed_messages(), 7u);
}

TEST_F(ServiceTest, StreamsTheProgressOfALoadAndThenItsReport) {
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + kDeadline);
  v1::LoadSceneRequest request;
  *request.mutable_scene() = tests::block_with_probe();
  const auto reader = stub->LoadSceneWithProgress(&context, request);
  v1::LoadSceneWithProgressResponse message;
  double fraction = 0;
  int parts = 0;
  while (reader->Read(&message)) {
    EXPECT_GE(message.fraction(), fraction);
    EXPECT_EQ(message.has_report(), message.part().empty());
    fraction = message.fraction();
    ++parts;
  }
  EXPECT_TRUE(reader->Finish().ok());
  EXPECT_GE(parts, 7);
  EXPECT_EQ(fraction, 1);
  EXPECT_EQ(message.report().scene(), "block");
  EXPECT_TRUE(registry.find("block"));
}

TEST_F(ServiceTest, ALoadEndsWhenItsClientCancels) {
  v1::LoadSceneRequest request;
  *request.mutable_scene() = tests::beam_scene({.cells_x = 60, .cells_y = 12, .cells_z = 10});
  {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + kDeadline);
    const auto reader = stub->LoadSceneWithProgress(&context, request);
    v1::LoadSceneWithProgressResponse message;
    ASSERT_TRUE(reader->Read(&message));
    context.TryCancel();
    EXPECT_EQ(reader->Finish().error_code(), grpc::StatusCode::CANCELLED);
  }
  // The name stays reserved until the running part of the load ends.
  grpc::StatusCode again = grpc::StatusCode::ALREADY_EXISTS;
  const auto deadline = std::chrono::steady_clock::now() + kDeadline;
  while (again == grpc::StatusCode::ALREADY_EXISTS && std::chrono::steady_clock::now() < deadline) {
    again = code<v1::LoadSceneRequest, v1::LoadSceneResponse>(&Stub::LoadScene, request);
    std::this_thread::yield();
  }
  EXPECT_EQ(again, grpc::StatusCode::OK);
}

TEST_F(ServiceTest, ALockstepSceneFromLoadToUnload) {
  const v1::SceneReport report = load(tests::block_with_probe());
  EXPECT_EQ(report.scene(), "block");
  ASSERT_EQ(report.bodies_size(), 1);

  v1::StepSceneRequest steps = of_scene<v1::StepSceneRequest>("block");
  steps.set_count(20);
  v1::StepSceneResponse stepped;
  ASSERT_TRUE(call(&Stub::StepScene, steps, stepped).ok());
  EXPECT_EQ(stepped.status().step(), 20u);
  EXPECT_EQ(stepped.status().state(), v1::SceneStatus::STATE_LOCKSTEP);

  v1::GetTopologyResponse topology;
  ASSERT_TRUE(call(&Stub::GetTopology, of_scene<v1::GetTopologyRequest>("block"), topology).ok());
  ASSERT_EQ(topology.topology().bodies_size(), 1);
  v1::GetFrameResponse frame;
  ASSERT_TRUE(call(&Stub::GetFrame, of_scene<v1::GetFrameRequest>("block"), frame).ok());
  EXPECT_EQ(frame.frame().positions().size(), 12 * topology.topology().bodies(0).vertex_count());
  EXPECT_EQ(frame.frame().step(), 20u);

  v1::GetPositionsRequest where = of_scene<v1::GetPositionsRequest>("block");
  where.set_body("beam");
  v1::GetPositionsResponse positions;
  ASSERT_TRUE(call(&Stub::GetPositions, where, positions).ok());
  EXPECT_EQ(positions.positions().size(), 24 * std::size_t{report.bodies(0).node_count()});
  EXPECT_EQ(positions.step(), 20u);

  // Moves the probe 20 mm down into the tissue, which pushes back.
  v1::MoveToolRequest move = of_scene<v1::MoveToolRequest>("block");
  move.set_tool("probe");
  move.mutable_pose()->set_sequence(1);
  tests::set(*move.mutable_pose()->mutable_position_m(), 0.05, 0.05, 0.05);
  v1::MoveToolResponse moved;
  ASSERT_TRUE(call(&Stub::MoveTool, move, moved).ok());
  ASSERT_TRUE(call(&Stub::StepScene, steps, stepped).ok());
  v1::GetFeedbackRequest ask = of_scene<v1::GetFeedbackRequest>("block");
  ask.set_tool("probe");
  v1::GetFeedbackResponse feedback;
  ASSERT_TRUE(call(&Stub::GetFeedback, ask, feedback).ok());
  EXPECT_EQ(feedback.feedback().pose_sequence(), 1u);
  EXPECT_GT(feedback.feedback().force_n().y(), 0);

  v1::ResetSceneResponse reset;
  ASSERT_TRUE(call(&Stub::ResetScene, of_scene<v1::ResetSceneRequest>("block"), reset).ok());
  EXPECT_EQ(reset.status().step(), 0u);

  v1::ListScenesResponse list;
  ASSERT_TRUE(call(&Stub::ListScenes, v1::ListScenesRequest(), list).ok());
  ASSERT_EQ(list.scenes_size(), 1);
  EXPECT_EQ(list.scenes(0).scene(), "block");
  EXPECT_EQ(code(&Stub::UnloadScene, of_scene<v1::UnloadSceneRequest>("block")), grpc::StatusCode::OK);
  ASSERT_TRUE(call(&Stub::ListScenes, v1::ListScenesRequest(), list).ok());
  EXPECT_EQ(list.scenes_size(), 0);
}

TEST_F(ServiceTest, PausesAndResumesARunningScene) {
  v1::Scene scene = tests::block_with_probe();
  scene.mutable_stepping()->set_lockstep(false);
  load(scene);
  v1::PauseSceneResponse paused;
  ASSERT_TRUE(call(&Stub::PauseScene, of_scene<v1::PauseSceneRequest>("block"), paused).ok());
  EXPECT_EQ(paused.status().state(), v1::SceneStatus::STATE_PAUSED);
  v1::GetStatusResponse status;
  ASSERT_TRUE(call(&Stub::GetStatus, of_scene<v1::GetStatusRequest>("block"), status).ok());
  EXPECT_EQ(status.status().step(), paused.status().step());
  v1::ResumeSceneResponse resumed;
  ASSERT_TRUE(call(&Stub::ResumeScene, of_scene<v1::ResumeSceneRequest>("block"), resumed).ok());
  const auto deadline = std::chrono::steady_clock::now() + kDeadline;
  do {
    ASSERT_TRUE(call(&Stub::GetStatus, of_scene<v1::GetStatusRequest>("block"), status).ok());
  } while (status.status().step() == paused.status().step() && std::chrono::steady_clock::now() < deadline);
  EXPECT_GT(status.status().step(), paused.status().step());
}

TEST_F(ServiceTest, InspectsWithoutLoading) {
  v1::InspectSceneRequest request;
  *request.mutable_scene() = tests::block_with_probe();
  v1::InspectSceneResponse response;
  ASSERT_TRUE(call(&Stub::InspectScene, request, response).ok());
  EXPECT_GT(response.report().stages_size(), 0);
  EXPECT_TRUE(registry.list().empty());
  request.mutable_scene()->mutable_bodies(0)->clear_law();
  EXPECT_EQ(code(&Stub::InspectScene, request), grpc::StatusCode::INVALID_ARGUMENT);
}

v1::RecordSceneRequest recording_of(const std::string& scene) {
  v1::RecordSceneRequest request;
  request.set_scene(scene);
  request.set_check_every_steps(10);
  request.set_reset(true);
  return request;
}

TEST_F(ServiceTest, ARecordingStreamsStepsUntilItsSceneIsUnloaded) {
  load(tests::block_with_probe(false, 4));
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + kDeadline);
  const auto reader = stub->RecordScene(&context, recording_of("block"));
  v1::RecordSceneResponse message;
  ASSERT_TRUE(reader->Read(&message));
  EXPECT_EQ(message.start().scene(), "block");
  EXPECT_EQ(message.start().backend(), "cpu");
  EXPECT_NE(message.start().scene_hash(), 0u);
  auto request = of_scene<v1::StepSceneRequest>("block");
  request.set_count(30);
  v1::StepSceneResponse stepped;
  ASSERT_TRUE(call(&Stub::StepScene, request, stepped).ok());
  ASSERT_TRUE(registry.unload("block"));
  std::uint64_t steps = 0, checks = 0;
  while (reader->Read(&message)) {
    EXPECT_FALSE(message.has_start());
    EXPECT_EQ(message.lost_size(), 0);
    for (const v1::RecordedStep& step : message.steps()) EXPECT_EQ(step.index(), ++steps);
    checks += static_cast<std::uint64_t>(message.checks_size());
  }
  EXPECT_TRUE(reader->Finish().ok());
  EXPECT_EQ(steps, 30u);
  EXPECT_EQ(checks, 3u);
}

TEST_F(ServiceTest, ARecordingEndsWhenItsClientCancels) {
  load(tests::block_with_probe(false, 4));
  {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + kDeadline);
    const auto reader = stub->RecordScene(&context, recording_of("block"));
    v1::RecordSceneResponse message;
    ASSERT_TRUE(reader->Read(&message));
    context.TryCancel();
    EXPECT_EQ(reader->Finish().error_code(), grpc::StatusCode::CANCELLED);
  }
  // The call notices the cancellation when it looks again.
  const auto deadline = std::chrono::steady_clock::now() + kDeadline;
  bool again = false;
  while (!again && std::chrono::steady_clock::now() < deadline) {
    grpc::ClientContext context;
    context.set_deadline(std::chrono::system_clock::now() + kDeadline);
    const auto reader = stub->RecordScene(&context, recording_of("block"));
    v1::RecordSceneResponse message;
    again = reader->Read(&message);
    if (again) context.TryCancel();
    const grpc::Status status = reader->Finish();
    EXPECT_EQ(status.error_code(), again ? grpc::StatusCode::CANCELLED : grpc::StatusCode::FAILED_PRECONDITION);
    std::this_thread::yield();
  }
  EXPECT_TRUE(again);
}

TEST_F(ServiceTest, EveryCallReportsAnUnknownScene) {
  using grpc::StatusCode;
  v1::StepSceneRequest step = of_scene<v1::StepSceneRequest>("none");
  step.set_count(1);
  EXPECT_EQ(code(&Stub::StepScene, step), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::UnloadScene, of_scene<v1::UnloadSceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::PauseScene, of_scene<v1::PauseSceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::ResumeScene, of_scene<v1::ResumeSceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::ResetScene, of_scene<v1::ResetSceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::GetTopology, of_scene<v1::GetTopologyRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::GetFrame, of_scene<v1::GetFrameRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::GetPositions, of_scene<v1::GetPositionsRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::GetStatus, of_scene<v1::GetStatusRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::MoveTool, of_scene<v1::MoveToolRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::GetFeedback, of_scene<v1::GetFeedbackRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::ReplayScene, of_scene<v1::ReplaySceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::SnapshotScene, of_scene<v1::SnapshotSceneRequest>("none")), StatusCode::NOT_FOUND);
  EXPECT_EQ(code(&Stub::RestoreScene, of_scene<v1::RestoreSceneRequest>("none")), StatusCode::NOT_FOUND);
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + kDeadline);
  EXPECT_EQ(stub->RecordScene(&context, recording_of("none"))->Finish().error_code(), StatusCode::NOT_FOUND);
}

TEST_F(ServiceTest, RefusesInvalidRequests) {
  load(tests::block_with_probe());
  v1::LoadSceneRequest again;
  *again.mutable_scene() = tests::block_with_probe();
  EXPECT_EQ(code(&Stub::LoadScene, again), grpc::StatusCode::ALREADY_EXISTS);
  EXPECT_EQ(code(&Stub::LoadScene, v1::LoadSceneRequest()), grpc::StatusCode::INVALID_ARGUMENT);

  v1::StepSceneRequest step = of_scene<v1::StepSceneRequest>("block");
  EXPECT_EQ(code(&Stub::StepScene, step), grpc::StatusCode::INVALID_ARGUMENT);
  step.set_count(limits::kMaxStepsPerCall + 1);
  EXPECT_EQ(code(&Stub::StepScene, step), grpc::StatusCode::INVALID_ARGUMENT);
  EXPECT_EQ(code(&Stub::PauseScene, of_scene<v1::PauseSceneRequest>("block")), grpc::StatusCode::FAILED_PRECONDITION);

  v1::GetPositionsRequest body = of_scene<v1::GetPositionsRequest>("block");
  body.set_body("none");
  EXPECT_EQ(code(&Stub::GetPositions, body), grpc::StatusCode::NOT_FOUND);
  v1::MoveToolRequest move = of_scene<v1::MoveToolRequest>("block");
  move.set_tool("none");
  EXPECT_EQ(code(&Stub::MoveTool, move), grpc::StatusCode::NOT_FOUND);
  move.set_tool("probe");
  move.mutable_pose()->set_sequence(1);
  tests::set(*move.mutable_pose()->mutable_position_m(), std::numeric_limits<double>::quiet_NaN(), 0, 0);
  EXPECT_EQ(code(&Stub::MoveTool, move), grpc::StatusCode::INVALID_ARGUMENT);
}

TEST_F(ServiceTest, RefusesAQuaternionWhoseSquaredLengthUnderflows) {
  v1::Scene scene = tests::block_with_probe();
  load(scene);
  v1::MoveToolRequest move = of_scene<v1::MoveToolRequest>("block");
  move.set_tool("probe");
  move.mutable_pose()->set_sequence(1);
  tests::set(*move.mutable_pose()->mutable_position_m(), 0.05, 0.05, 0.05);
  move.mutable_pose()->mutable_orientation()->set_w(1e-300);
  EXPECT_EQ(code(&Stub::MoveTool, move), grpc::StatusCode::INVALID_ARGUMENT);
  move.mutable_pose()->mutable_orientation()->set_w(0);  // all four zero: not given
  EXPECT_EQ(code(&Stub::MoveTool, move), grpc::StatusCode::OK);

  v1::LoadSceneRequest request;
  scene.set_name("another");
  scene.mutable_tools(0)->mutable_orientation()->set_x(1e-300);
  *request.mutable_scene() = scene;
  EXPECT_EQ(code(&Stub::LoadScene, request), grpc::StatusCode::INVALID_ARGUMENT);
}

/// A StepScene call that would take minutes.
class LongStep {
 public:
  explicit LongStep(v1::Control::Stub& stub) {
    v1::StepSceneRequest request;
    request.set_scene("block");
    request.set_count(limits::kMaxStepsPerCall);
    thread_ = std::thread([this, &stub, request] {
      v1::StepSceneResponse response;
      status_ = stub.StepScene(&context_, request, &response);
      ended_ = true;
    });
  }
  void cancel() { context_.TryCancel(); }
  bool has_ended() const { return ended_; }
  grpc::Status wait() {
    thread_.join();
    return status_;
  }

 private:
  grpc::ClientContext context_;
  grpc::Status status_;
  std::atomic<bool> ended_{false};
  std::thread thread_;
};

TEST_F(ServiceTest, ALongStepEndsWhenItsSceneIsUnloaded) {
  load(tests::block_with_probe());
  const std::weak_ptr<world::Runner> runner = *registry.find("block");
  LongStep step(*stub);
  while (runner.lock()->status().step() < 10) std::this_thread::yield();
  EXPECT_EQ(code(&Stub::UnloadScene, of_scene<v1::UnloadSceneRequest>("block")), grpc::StatusCode::OK);
  const grpc::Status status = step.wait();
  EXPECT_EQ(status.error_code(), grpc::StatusCode::UNAVAILABLE) << status.error_message();
  EXPECT_NE(status.error_message().find("unloaded"), std::string::npos) << status.error_message();
}

TEST_F(ServiceTest, ALongStepEndsWhenItsClientCancels) {
  load(tests::block_with_probe());
  LongStep step(*stub);
  while ((*registry.find("block"))->status().step() < 10) std::this_thread::yield();
  step.cancel();
  EXPECT_EQ(step.wait().error_code(), grpc::StatusCode::CANCELLED);
  // The scene is free again. This step waits for the rest of one turn of the long call, not for minutes.
  v1::StepSceneRequest one = of_scene<v1::StepSceneRequest>("block");
  one.set_count(1);
  const auto start = std::chrono::steady_clock::now();
  EXPECT_EQ(code(&Stub::StepScene, one), grpc::StatusCode::OK);
  EXPECT_LT(std::chrono::steady_clock::now() - start, std::chrono::seconds(5));
}

TEST_F(ServiceTest, CallsBeyondTheThreadLimitAreRefusedAsExhausted) {
  load(tests::block_with_probe());
  std::vector<std::unique_ptr<LongStep>> calls;
  for (int i = 0; i < 100; ++i) calls.push_back(std::make_unique<LongStep>(*stub));
  const auto deadline = std::chrono::steady_clock::now() + kDeadline;
  const auto has_ended = [](const auto& call) { return call->has_ended(); };
  while (std::none_of(calls.begin(), calls.end(), has_ended) && std::chrono::steady_clock::now() < deadline) {
    std::this_thread::yield();
  }
  for (const auto& call : calls) call->cancel();
  int exhausted = 0;
  for (const auto& call : calls) {
    const grpc::StatusCode code = call->wait().error_code();
    exhausted += code == grpc::StatusCode::RESOURCE_EXHAUSTED ? 1 : 0;
    EXPECT_TRUE(code == grpc::StatusCode::RESOURCE_EXHAUSTED || code == grpc::StatusCode::CANCELLED) << code;
  }
  EXPECT_GT(exhausted, 0);
}

struct RawAnswer {
  grpc::Status status;
  std::string message;
};

/// Sends `request` as the bytes of a call, without generated code: any method, any bytes.
RawAnswer raw_call(const std::shared_ptr<grpc::Channel>& channel, const std::string& method,
                   const std::string& request) {
  grpc::GenericStub generic(channel);
  grpc::ClientContext context;
  context.set_deadline(std::chrono::system_clock::now() + kDeadline);
  grpc::CompletionQueue queue;
  const auto finished = [&queue] {
    void* tag = nullptr;
    bool good = false;
    return queue.Next(&tag, &good) && good;
  };
  const auto stream = generic.PrepareCall(&context, method, &queue);
  stream->StartCall(nullptr);
  EXPECT_TRUE(finished());
  const grpc::Slice slice(request);
  stream->WriteLast(grpc::ByteBuffer(&slice, 1), grpc::WriteOptions(), nullptr);
  EXPECT_TRUE(finished());
  grpc::ByteBuffer answer;
  stream->Read(&answer, nullptr);
  const bool answered = finished();
  RawAnswer result;
  stream->Finish(&result.status, nullptr);
  EXPECT_TRUE(finished());
  EXPECT_EQ(answered, result.status.ok()) << result.status.error_message();
  grpc::Slice joined;
  if (answered && answer.Valid() && answer.DumpToSingleSlice(&joined).ok()) {
    result.message.assign(reinterpret_cast<const char*>(joined.begin()), joined.size());
  }
  return result;
}

TEST_F(ServiceTest, RefusesBytesThatAreNotProtobufAndNamesTheCall) {
  const google::protobuf::ServiceDescriptor* control =
      google::protobuf::DescriptorPool::generated_pool()->FindServiceByName(v1::Control::service_full_name());
  ASSERT_NE(control, nullptr);
  // The second is StepSceneRequest { scene: "\xff" }: text that is not UTF-8.
  const std::string not_protobuf = "\xff\xff\xff", not_utf8 = "\x0a\x01\xff";
  for (int i = 0; i < control->method_count(); ++i) {
    const std::string call = v1::Control::service_full_name() + ("/" + control->method(i)->name());
    const grpc::Status status = raw_call(channel, "/" + call, not_protobuf).status;
    EXPECT_EQ(status.error_code(), grpc::StatusCode::INVALID_ARGUMENT) << call;
    EXPECT_TRUE(status.error_message().starts_with(call + ": ")) << call << " says '" << status.error_message() << "'";
  }
  EXPECT_EQ(raw_call(channel, "/tensormass.v1.Control/StepScene", not_utf8).status.error_code(),
            grpc::StatusCode::INVALID_ARGUMENT);
}

TEST_F(ServiceTest, HealthIsServingUntilShutdownIsAnnounced) {
  // HealthCheckResponse { status: SERVING }, then NOT_SERVING.
  EXPECT_EQ(raw_call(channel, "/grpc.health.v1.Health/Check", "").message, "\x08\x01");
  server->announce_shutdown();
  EXPECT_EQ(raw_call(channel, "/grpc.health.v1.Health/Check", "").message, "\x08\x02");
}

TEST_F(ServiceTest, ReflectionListsTheService) {
  // ServerReflectionRequest { list_services: "" }
  const std::string request("\x3a\x00", 2);
  const std::string answer =
      raw_call(channel, "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", request).message;
  EXPECT_NE(answer.find("tensormass.v1.Control"), std::string::npos);
}

TEST_F(ServiceTest, ASecondServerOnThePortIsRefused) {
  const auto second = start(server->endpoint());
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, ErrorCode::kUnavailable);
  EXPECT_NE(second.error().message.find(server->endpoint()), std::string::npos);
}

}  // namespace
}  // namespace tensormass::control
