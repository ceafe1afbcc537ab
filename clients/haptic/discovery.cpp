#include "haptic/discovery.h"

#include <algorithm>
#include <chrono>
#include <limits>

#include <grpcpp/grpcpp.h>

#include "bus/keys.h"
#include "core/limits.h"
#include "tensormass/v1/control.grpc.pb.h"

namespace tensormass::haptic {
namespace {

/// Nearer than this the positions' single precision leaves no direction.
constexpr double kNoDistanceM = 1e-6;

Eigen::Vector3d to_eigen(const v1::Vector3& v) { return {v.x(), v.y(), v.z()}; }

/// The host of a gRPC target that ends in host:port; an IPv6 one keeps its brackets.
std::string host_of(const std::string& target) {
  const std::size_t open = target.rfind('['), close = target.rfind(']');
  if (open != std::string::npos && close != std::string::npos && open < close) {
    return target.substr(open, close - open + 1);
  }
  const std::string host = target.substr(0, target.rfind(':'));
  return host.substr(host.find_last_of("/:") + 1);
}

/// Calls of one discovery: they share a deadline.
class Caller {
 public:
  Caller(const std::string& control, double timeout_s) : control_(control) {
    deadline_ = std::chrono::system_clock::now() + std::chrono::duration_cast<std::chrono::system_clock::duration>(
                                                       std::chrono::duration<double>(timeout_s));
    grpc::ChannelArguments arguments;
    arguments.SetMaxReceiveMessageSize(static_cast<int>(limits::kMaxControlMessageBytes));
    stub_ = v1::Control::NewStub(grpc::CreateCustomChannel(control, grpc::InsecureChannelCredentials(), arguments));
  }

  template <class Request, class Response>
  Result<Response> call(grpc::Status (v1::Control::Stub::*method)(grpc::ClientContext*, const Request&, Response*),
                        const Request& request) {
    grpc::ClientContext context;
    context.set_deadline(deadline_);
    context.set_wait_for_ready(true);
    Response response;
    const grpc::Status status = (stub_.get()->*method)(&context, request, &response);
    if (status.ok()) return response;
    if (status.error_code() == grpc::StatusCode::DEADLINE_EXCEEDED) {
      return fail(ErrorCode::kUnavailable,
                  "no answer from a server at " + control_ + "; is tensormassd running there?");
    }
    return fail(status.error_code() == grpc::StatusCode::NOT_FOUND ? ErrorCode::kNotFound : ErrorCode::kUnavailable,
                "the server at " + control_ + " says: " + status.error_message());
  }

 private:
  std::string control_;
  std::chrono::system_clock::time_point deadline_;
  std::unique_ptr<v1::Control::Stub> stub_;
};

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
                                     double timeout_s) {
  using Stub = v1::Control::Stub;
  Caller caller(control, timeout_s);
  auto version = caller.call(&Stub::GetVersion, v1::GetVersionRequest{});
  if (!version) return tl::make_unexpected(version.error());

  v1::GetTopologyRequest topology_request;
  topology_request.set_scene(scene);
  const auto topology = caller.call(&Stub::GetTopology, topology_request);
  if (!topology) return tl::make_unexpected(topology.error());
  const Result<v1::ToolShape> shape = find_tool(topology->topology(), tool);
  if (!shape) return tl::make_unexpected(shape.error());

  v1::GetFrameRequest frame_request;
  frame_request.set_scene(scene);
  auto frame = caller.call(&Stub::GetFrame, frame_request);
  if (!frame) return tl::make_unexpected(frame.error());

  v1::GetFeedbackRequest feedback_request;
  feedback_request.set_scene(scene);
  feedback_request.set_tool(tool);
  const auto feedback = caller.call(&Stub::GetFeedback, feedback_request);
  if (!feedback) return tl::make_unexpected(feedback.error());

  DiscoveredTool found;
  found.address.pose_key = bus::pose_key(version->server(), scene, tool);
  found.address.feedback_key = bus::feedback_key(version->server(), scene, tool);
  found.address.zeromq_pose_endpoint = reached_endpoint(version->zeromq_pose_endpoint(), control);
  found.address.zeromq_publish_endpoint = reached_endpoint(version->zeromq_publish_endpoint(), control);
  found.address.zenoh_locator = reached_endpoint(version->zenoh_locator(), control);
  found.server = std::move(*version);
  found.tool_position_m = to_eigen(feedback->feedback().position_m());
  found.radius_m = shape->radius_m();
  found.tip_offset_m = to_eigen(shape->tip_offset_m());
  found.surface_positions = std::move(*frame->mutable_frame()->mutable_positions());
  return found;
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

Result<Aim> aim_at_nearest_surface(const DiscoveredTool& tool) {
  using Positions = Eigen::Matrix<float, 3, Eigen::Dynamic>;
  const auto vertex_count = static_cast<Eigen::Index>(tool.surface_positions.size() / (3 * sizeof(float)));
  if (vertex_count == 0) {
    return fail(ErrorCode::kFailedPrecondition, "the scene has no surface to press; give --press-at and --direction");
  }
  Positions positions(3, vertex_count);
  std::copy_n(tool.surface_positions.data(), vertex_count * 3 * sizeof(float),
              reinterpret_cast<char*>(positions.data()));
  if (!positions.allFinite()) {
    return fail(ErrorCode::kFailedPrecondition, "the scene's surface is not finite; reset the scene");
  }
  const Eigen::Vector3d center = tool.tool_position_m + tool.tip_offset_m;
  Eigen::Index nearest = 0;
  (positions.colwise() - center.cast<float>()).colwise().squaredNorm().minCoeff(&nearest);
  const Eigen::Vector3d way = positions.col(nearest).cast<double>() - center;
  const double distance = way.norm();
  if (distance < kNoDistanceM) {
    return fail(ErrorCode::kFailedPrecondition,
                "the tool stands on the tissue, so no direction to press follows from it; give --direction");
  }
  Aim aim;
  aim.direction = way / distance;
  // Already touching: press from where it stands.
  aim.contact_m = tool.tool_position_m + std::max(0.0, distance - tool.radius_m) * aim.direction;
  aim.extent_m = (positions.rowwise().maxCoeff() - positions.rowwise().minCoeff()).cast<double>().norm();
  return aim;
}

}  // namespace tensormass::haptic
