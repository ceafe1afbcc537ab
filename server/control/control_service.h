#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <string_view>

#include "access/key_ring.h"
#include "control/call_share.h"
#include "control/scene_registry.h"
#include "core/control_limits.h"
#include "tensormass/v1/control.grpc.pb.h"

namespace tensormass::control {

/// Implements the calls of control.proto on the scenes of a registry; control.proto documents each call.
///
/// gRPC runs each call on a thread of its own. A call finds its scene in the registry and calls the scene's runner,
/// which passes commands to the scene's loop. So no call touches the state of a simulation. Errors become gRPC statuses
/// in status.h. Calls that may hold their thread for long have a share of the threads (call_share.h).
/// refused_calls.h answers requests that are not protobuf before they get here, and tells of calls that are refused.
class ControlService final : public v1::Control::Service {
 public:
  /// `registry` must outlive the service. GetVersion answers `identity` with the current result of `malformed_count` in
  /// `malformed_messages`; `malformed_count` is called on gRPC's threads. keys: say who may call what (access/rules.h);
  /// nullptr: everybody may call everything. metrics: returns the answer of GetMetrics; called on gRPC's threads.
  ControlService(
      SceneRegistry& registry, v1::GetVersionResponse identity, std::function<std::uint64_t()> malformed_count,
      const access::KeyRing* keys = nullptr, std::function<std::string()> metrics = [] { return std::string(); });

  grpc::Status GetVersion(grpc::ServerContext*, const v1::GetVersionRequest*, v1::GetVersionResponse*) override;
  grpc::Status LoadScene(grpc::ServerContext*, const v1::LoadSceneRequest*, v1::LoadSceneResponse*) override;
  grpc::Status LoadSceneWithProgress(grpc::ServerContext*, const v1::LoadSceneRequest*,
                                     grpc::ServerWriter<v1::LoadSceneWithProgressResponse>*) override;
  grpc::Status UnloadScene(grpc::ServerContext*, const v1::UnloadSceneRequest*, v1::UnloadSceneResponse*) override;
  grpc::Status ListScenes(grpc::ServerContext*, const v1::ListScenesRequest*, v1::ListScenesResponse*) override;
  grpc::Status InspectScene(grpc::ServerContext*, const v1::InspectSceneRequest*, v1::InspectSceneResponse*) override;
  grpc::Status PauseScene(grpc::ServerContext*, const v1::PauseSceneRequest*, v1::PauseSceneResponse*) override;
  grpc::Status ResumeScene(grpc::ServerContext*, const v1::ResumeSceneRequest*, v1::ResumeSceneResponse*) override;
  grpc::Status StepScene(grpc::ServerContext*, const v1::StepSceneRequest*, v1::StepSceneResponse*) override;
  grpc::Status ResetScene(grpc::ServerContext*, const v1::ResetSceneRequest*, v1::ResetSceneResponse*) override;
  grpc::Status GetTopology(grpc::ServerContext*, const v1::GetTopologyRequest*, v1::GetTopologyResponse*) override;
  grpc::Status GetFrame(grpc::ServerContext*, const v1::GetFrameRequest*, v1::GetFrameResponse*) override;
  grpc::Status GetPositions(grpc::ServerContext*, const v1::GetPositionsRequest*, v1::GetPositionsResponse*) override;
  grpc::Status GetFields(grpc::ServerContext*, const v1::GetFieldsRequest*, v1::GetFieldsResponse*) override;
  grpc::Status GetStatus(grpc::ServerContext*, const v1::GetStatusRequest*, v1::GetStatusResponse*) override;
  grpc::Status MoveTool(grpc::ServerContext*, const v1::MoveToolRequest*, v1::MoveToolResponse*) override;
  grpc::Status GetFeedback(grpc::ServerContext*, const v1::GetFeedbackRequest*, v1::GetFeedbackResponse*) override;
  grpc::Status RecordScene(grpc::ServerContext*, const v1::RecordSceneRequest*,
                           grpc::ServerWriter<v1::RecordSceneResponse>*) override;
  grpc::Status ReplayScene(grpc::ServerContext*, const v1::ReplaySceneRequest*, v1::ReplaySceneResponse*) override;
  grpc::Status SnapshotScene(grpc::ServerContext*, const v1::SnapshotSceneRequest*,
                             v1::SnapshotSceneResponse*) override;
  grpc::Status RestoreScene(grpc::ServerContext*, const v1::RestoreSceneRequest*, v1::RestoreSceneResponse*) override;
  grpc::Status EditScene(grpc::ServerContext*, const v1::EditSceneRequest*, v1::EditSceneResponse*) override;
  grpc::Status AdjustScene(grpc::ServerContext*, const v1::AdjustSceneRequest*, v1::AdjustSceneResponse*) override;
  grpc::Status GetMetrics(grpc::ServerContext*, const v1::GetMetricsRequest*, v1::GetMetricsResponse*) override;

 private:
  /// Returns OK if the client's role may make a call of this service for a scene and a tool; the refusal otherwise.
  /// Every call asks it first.
  grpc::Status permit(const grpc::ServerContext* context, std::string_view call, std::string_view scene = {},
                      std::string_view tool = {});

  SceneRegistry& registry_;
  const v1::GetVersionResponse identity_;
  const std::function<std::uint64_t()> malformed_count_;
  const access::KeyRing* const keys_;
  const std::function<std::string()> metrics_;
  CallShare long_calls_{limits::kMaxLongCalls, "kMaxLongCalls", registry_.refusals(), Limit::kLongCalls};
  CallShare waiting_calls_{limits::kMaxWaitingCalls, "kMaxWaitingCalls", registry_.refusals(), Limit::kWaitingCalls};
  CallShare reset_calls_{limits::kMaxResetCalls, "kMaxResetCalls", registry_.refusals(), Limit::kResetCalls};
};

}  // namespace tensormass::control
