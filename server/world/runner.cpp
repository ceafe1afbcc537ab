#include "world/runner.h"

#include <map>

#include <fmt/format.h>

#include "core/limits.h"
#include "world/compiled_scene.h"
#include "world/fields.h"
#include "world/hashes.h"
#include "world/loop.h"
#include "world/messages.h"
#include "world/snapshot.h"

namespace tensormass::world {

/// The loop, and what stays constant while it runs.
struct Runner::Impl {
  Impl(CompiledScene compiled, std::unique_ptr<World> world)
      : report(std::move(compiled.report)),
        backend{compiled.backend->name(), compiled.backend->device()},
        scene_hash(compiled.scene_hash),
        loop(compiled.backend->name(), std::move(world)),
        topology(make_topology(loop.model(), unix_time_ns())) {
    for (std::size_t i = 0; i < loop.model().tools.size(); ++i) tool_index.emplace(loop.model().tools[i].name, i);
  }

  Result<std::size_t> find_tool(std::string_view tool) const {
    const auto found = tool_index.find(tool);
    if (found == tool_index.end()) {
      return fail(ErrorCode::kNotFound, fmt::format("scene '{}' has no tool '{}'", loop.model().name, tool));
    }
    return found->second;
  }

  const v1::SceneReport report;
  const BackendDescription backend;
  const std::uint64_t scene_hash;
  Loop loop;
  const v1::Topology topology;
  std::map<std::string, std::size_t, std::less<>> tool_index;
};

Result<std::unique_ptr<Runner>> Runner::start(const v1::Scene& scene, const RunnerOptions& options,
                                              const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(scene, options, progress));
  TM_RETURN_IF_ERROR(progress.begin(model::LoadPart::kBuffers));
  return start(std::move(compiled));
}

Result<std::unique_ptr<Runner>> Runner::start(CompiledScene compiled) {
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  return std::unique_ptr<Runner>(new Runner(std::make_unique<Impl>(std::move(compiled), std::move(world))));
}

Result<v1::SceneReport> Runner::inspect(const v1::Scene& scene, const RunnerOptions& options,
                                        const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(scene, options, progress));
  return std::move(compiled.report);
}

Runner::Runner(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Runner::~Runner() = default;

const std::string& Runner::name() const { return impl_->loop.model().name; }
const v1::SceneReport& Runner::report() const { return impl_->report; }
const v1::Topology& Runner::topology() const { return impl_->topology; }

Result<v1::SceneStatus> Runner::pause() {
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_pause(); });
}
Result<v1::SceneStatus> Runner::resume() {
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_resume(); });
}
Result<v1::SceneStatus> Runner::step(std::uint32_t count) {
  if (count == 0 || count > limits::kMaxStepsPerCall) {
    return invalid(
        fmt::format("count: {} is not within [1, limits::kMaxStepsPerCall = {}]", count, limits::kMaxStepsPerCall));
  }
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_step(count); });
}
Result<v1::SceneStatus> Runner::reset() {
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_reset(); });
}
v1::SceneStatus Runner::status() const { return impl_->loop.status().make(); }
void Runner::cancel() { impl_->loop.cancel(); }

Result<v1::Frame> Runner::frame() {
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_frame(impl_->topology.version()); });
}
Result<v1::GetPositionsResponse> Runner::positions(std::string_view body) {
  Loop& loop = impl_->loop;
  return loop.call([&] { return loop.do_positions(body); });
}
Result<v1::GetFieldsResponse> Runner::fields(const v1::GetFieldsRequest& request) {
  Loop& loop = impl_->loop;
  TM_ASSIGN_OR_RETURN(body, loop.find_body(request.body()));
  TM_ASSIGN_OR_RETURN(source, loop.call([&] { return loop.do_copy_state(); }));
  TM_ASSIGN_OR_RETURN(response, measure_fields(loop.model(), source.state, source.simulated_time_s, *body, request));
  response.set_step(source.step);
  response.set_simulated_time_s(source.simulated_time_s);
  return std::move(response);
}
Result<v1::ToolFeedback> Runner::feedback(std::string_view tool) const {
  TM_ASSIGN_OR_RETURN(index, impl_->find_tool(tool));
  Loop& loop = impl_->loop;
  return loop.call([&loop, i = index] { return loop.do_feedback(i); });
}

Result<StartedRecording> Runner::record(const RecordingOptions& options) {
  Loop& loop = impl_->loop;
  TM_ASSIGN_OR_RETURN(started, loop.call([&] { return loop.do_record(options); }));
  const model::Model& model = loop.model();
  StartedRecording out{started.recording, {}};
  out.start.set_scene(model.name);
  out.start.set_backend(impl_->backend.backend);
  out.start.set_device(impl_->backend.device);
  out.start.set_scene_hash(impl_->scene_hash);
  out.start.set_layout_hash(hash_of_layout(model));
  out.start.set_patch_count(model.layout.patch_count);
  out.start.set_check_every_steps(options.check_every_steps);
  out.start.set_step(started.step);
  if (started.state) out.start.set_snapshot(write_snapshot(model, impl_->scene_hash, *started.state));
  out.start.set_server_time_ns(unix_time_ns());
  return out;
}
void Runner::stop_recording(const std::shared_ptr<Recording>& recording) {
  Loop& loop = impl_->loop;
  (void)loop.call([&] { return loop.do_stop_recording(recording); });
}
Result<v1::ReplaySceneResponse> Runner::replay(const v1::ReplaySceneRequest& request) {
  Loop& loop = impl_->loop;
  TM_ASSIGN_OR_RETURN(replay, read_replay(loop.model(), impl_->scene_hash, request));
  TM_ASSIGN_OR_RETURN(response, loop.call([&] { return loop.do_replay(replay); }));
  response.set_layout_hash(hash_of_layout(loop.model()));
  return std::move(response);
}
Result<v1::SnapshotSceneResponse> Runner::snapshot() {
  Loop& loop = impl_->loop;
  TM_ASSIGN_OR_RETURN(state, loop.call([&] { return loop.do_save(); }));
  v1::SnapshotSceneResponse response;
  response.set_step(state.world.step_count);
  response.set_snapshot(write_snapshot(loop.model(), impl_->scene_hash, state));
  return response;
}
Result<v1::SceneStatus> Runner::restore(std::string_view snapshot) {
  Loop& loop = impl_->loop;
  // The scene's own arrays have the sizes that the snapshot must have. A scene whose device failed has none to compare
  // with.
  TM_ASSIGN_OR_RETURN(present, loop.call([&] { return loop.do_save(); }));
  TM_ASSIGN_OR_RETURN(state, read_snapshot(loop.model(), impl_->scene_hash, present.world.history, snapshot));
  return loop.call([&] { return loop.do_restore(state); });
}

Result<void> Runner::submit_pose(std::string_view tool, const v1::ToolPose& pose) {
  const auto index = impl_->find_tool(tool);
  if (!index) {
    count_malformed_pose();
    return tl::make_unexpected(index.error());
  }
  return impl_->loop.submit_pose(*index, pose);
}
void Runner::count_malformed_pose() { impl_->loop.count_malformed_pose(); }

void Runner::set_output_signal(std::function<void()> signal) {
  Loop& loop = impl_->loop;
  (void)loop.call([&] { return loop.do_set_signal(std::move(signal)); });
}

bool Runner::take_frame(v1::Frame& frame) { return impl_->loop.outputs().take_frame(impl_->topology.version(), frame); }
bool Runner::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  return impl_->loop.outputs().take_feedback(feedback);
}
bool Runner::take_status(v1::SceneStatus& status) { return impl_->loop.take_status(status); }

}  // namespace tensormass::world
