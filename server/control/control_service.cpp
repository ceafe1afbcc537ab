#include "control/control_service.h"

#include <algorithm>
#include <chrono>
#include <memory>
#include <new>
#include <thread>
#include <utility>

#include <fmt/format.h>

#include "control/relay.h"
#include "control/status.h"
#include "core/limits.h"
#include "core/log.h"

namespace tensormass::control {
namespace {

/// Target length of a turn of StepScene: after a cancellation or an unload the call runs that long, or one step.
constexpr std::chrono::milliseconds kStepTurn{25};
/// Time after which RecordScene looks again for steps. The loop must not wake it: a step signals nobody.
constexpr std::chrono::milliseconds kRecordingPause{10};

/// Moves the value of `result` to `field` of the response, or returns its error.
template <class T>
grpc::Status answer(Result<T> result, T* field) {
  if (!result) return to_status(result.error());
  *field = std::move(*result);
  return grpc::Status::OK;
}

/// Steps `count` times, in turns. Between turns it ends early, with kUnavailable, if the scene was unloaded or the
/// client cancelled the call. A turn doubles its steps until it takes kStepTurn, so many short steps cost few checks.
Result<v1::SceneStatus> step_in_turns(const SceneRegistry& registry, const RunnerPtr& runner, std::uint32_t count,
                                      const grpc::ServerContext& context) {
  std::uint32_t turn = 1;
  while (true) {
    const auto start = std::chrono::steady_clock::now();
    const std::uint32_t steps = std::min(turn, count);
    auto status = runner->step(steps);
    count -= steps;
    if (!status || count == 0) return status;
    const auto current = registry.find(runner->name());
    if (!current || *current != runner) {
      return fail(ErrorCode::kUnavailable,
                  fmt::format("scene '{}' was unloaded with {} steps to go", runner->name(), count));
    }
    if (context.IsCancelled()) {
      return fail(ErrorCode::kUnavailable, fmt::format("the client gave up with {} steps to go", count));
    }
    if (std::chrono::steady_clock::now() - start < kStepTurn) turn *= 2;
  }
}

/// Progress that reports nothing and ends the load when the client has cancelled the call.
model::Progress while_awaited(const grpc::ServerContext& context) {
  return model::Progress([&context](std::string_view, double) { return !context.IsCancelled(); });
}

/// Fills in the report of a scene that was loaded just now. Without memory for it the client hears that its scene is
/// not loaded, so it must not be.
template <class Response>
void tell_report(SceneRegistry& registry, const world::Runner& loaded, Response& response) {
  try {
    *response.mutable_report() = loaded.report();
  } catch (const std::bad_alloc&) {
    (void)registry.unload(loaded.name());
    throw;
  }
}

}  // namespace

ControlService::ControlService(SceneRegistry& registry, v1::GetVersionResponse identity,
                               std::function<std::uint64_t()> malformed_count, const access::KeyRing* keys,
                               std::function<std::string()> metrics)
    : registry_(registry),
      identity_(std::move(identity)),
      malformed_count_(std::move(malformed_count)),
      keys_(keys),
      metrics_(std::move(metrics)) {}

grpc::Status ControlService::permit(const grpc::ServerContext* context, std::string_view call, std::string_view scene,
                                    std::string_view tool) {
  if (keys_ == nullptr) return grpc::Status::OK;
  const std::string id = Relay::name_of_peer(context->peer());
  const access::ClientPtr client = keys_->find(id);
  if (client == nullptr) {
    return {grpc::StatusCode::UNAUTHENTICATED,
            fmt::format("the key '{}' was removed or has expired; ask for another: tensormass keys add", id)};
  }
  const std::string full = fmt::format("{}/{}", v1::Control::service_full_name(), call);
  if (access::may_call(client->subject(), full, scene, tool)) return grpc::Status::OK;
  registry_.refusals().count(Limit::kRole);
  const std::string_view role = access::kRoleNames[static_cast<std::size_t>(client->role)];
  const std::string own =
      client->role == access::Role::kHand ? fmt::format(" of {}/{}", client->scene, client->tool) : "";
  return {grpc::StatusCode::PERMISSION_DENIED,
          fmt::format("{} is not for the role {}{} of the key '{}'; use a key with another role (docs/security.md)",
                      call, role, own, id)};
}

grpc::Status ControlService::GetVersion(grpc::ServerContext* context, const v1::GetVersionRequest*,
                                        v1::GetVersionResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetVersion"); !allowed.ok()) return allowed;
  *response = identity_;
  response->set_malformed_messages(malformed_count_());
  return grpc::Status::OK;
}

grpc::Status ControlService::LoadScene(grpc::ServerContext* context, const v1::LoadSceneRequest* request,
                                       v1::LoadSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "LoadScene", request->scene().name()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  const auto runner = registry_.load(request->scene(), while_awaited(*context));
  if (!runner) return to_status(runner.error());
  tell_report(registry_, **runner, *response);
  return grpc::Status::OK;
}

grpc::Status ControlService::LoadSceneWithProgress(grpc::ServerContext* context, const v1::LoadSceneRequest* request,
                                                   grpc::ServerWriter<v1::LoadSceneWithProgressResponse>* writer) {
  if (const grpc::Status allowed = permit(context, "LoadSceneWithProgress", request->scene().name()); !allowed.ok())
    return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  const model::Progress progress([&](std::string_view part, double fraction) {
    v1::LoadSceneWithProgressResponse response;
    response.set_part(std::string(part));
    response.set_fraction(fraction);
    return writer->Write(response) && !context->IsCancelled();
  });
  const auto runner = registry_.load(request->scene(), progress);
  if (!runner) return to_status(runner.error());
  v1::LoadSceneWithProgressResponse response;
  response.set_fraction(1);
  tell_report(registry_, **runner, response);
  // The client is gone and does not know that the scene is loaded, so nobody would unload it.
  if (!writer->Write(response)) (void)registry_.unload(request->scene().name());
  return grpc::Status::OK;
}

grpc::Status ControlService::UnloadScene(grpc::ServerContext* context, const v1::UnloadSceneRequest* request,
                                         v1::UnloadSceneResponse*) {
  if (const grpc::Status allowed = permit(context, "UnloadScene", request->scene()); !allowed.ok()) return allowed;
  const auto unloaded = registry_.unload(request->scene());
  return unloaded ? grpc::Status::OK : to_status(unloaded.error());
}

grpc::Status ControlService::ListScenes(grpc::ServerContext* context, const v1::ListScenesRequest*,
                                        v1::ListScenesResponse* response) {
  if (const grpc::Status allowed = permit(context, "ListScenes"); !allowed.ok()) return allowed;
  for (const RunnerPtr& runner : registry_.list()) *response->add_scenes() = runner->status();
  return grpc::Status::OK;
}

grpc::Status ControlService::InspectScene(grpc::ServerContext* context, const v1::InspectSceneRequest* request,
                                          v1::InspectSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "InspectScene", request->scene().name()); !allowed.ok())
    return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(registry_.inspect(request->scene(), while_awaited(*context)), response->mutable_report());
}

grpc::Status ControlService::PauseScene(grpc::ServerContext* context, const v1::PauseSceneRequest* request,
                                        v1::PauseSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "PauseScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(waiting_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([](const RunnerPtr& runner) { return runner->pause(); }),
                response->mutable_status());
}

grpc::Status ControlService::ResumeScene(grpc::ServerContext* context, const v1::ResumeSceneRequest* request,
                                         v1::ResumeSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "ResumeScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(waiting_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([](const RunnerPtr& runner) { return runner->resume(); }),
                response->mutable_status());
}

grpc::Status ControlService::StepScene(grpc::ServerContext* context, const v1::StepSceneRequest* request,
                                       v1::StepSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "StepScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  const std::uint32_t count = request->count();
  if (count == 0 || count > limits::kMaxStepsPerCall) {
    return to_status(
        {ErrorCode::kInvalidArgument,
         fmt::format("count: {} is not within [1, limits::kMaxStepsPerCall = {}]", count, limits::kMaxStepsPerCall)});
  }
  return answer(registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) {
    return step_in_turns(registry_, runner, count, *context);
  }),
                response->mutable_status());
}

grpc::Status ControlService::ResetScene(grpc::ServerContext* context, const v1::ResetSceneRequest* request,
                                        v1::ResetSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "ResetScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(reset_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([](const RunnerPtr& runner) { return runner->reset(); }),
                response->mutable_status());
}

grpc::Status ControlService::GetTopology(grpc::ServerContext* context, const v1::GetTopologyRequest* request,
                                         v1::GetTopologyResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetTopology", request->scene()); !allowed.ok()) return allowed;
  return answer(registry_.find(request->scene()).map([](const RunnerPtr& runner) { return *runner->topology(); }),
                response->mutable_topology());
}

grpc::Status ControlService::GetFrame(grpc::ServerContext* context, const v1::GetFrameRequest* request,
                                      v1::GetFrameResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetFrame", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(waiting_calls_);
  if (!place) return place.refusal();
  const auto runner = registry_.find(request->scene());
  const grpc::Status status =
      answer(runner.and_then([](const RunnerPtr& found) { return found->frame(); }), response->mutable_frame());
  if (status.ok() && !(*runner)->changes(*response->mutable_changes())) response->clear_changes();
  return status;
}

grpc::Status ControlService::GetPositions(grpc::ServerContext* context, const v1::GetPositionsRequest* request,
                                          v1::GetPositionsResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetPositions", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(waiting_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) {
    return runner->positions(request->body());
  }),
                response);
}

grpc::Status ControlService::GetFields(grpc::ServerContext* context, const v1::GetFieldsRequest* request,
                                       v1::GetFieldsResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetFields", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(
      registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) { return runner->fields(*request); }),
      response);
}

grpc::Status ControlService::GetStatus(grpc::ServerContext* context, const v1::GetStatusRequest* request,
                                       v1::GetStatusResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetStatus", request->scene()); !allowed.ok()) return allowed;
  return answer(registry_.find(request->scene()).map([](const RunnerPtr& runner) { return runner->status(); }),
                response->mutable_status());
}

grpc::Status ControlService::MoveTool(grpc::ServerContext* context, const v1::MoveToolRequest* request,
                                      v1::MoveToolResponse*) {
  if (const grpc::Status allowed = permit(context, "MoveTool", request->scene(), request->tool()); !allowed.ok())
    return allowed;
  const auto moved = registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) {
    return runner->submit_pose(request->tool(), request->pose(), world::PoseSource::kOperator);
  });
  return moved ? grpc::Status::OK : to_status(moved.error());
}

grpc::Status ControlService::GetFeedback(grpc::ServerContext* context, const v1::GetFeedbackRequest* request,
                                         v1::GetFeedbackResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetFeedback", request->scene(), request->tool()); !allowed.ok())
    return allowed;
  const CallShare::Place place(waiting_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) {
    return runner->feedback(request->tool());
  }),
                response->mutable_feedback());
}

grpc::Status ControlService::RecordScene(grpc::ServerContext* context, const v1::RecordSceneRequest* request,
                                         grpc::ServerWriter<v1::RecordSceneResponse>* writer) {
  if (const grpc::Status allowed = permit(context, "RecordScene", request->scene()); !allowed.ok()) return allowed;
  if (request->reset()) {
    if (const grpc::Status allowed = permit(context, "ResetScene", request->scene()); !allowed.ok()) return allowed;
  }
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  auto runner = registry_.find(request->scene());
  if (!runner) return to_status(runner.error());
  const std::weak_ptr<world::Runner> scene = *runner;
  const std::string who = Relay::name_of_peer(context->peer());  // a client that is gone has no name
  auto started = (*runner)->record({.check_every_steps = request->check_every_steps(), .reset = request->reset()});
  // A reader that is stuck in Write must not keep the loop of an unloaded scene alive.
  runner->reset();
  if (!started) return to_status(started.error());
  world::Recording& recording = *started->recording;
  // Cancelling the call frees a Write that waits for its client.
  recording.on_evicted([context] { context->TryCancel(); });
  started->start.set_server_version(identity_.version());
  v1::RecordSceneResponse response;
  const std::shared_ptr<RecordingLosses> losses = registry_.recording_losses(request->scene());
  std::uint64_t lost_checks = 0;
  const auto count_losses = [&] {
    for (const v1::LostSteps& lost : response.lost()) losses->steps += lost.count();
    losses->checks += response.lost_checks() - std::exchange(lost_checks, response.lost_checks());
  };
  *response.mutable_start() = std::move(started->start);
  bool reads = writer->Write(response);
  while (reads && !context->IsCancelled()) {
    const bool ended = recording.closed();
    const bool news = recording.take(response);
    count_losses();
    if (news) {
      reads = writer->Write(response);
    } else if (ended) {
      break;
    } else {
      std::this_thread::sleep_for(kRecordingPause);
    }
  }
  recording.on_evicted({});
  if (recording.evicted()) {
    ++losses->recordings;
    // What waited for the client does not reach it any more.
    while (recording.take(response)) {
      count_losses();
      losses->steps += static_cast<std::uint64_t>(response.steps_size());
      losses->checks += static_cast<std::uint64_t>(response.checks_size());
    }
    log::warn("closed", {{"who", who},
                         {"what", "tensormass.v1.Control/RecordScene"},
                         {"scene", request->scene()},
                         {"reason",
                          "its client took nothing for limits::kRecordingLease = 10 s, and another one records the "
                          "scene"}});
  }
  if (const RunnerPtr still = scene.lock()) still->stop_recording(started->recording);
  return grpc::Status::OK;
}

grpc::Status ControlService::ReplayScene(grpc::ServerContext* context, const v1::ReplaySceneRequest* request,
                                         v1::ReplaySceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "ReplayScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(registry_.replay(*request), response);
}

grpc::Status ControlService::SnapshotScene(grpc::ServerContext* context, const v1::SnapshotSceneRequest* request,
                                           v1::SnapshotSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "SnapshotScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([](const RunnerPtr& runner) { return runner->snapshot(); }),
                response);
}

grpc::Status ControlService::RestoreScene(grpc::ServerContext* context, const v1::RestoreSceneRequest* request,
                                          v1::RestoreSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "RestoreScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(registry_.find(request->scene()).and_then([&](const RunnerPtr& runner) {
    return runner->restore(request->snapshot());
  }),
                response->mutable_status());
}

grpc::Status ControlService::EditScene(grpc::ServerContext* context, const v1::EditSceneRequest* request,
                                       v1::EditSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "EditScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(SceneRegistry::compiles(request->edit()) ? long_calls_ : reset_calls_);
  if (!place) return place.refusal();
  return answer(registry_.edit(request->scene(), request->edit()), response);
}

grpc::Status ControlService::AdjustScene(grpc::ServerContext* context, const v1::AdjustSceneRequest* request,
                                         v1::AdjustSceneResponse* response) {
  if (const grpc::Status allowed = permit(context, "AdjustScene", request->scene()); !allowed.ok()) return allowed;
  const CallShare::Place place(long_calls_);
  if (!place) return place.refusal();
  return answer(registry_.adjust(request->scene(), request->changes()), response);
}

grpc::Status ControlService::GetMetrics(grpc::ServerContext* context, const v1::GetMetricsRequest*,
                                        v1::GetMetricsResponse* response) {
  if (const grpc::Status allowed = permit(context, "GetMetrics"); !allowed.ok()) return allowed;
  response->set_text(metrics_());
  return grpc::Status::OK;
}

}  // namespace tensormass::control
