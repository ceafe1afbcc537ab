#include "haptic/discovery.h"

#include <algorithm>
#include <chrono>
#include <limits>

#include <grpcpp/grpcpp.h>

#include "bus/keys.h"
#include "core/limits.h"
#include "haptic/vector.h"
#include "tensormass/v1/control.grpc.pb.h"

namespace tensormass::haptic {
namespace {

/// Interval at which a call checks `stop`.
constexpr auto kStopPoll = std::chrono::milliseconds(20);
/// Assumed size of the tissue in radii of its tool: 0.2 m for a probe of 1 cm.
constexpr double kExtentInRadii = 20.0;
/// Below this distance single-precision positions give no direction.
constexpr double kNoDistanceM = 1e-6;
/// The name in every server's certificate, under whatever address it is reached.
constexpr const char* kDaemonName = "tensormassd";

/// Returns the host of a gRPC target that ends in host:port. An IPv6 address keeps its brackets.
std::string host_of(const std::string& target) {
  const std::size_t open = target.rfind('['), close = target.rfind(']');
  if (open != std::string::npos && close != std::string::npos && open < close) {
    return target.substr(open, close - open + 1);
  }
  const std::string host = target.substr(0, target.rfind(':'));
  return host.substr(host.find_last_of("/:") + 1);
}

using Stub = v1::Control::Stub;

template <class Request, class Response>
using Method = std::unique_ptr<grpc::ClientAsyncResponseReader<Response>> (Stub::*)(grpc::ClientContext*,
                                                                                    const Request&,
                                                                                    grpc::CompletionQueue*);

/// Calls to one server that share one deadline.
class Caller {
 public:
  Caller(const std::string& control, const Patience& patience) : control_(control), stop_(patience.stop) {
    deadline_ = std::chrono::system_clock::now() + std::chrono::duration_cast<std::chrono::system_clock::duration>(
                                                       std::chrono::duration<double>(patience.timeout_s));
    grpc::ChannelArguments arguments;
    // The streams use no proxy, so the calls must not either: both have to reach the same server.
    arguments.SetInt(GRPC_ARG_ENABLE_HTTP_PROXY, 0);
    arguments.SetMaxReceiveMessageSize(static_cast<int>(limits::kMaxControlMessageBytes));
    std::shared_ptr<grpc::ChannelCredentials> credentials = grpc::InsecureChannelCredentials();
    if (const ClientKeys& keys = patience.keys; keys) {
      credentials = grpc::SslCredentials({keys.authority, keys.private_key, keys.certificate});
      arguments.SetSslTargetNameOverride(kDaemonName);
    }
    stub_ = v1::Control::NewStub(grpc::CreateCustomChannel(control, credentials, arguments));
  }

  /// `method`: the stub's asynchronous variant. A blocking call could not be ended by `stop`.
  template <class Request, class Response>
  Result<Response> call(Method<Request, Response> method, const Request& request) {
    grpc::ClientContext context;
    context.set_deadline(deadline_);
    context.set_wait_for_ready(true);
    Response response;
    grpc::Status status;
    grpc::CompletionQueue queue;
    const auto reader = (stub_.get()->*method)(&context, request, &queue);
    reader->Finish(&response, &status, nullptr);
    void* tag = nullptr;
    bool good = false;
    while (queue.AsyncNext(&tag, &good, std::chrono::system_clock::now() + kStopPoll) ==
           grpc::CompletionQueue::TIMEOUT) {
      if (stop_) context.TryCancel();  // the next event then ends the call
    }
    if (status.ok()) return response;
    if (stop_) return fail(ErrorCode::kCancelled, "ended before the server at " + control_ + " answered");
    if (status.error_code() == grpc::StatusCode::DEADLINE_EXCEEDED) {
      return fail(ErrorCode::kUnavailable,
                  "no answer from a server at " + control_ + "; is tensormassd running there?");
    }
    return fail(error_code_of(status), "the server at " + control_ + " says: " + status.error_message());
  }

  Result<v1::SceneStatus> status(const std::string& scene) {
    v1::GetStatusRequest request;
    request.set_scene(scene);
    auto answer = call(&Stub::AsyncGetStatus, request);
    if (!answer) return tl::make_unexpected(std::move(answer.error()));
    return std::move(*answer->mutable_status());
  }

 private:
  static ErrorCode error_code_of(const grpc::Status& status) {
    switch (status.error_code()) {
      case grpc::StatusCode::NOT_FOUND:
        return ErrorCode::kNotFound;
      case grpc::StatusCode::FAILED_PRECONDITION:
        return ErrorCode::kFailedPrecondition;
      default:
        return ErrorCode::kUnavailable;
    }
  }

  std::string control_;
  const std::atomic<bool>& stop_;
  std::chrono::system_clock::time_point deadline_;
  std::unique_ptr<v1::Control::Stub> stub_;
};

using Positions = Eigen::Matrix<float, 3, Eigen::Dynamic>;

Result<Positions> read_positions(const Surface& surface) {
  Positions positions(3, static_cast<Eigen::Index>(surface.positions.size() / (3 * sizeof(float))));
  std::copy_n(surface.positions.data(), positions.size() * sizeof(float), reinterpret_cast<char*>(positions.data()));
  if (!positions.allFinite()) {
    return fail(ErrorCode::kFailedPrecondition, "the scene's surface is not finite; reset the scene");
  }
  return positions;
}

Result<v1::ToolShape> find_tool(const v1::Topology& topology, const std::string& tool) {
  std::string names;
  for (const v1::ToolShape& shape : topology.tools()) {
    if (shape.name() == tool) return shape;
    names += (names.empty() ? "" : ", ") + shape.name();
  }
  return fail(ErrorCode::kNotFound, "scene " + topology.scene() + " has no tool " + tool +
                                        (names.empty() ? "; it has none" : "; it has " + names));
}

}  // namespace

Result<DiscoveredTool> discover_tool(const std::string& control, const std::string& scene, const std::string& tool,
                                     Patience patience) {
  Caller caller(control, patience);
  auto version = caller.call(&Stub::AsyncGetVersion, v1::GetVersionRequest{});
  if (!version) return tl::make_unexpected(version.error());

  v1::GetTopologyRequest topology_request;
  topology_request.set_scene(scene);
  const auto topology = caller.call(&Stub::AsyncGetTopology, topology_request);
  if (!topology) return tl::make_unexpected(topology.error());
  const Result<v1::ToolShape> shape = find_tool(topology->topology(), tool);
  if (!shape) return tl::make_unexpected(shape.error());

  v1::GetFeedbackRequest feedback_request;
  feedback_request.set_scene(scene);
  feedback_request.set_tool(tool);
  const auto feedback = caller.call(&Stub::AsyncGetFeedback, feedback_request);
  if (!feedback) return tl::make_unexpected(feedback.error());

  const Result<v1::SceneStatus> status = caller.status(scene);
  if (!status) return tl::make_unexpected(status.error());

  DiscoveredTool found;
  found.address.pose_key = bus::pose_key(version->server(), scene, tool);
  found.address.feedback_key = bus::feedback_key(version->server(), scene, tool);
  found.address.zeromq_pose_endpoint = reached_endpoint(version->zeromq_pose_endpoint(), control);
  found.address.zeromq_publish_endpoint = reached_endpoint(version->zeromq_publish_endpoint(), control);
  found.address.zenoh_locator = reached_endpoint(version->zenoh_locator(), control);
  found.address.keys = patience.keys;
  found.server = std::move(*version);
  found.tool_position_m = to_eigen(feedback->feedback().position_m());
  found.radius_m = shape->radius_m();
  found.tip_offset_m = to_eigen(shape->tip_offset_m());
  found.has_jaws = feedback->feedback().joint_values_size() == 1;
  found.has_power = shape->tool().has_cautery();
  found.poses_rejected = status->poses_rejected();
  return found;
}

Result<Surface> fetch_surface(const std::string& control, const std::string& scene, Patience patience) {
  v1::GetFrameRequest request;
  request.set_scene(scene);
  auto frame = Caller(control, patience).call(&Stub::AsyncGetFrame, request);
  if (frame) return Surface{std::move(*frame->mutable_frame()->mutable_positions()), {}};
  if (frame.error().code != ErrorCode::kFailedPrecondition) return tl::make_unexpected(frame.error());
  return Surface{{}, std::move(frame.error().message)};
}

Result<v1::SceneStatus> fetch_status(const std::string& control, const std::string& scene, Patience patience) {
  return Caller(control, patience).status(scene);
}

std::string reached_endpoint(const std::string& endpoint, const std::string& control) {
  // tcp://host:port of ZeroMQ, tcp/host:port of zenoh.
  const std::size_t slash = endpoint.find('/'), colon = endpoint.rfind(':');
  if (slash == std::string::npos || colon == std::string::npos) return endpoint;
  const std::size_t begin = endpoint.compare(slash, 2, "//") == 0 ? slash + 2 : slash + 1;
  if (colon < begin) return endpoint;
  const std::string host = endpoint.substr(begin, colon - begin);
  if (host != "0.0.0.0" && host != "[::]" && host != "*") return endpoint;
  const std::string reached = host_of(control);
  return reached.empty() ? endpoint : endpoint.substr(0, begin) + reached + endpoint.substr(colon);
}

Result<Aim> aim_at_nearest_surface(const DiscoveredTool& tool, const Surface& surface) {
  const Result<Positions> positions = read_positions(surface);
  if (!positions) return tl::make_unexpected(positions.error());
  if (positions->cols() == 0) {
    return fail(ErrorCode::kFailedPrecondition, "the scene has no surface to press" +
                                                    (surface.absence.empty() ? "" : " (" + surface.absence + ")") +
                                                    "; give --press-at and --direction");
  }
  const Eigen::Vector3d center = tool.tool_position_m + tool.tip_offset_m;
  Eigen::Index nearest = 0;
  (positions->colwise() - center.cast<float>()).colwise().squaredNorm().minCoeff(&nearest);
  const Eigen::Vector3d way = positions->col(nearest).cast<double>() - center;
  const double distance = way.norm();
  if (distance < kNoDistanceM) {
    return fail(ErrorCode::kFailedPrecondition,
                "the tool stands on the tissue, so no direction to press follows from it; give --press-at and "
                "--direction");
  }
  Aim aim;
  aim.direction = way / distance;
  // A tool that touches already starts its press at its own position.
  aim.contact_m = tool.tool_position_m + std::max(0.0, distance - tool.radius_m) * aim.direction;
  return aim;
}

Result<double> extent_of(const Surface& surface, const DiscoveredTool& tool) {
  const Result<Positions> positions = read_positions(surface);
  if (!positions) return tl::make_unexpected(positions.error());
  if (positions->cols() == 0) return kExtentInRadii * tool.radius_m;
  return (positions->rowwise().maxCoeff() - positions->rowwise().minCoeff()).cast<double>().norm();
}

}  // namespace tensormass::haptic
