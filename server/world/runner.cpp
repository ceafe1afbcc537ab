#include "world/runner.h"

#include <algorithm>
#include <mutex>
#include <span>
#include <utility>
#include <variant>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/log.h"
#include "world/fields.h"
#include "world/hashes.h"
#include "world/runner_impl.h"
#include "world/snapshot.h"

namespace tensormass::world {

namespace {

std::string write_snapshot(const Generation& generation, const LoopCopy& copy) {
  return world::write_snapshot(*generation.model, generation.scene_hash, by_node(*generation.model, copy));
}

}  // namespace

Result<std::unique_ptr<Runner>> Runner::start(const v1::Scene& scene, const RunnerOptions& options,
                                              const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_and_place(scene, options, progress));
  TM_RETURN_IF_ERROR(progress.begin(model::LoadPart::kBuffers));
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  if (compiled.place && options.placement->device_count() > 1) {
    log::info("a scene has its GPU", {{"scene", scene.name()}, {"device", compiled.options.device}});
  }
  auto source = std::make_unique<const Source>(Source{scene, compiled.options});
  return std::unique_ptr<Runner>(
      new Runner(std::make_unique<Impl>(std::move(compiled), std::move(world), std::move(source))));
}

Result<std::unique_ptr<Runner>> Runner::start(CompiledScene compiled) {
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  return std::unique_ptr<Runner>(new Runner(std::make_unique<Impl>(std::move(compiled), std::move(world), nullptr)));
}

Result<v1::SceneReport> Runner::inspect(const v1::Scene& scene, const RunnerOptions& options,
                                        const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_and_preview(scene, options, progress));
  return std::move(compiled.report);
}

Runner::Runner(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Runner::~Runner() = default;

const std::string& Runner::name() const { return impl_->name; }
const v1::SceneReport& Runner::report() const { return impl_->report; }
std::shared_ptr<const v1::Topology> Runner::topology() const { return impl_->loop->generation()->topology; }

Result<v1::SceneStatus> Runner::pause() {
  return impl_->call([](Loop& loop) { return loop.do_pause(); });
}
Result<v1::SceneStatus> Runner::resume() {
  return impl_->call([](Loop& loop) { return loop.do_resume(); });
}
Result<v1::SceneStatus> Runner::step(std::uint32_t count) {
  if (count == 0 || count > limits::kMaxStepsPerCall) {
    return invalid(
        fmt::format("count: {} is not within [1, limits::kMaxStepsPerCall = {}]", count, limits::kMaxStepsPerCall));
  }
  if (impl_->has_blades() || impl_->comes) return impl_->step_in_parts(count);
  return impl_->call([count](Loop& loop) { return loop.do_step(count); });
}
Result<v1::SceneStatus> Runner::edit(const v1::SceneEdit& change, std::vector<v1::Finding>* findings) {
  if (!change.add_attachments().empty() || !change.remove_attachments().empty()) {
    return impl_->change_attachments(change);
  }
  if (!change.add_tools().empty() || !change.remove_tools().empty()) return impl_->change_tools(change, findings);
  if (!change.cuts().empty()) return impl_->cut(change);
  return impl_->apply(std::make_shared<const Edit>(ChangeScene{change}));
}
Result<v1::SceneStatus> Runner::reset() { return impl_->apply(std::make_shared<const Edit>(Reset{})); }
v1::SceneStatus Runner::status() const { return impl_->loop->status().make(); }
SceneMetrics Runner::metrics() const {
  const Loop* const loop = impl_->loop.get();
  const LoopStatus& status = loop->status();
  SceneMetrics out{status.make(), impl_->report.bytes_total(), {}, status.statistics(), status.counts()};
  const GenerationPointer present = loop->generation();
  for (std::size_t i = 0; i < present->inboxes.size(); ++i) {
    const PoseInbox& inbox = *present->inboxes[i];
    out.tools.push_back({present->model->tools[i].name, inbox.received(), inbox.rejected(), inbox.superseded()});
  }
  return out;
}
void Runner::cancel() { impl_->loop->cancel(); }

Result<v1::Frame> Runner::frame() {
  return impl_->read([](Loop& loop) { return loop.do_frame(); });
}
bool Runner::changes(v1::SurfaceChanges& changes) const { return impl_->loop->outputs().changes(changes); }
Result<v1::GetPositionsResponse> Runner::positions(std::string_view body) {
  return impl_->read([body](Loop& loop) { return loop.do_positions(body); });
}
Result<v1::GetFieldsResponse> Runner::fields(const v1::GetFieldsRequest& request) {
  TM_RETURN_IF_ERROR(find_body(*impl_->loop->generation()->model, request.body()));
  TM_ASSIGN_OR_RETURN(source, impl_->read([](Loop& loop) { return loop.do_copy_state(); }));
  const model::Model& model = source.edited ? *source.edited : *source.generation->model;
  TM_ASSIGN_OR_RETURN(body, find_body(model, request.body()));
  TM_ASSIGN_OR_RETURN(response, measure_fields(model, source.state, source.simulated_time_s, *body, request));
  response.set_step(source.step);
  response.set_simulated_time_s(source.simulated_time_s);
  return std::move(response);
}
Result<v1::ToolFeedback> Runner::feedback(std::string_view tool) const {
  return impl_->read([tool](Loop& loop) { return loop.do_feedback(tool); });
}

Result<StartedRecording> Runner::record(const RecordingOptions& options) {
  TM_ASSIGN_OR_RETURN(started, impl_->call([&](Loop& loop) { return loop.do_record(options); }));
  const Generation& generation = *started.generation;
  const model::Model& model = *generation.model;
  StartedRecording out{started.recording, {}};
  out.start.set_scene(model.name);
  out.start.set_backend(impl_->device.backend);
  out.start.set_device(impl_->device.name);
  out.start.set_scene_hash(generation.scene_hash);
  out.start.set_layout_hash(hash_of_layout(model));
  out.start.set_patch_count(model.layout.patch_count);
  out.start.set_check_every_steps(options.check_every_steps);
  out.start.set_step(started.step);
  if (generation.is_adjusted) *out.start.mutable_adjustments() = generation.adjustments;
  if (started.state) out.start.set_snapshot(write_snapshot(generation, *started.state));
  out.start.set_server_time_ns(unix_time_ns());
  return out;
}
void Runner::stop_recording(const std::shared_ptr<Recording>& recording) {
  (void)impl_->call([&](Loop& loop) { return loop.do_stop_recording(recording); });
}
Result<v1::ReplaySceneResponse> Runner::replay(const v1::ReplaySceneRequest& request) {
  {
    const std::lock_guard lock(impl_->adjusting);
    impl_->forget_parts();
  }
  const GenerationPointer before = impl_->loop->generation();
  TM_ASSIGN_OR_RETURN(replay, read_replay(*before->model, before->scene_hash, request));
  std::uint64_t number = before->number;
  // An adjustment compiles a world, so each part between two edits is a command of its own. Others may adjust the scene
  // between two of them.
  v1::ReplaySceneResponse out;
  std::span<Replay::Step> left = replay.steps;
  while (!left.empty()) {
    for (const EditPointer& edit : left.front().edits) {
      if (impl_->loop->cancelled()) {
        return fail(ErrorCode::kUnavailable,
                    fmt::format("scene '{}' is being unloaded; step {} was not replayed", name(), left.front().index));
      }
      const bool heals = std::holds_alternative<Reset>(*edit) && impl_->loop->generation()->was_altered();
      const auto done = impl_->apply(edit);
      if (done && (heals || std::holds_alternative<Adjust>(*edit))) ++number;
      if (!done) {
        return fail(done.error().code,
                    fmt::format("an edit before recorded step {}: {}", left.front().index, done.error().message));
      }
    }
    const auto next =
        std::find_if(left.begin() + 1, left.end(), [](const Replay::Step& step) { return !step.edits.empty(); });
    const std::span<Replay::Step> part(left.begin(), next);
    const GenerationPointer present = impl_->loop->generation();
    if (present->number == number) {  // else refused below
      TM_RETURN_IF_ERROR(read_poses(*present->model, request, replay.steps.size() - left.size(), part));
    }
    TM_ASSIGN_OR_RETURN(response, impl_->call([&](Loop& loop) -> Result<v1::ReplaySceneResponse> {
      if (loop.generation()->number == number) return loop.do_replay(part);
      return fail(
          ErrorCode::kFailedPrecondition,
          fmt::format("scene '{}' was adjusted by another client during the replay; replay from the start", name()));
    }));
    out.mutable_checks()->MergeFrom(response.checks());
    *out.mutable_status() = std::move(*response.mutable_status());
    left = left.subspan(part.size());
  }
  const GenerationPointer present = impl_->loop->generation();
  out.set_layout_hash(hash_of_layout(*present->model));
  out.set_scene_hash(present->scene_hash);
  return out;
}
Result<v1::SnapshotSceneResponse> Runner::snapshot() {
  TM_ASSIGN_OR_RETURN(saved, impl_->read([](Loop& loop) { return loop.do_save(); }));
  v1::SnapshotSceneResponse response;
  response.set_step(saved.state.world.step_count);
  response.set_snapshot(write_snapshot(*saved.generation, saved.state));
  if (saved.generation->is_adjusted) *response.mutable_adjustments() = saved.generation->adjustments;
  response.set_scene_hash(saved.generation->scene_hash);
  return response;
}
Result<v1::SceneStatus> Runner::restore(std::string_view snapshot) {
  return impl_->apply(std::make_shared<const Edit>(Restore{std::string(snapshot)}));
}

StateMark Runner::mark() const {
  const LoopStatus& status = impl_->loop->status();
  return {impl_->loop->generation()->number, status.changes(), status.state()};
}
Result<KeptState> Runner::keep() {
  TM_ASSIGN_OR_RETURN(kept, impl_->read([](Loop& loop) { return loop.do_keep(); }));
  return KeptState{kept.generation->adjustments, kept.paused, write_snapshot(*kept.generation, kept.state), kept.held};
}
bool Runner::turns(std::chrono::nanoseconds late) const { return impl_->loop->turns(Clock::now(), late); }
std::uint32_t Runner::device() const { return impl_->device.number; }
bool Runner::device_lost() const { return impl_->loop->status().device_lost(); }

const v1::Scene* Runner::source() const { return impl_->source ? &impl_->source->scene : nullptr; }

Result<v1::AdjustSceneResponse> Runner::adjust(const v1::SceneAdjustments& changes) {
  if (!impl_->source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(impl_->adjusting);
  const v1::SceneAdjustments present = impl_->wanted_values();
  TM_ASSIGN_OR_RETURN(wanted, with_changes(present, changes));
  if (wanted.SerializeAsString() != present.SerializeAsString()) {
    TM_RETURN_IF_ERROR(impl_->change_values(std::move(wanted)));
  }
  v1::AdjustSceneResponse response;
  *response.mutable_status() = status();
  *response.mutable_adjustments() = impl_->wanted_values();
  return response;
}

Result<void> Runner::submit_pose(std::string_view tool, const v1::ToolPose& pose, PoseSource source) {
  return impl_->loop->submit_pose(tool, pose, source);
}
void Runner::count_malformed_pose() { impl_->loop->count_malformed_pose(); }

void Runner::set_output_signal(std::function<void()> signal) {
  (void)impl_->call([&](Loop& loop) { return loop.do_set_signal(std::move(signal)); });
}

bool Runner::take_frame(v1::Frame& frame) { return impl_->loop->outputs().take_frame(frame); }
bool Runner::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  return impl_->loop->outputs().take_feedback(feedback);
}
bool Runner::take_changes(v1::SurfaceChanges& changes) { return impl_->loop->outputs().take_changes(changes); }
bool Runner::take_events(v1::SceneEvents& events) { return impl_->loop->outputs().take_events(events); }
bool Runner::take_status(v1::SceneStatus& status) { return impl_->loop->take_status(status); }

}  // namespace tensormass::world
