#include "world/runner.h"

#include <algorithm>
#include <atomic>
#include <map>
#include <mutex>
#include <shared_mutex>
#include <span>
#include <variant>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/names.h"
#include "world/adjustments.h"
#include "world/compiled_scene.h"
#include "world/edits.h"
#include "world/fields.h"
#include "world/hashes.h"
#include "world/loop.h"
#include "world/messages.h"
#include "world/snapshot.h"

namespace tensormass::world {

/// The message of a scene and how it was compiled, for `adjust`.
struct Source {
  v1::Scene scene;
  RunnerOptions options;
};

/// The loop, and what stays constant while it runs.
///
/// `adjust` puts another loop in place of the present one. So a caller holds the loop while it uses it, and a command
/// holds `commands` too, because a loop that has been replaced would not carry it out.
struct Runner::Impl {
  Impl(CompiledScene compiled, std::unique_ptr<World> world, std::unique_ptr<const Source> from)
      : report(std::move(compiled.report)),
        backend{compiled.backend->name(), compiled.backend->device(), {}},
        source(std::move(from)),
        topology(make_topology(world->model(), new_topology_version())),
        scene_hash(compiled.scene_hash) {
    for (std::size_t i = 0; i < world->model().tools.size(); ++i) tool_index.emplace(world->model().tools[i].name, i);
    if (source) adjustments = adjustments_of(source->scene);
    world->set_topology_version(topology.version());
    present = std::make_shared<Loop>(backend.backend, std::move(world), Loop::Start{});
  }

  Result<std::size_t> find_tool(std::string_view tool) const {
    const auto found = tool_index.find(tool);
    if (found == tool_index.end()) {
      return fail(ErrorCode::kNotFound,
                  fmt::format("scene '{}' has no tool '{}'; it has: {}", topology.scene(), tool,
                              list_names(topology.tools(), [](const v1::ToolShape& shape) { return shape.name(); })));
    }
    return found->second;
  }

  std::shared_ptr<Loop> loop() const {
    const std::lock_guard lock(present_mutex);
    return present;
  }

  /// The present loop, which `adjust` does not replace as long as this lives.
  class HeldLoop {
   public:
    explicit HeldLoop(Impl& impl) : lock_(impl.commands), loop_(impl.loop()) {}
    Loop& operator*() const { return *loop_; }
    Loop* operator->() const { return loop_.get(); }

   private:
    std::shared_lock<std::shared_mutex> lock_;
    std::shared_ptr<Loop> loop_;
  };

  /// Runs a command on the loop's thread and waits for its result.
  /// command: Result<T>(Loop&)
  template <class Command>
  auto call(const Command& command) {
    const HeldLoop held(*this);
    return held->call([&] { return command(*held); });
  }

  /// The same for a command that changes nothing.
  template <class Command>
  auto read(const Command& command) {
    const HeldLoop held(*this);
    return held->read([&] { return command(*held); });
  }

  /// Checks recorded steps against the present scene. at: number of the adjustment that it has.
  Result<Replay> check(const v1::ReplaySceneRequest& request, std::uint64_t& at) {
    const HeldLoop held(*this);
    at = adjustment;
    return read_replay(held->model(), scene_hash, request);
  }
  /// Does an edit of the list in edits.h.
  Result<v1::SceneStatus> apply(const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Adjust& adjust, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Restore& restore, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Reset& reset, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const ChangeScene& change, const EditPointer& edit);
  Result<void> replace_loop(v1::SceneAdjustments wanted);
  /// Values of the scene if it was adjusted, else nullptr. Needs `commands`.
  const v1::SceneAdjustments* adjusted_values() const {
    if (!source || adjustments.SerializeAsString() == adjustments_of(source->scene).SerializeAsString()) return nullptr;
    return &adjustments;
  }

  const v1::SceneReport report;
  const BackendDescription backend;
  const std::unique_ptr<const Source> source;  // nullptr: the scene cannot be adjusted
  const v1::Topology topology;
  std::map<std::string, std::size_t, std::less<>> tool_index;

  std::mutex adjusting;                      // one `adjust` at a time
  v1::SceneAdjustments adjustments;          // written with both `adjusting` and `commands`, read with one of them
  std::atomic<std::uint64_t> adjustment{0};  // counts the loops that were replaced
  std::atomic<bool> cancelled{false};        // nobody will see the scene again

  std::shared_mutex commands;  // exclusive while a loop is replaced; guards scene_hash and signal
  std::uint64_t scene_hash;
  std::function<void()> signal;

  mutable std::mutex present_mutex;
  std::shared_ptr<Loop> present;  // guarded by present_mutex
};

Result<std::unique_ptr<Runner>> Runner::start(const v1::Scene& scene, const RunnerOptions& options,
                                              const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(scene, options, progress));
  TM_RETURN_IF_ERROR(progress.begin(model::LoadPart::kBuffers));
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  auto source = std::make_unique<const Source>(Source{scene, options});
  return std::unique_ptr<Runner>(
      new Runner(std::make_unique<Impl>(std::move(compiled), std::move(world), std::move(source))));
}

Result<std::unique_ptr<Runner>> Runner::start(CompiledScene compiled) {
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  return std::unique_ptr<Runner>(new Runner(std::make_unique<Impl>(std::move(compiled), std::move(world), nullptr)));
}

Result<v1::SceneReport> Runner::inspect(const v1::Scene& scene, const RunnerOptions& options,
                                        const model::Progress& progress) {
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(scene, options, progress));
  return std::move(compiled.report);
}

Runner::Runner(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
Runner::~Runner() = default;

const std::string& Runner::name() const { return impl_->topology.scene(); }
const v1::SceneReport& Runner::report() const { return impl_->report; }
const v1::Topology& Runner::topology() const { return impl_->topology; }

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
  return impl_->call([count](Loop& loop) { return loop.do_step(count); });
}
Result<v1::SceneStatus> Runner::edit(const v1::SceneEdit& change) {
  return impl_->apply(std::make_shared<const Edit>(ChangeScene{change}));
}
Result<v1::SceneStatus> Runner::reset() { return impl_->apply(std::make_shared<const Edit>(Reset{})); }
v1::SceneStatus Runner::status() const { return impl_->loop()->status().make(); }
SceneMetrics Runner::metrics() const {
  const std::shared_ptr<Loop> loop = impl_->loop();
  const LoopStatus& status = loop->status();
  SceneMetrics out{status.make(), impl_->report.bytes_total(), {}, status.statistics(), status.counts()};
  for (const auto& [name, tool] : impl_->tool_index) {
    const PoseInbox& inbox = loop->inbox(tool);
    out.tools.push_back({name, inbox.received(), inbox.rejected(), inbox.superseded()});
  }
  return out;
}
void Runner::cancel() {
  impl_->cancelled = true;  // before the loop is looked up: one that takes its place looks at this
  impl_->loop()->cancel();
}

Result<v1::Frame> Runner::frame() {
  return impl_->read([](Loop& loop) { return loop.do_frame(); });
}
Result<v1::GetPositionsResponse> Runner::positions(std::string_view body) {
  return impl_->read([body](Loop& loop) { return loop.do_positions(body); });
}
Result<v1::GetFieldsResponse> Runner::fields(const v1::GetFieldsRequest& request) {
  const std::shared_ptr<Loop> loop = impl_->loop();
  TM_ASSIGN_OR_RETURN(body, loop->find_body(request.body()));
  TM_ASSIGN_OR_RETURN(source, loop->read([&] { return loop->do_copy_state(); }));
  TM_ASSIGN_OR_RETURN(response, measure_fields(source.model ? *source.model : loop->model(), source.state,
                                               source.simulated_time_s, *body, request));
  response.set_step(source.step);
  response.set_simulated_time_s(source.simulated_time_s);
  return std::move(response);
}
Result<v1::ToolFeedback> Runner::feedback(std::string_view tool) const {
  TM_ASSIGN_OR_RETURN(index, impl_->find_tool(tool));
  return impl_->read([i = index](Loop& loop) { return loop.do_feedback(i); });
}

Result<StartedRecording> Runner::record(const RecordingOptions& options) {
  const Impl::HeldLoop loop(*impl_);
  TM_ASSIGN_OR_RETURN(started, loop->call([&] { return loop->do_record(options); }));
  const model::Model& model = loop->model();
  StartedRecording out{started.recording, {}};
  out.start.set_scene(model.name);
  out.start.set_backend(impl_->backend.backend);
  out.start.set_device(impl_->backend.device);
  out.start.set_scene_hash(impl_->scene_hash);
  out.start.set_layout_hash(hash_of_layout(model));
  out.start.set_patch_count(model.layout.patch_count);
  out.start.set_check_every_steps(options.check_every_steps);
  out.start.set_step(started.step);
  if (const v1::SceneAdjustments* values = impl_->adjusted_values()) *out.start.mutable_adjustments() = *values;
  if (started.state) out.start.set_snapshot(write_snapshot(model, impl_->scene_hash, *started.state));
  out.start.set_server_time_ns(unix_time_ns());
  return out;
}
void Runner::stop_recording(const std::shared_ptr<Recording>& recording) {
  (void)impl_->call([&](Loop& loop) { return loop.do_stop_recording(recording); });
}
Result<v1::ReplaySceneResponse> Runner::replay(const v1::ReplaySceneRequest& request) {
  std::uint64_t adjustment = 0;
  TM_ASSIGN_OR_RETURN(replay, impl_->check(request, adjustment));
  // An adjustment replaces the loop, so each part between two edits is a command of its own. Others may adjust the
  // scene between two of them.
  v1::ReplaySceneResponse out;
  std::span<const Replay::Step> left = replay.steps;
  while (!left.empty()) {
    for (const EditPointer& edit : left.front().edits) {
      if (impl_->cancelled) {
        return fail(ErrorCode::kUnavailable,
                    fmt::format("scene '{}' is being unloaded; step {} was not replayed", name(), left.front().index));
      }
      const auto done = impl_->apply(edit);
      if (done && std::holds_alternative<Adjust>(*edit)) ++adjustment;
      if (!done) {
        return fail(done.error().code,
                    fmt::format("an edit before recorded step {}: {}", left.front().index, done.error().message));
      }
    }
    const auto next =
        std::find_if(left.begin() + 1, left.end(), [](const Replay::Step& step) { return !step.edits.empty(); });
    const std::span<const Replay::Step> part(left.begin(), next);
    TM_ASSIGN_OR_RETURN(response, impl_->call([&](Loop& loop) -> Result<v1::ReplaySceneResponse> {
      if (impl_->adjustment == adjustment) return loop.do_replay(part);
      return fail(
          ErrorCode::kFailedPrecondition,
          fmt::format("scene '{}' was adjusted by another client during the replay; replay from the start", name()));
    }));
    out.mutable_checks()->MergeFrom(response.checks());
    *out.mutable_status() = std::move(*response.mutable_status());
    left = left.subspan(part.size());
  }
  const Impl::HeldLoop loop(*impl_);
  out.set_layout_hash(hash_of_layout(loop->model()));
  out.set_scene_hash(impl_->scene_hash);
  return out;
}
Result<v1::SnapshotSceneResponse> Runner::snapshot() {
  const Impl::HeldLoop loop(*impl_);
  TM_ASSIGN_OR_RETURN(state, loop->read([&] { return loop->do_save(); }));
  v1::SnapshotSceneResponse response;
  response.set_step(state.world.step_count);
  response.set_snapshot(write_snapshot(loop->model(), impl_->scene_hash, state));
  if (const v1::SceneAdjustments* values = impl_->adjusted_values()) *response.mutable_adjustments() = *values;
  response.set_scene_hash(impl_->scene_hash);
  return response;
}
Result<v1::SceneStatus> Runner::restore(std::string_view snapshot) {
  return impl_->apply(std::make_shared<const Edit>(Restore{std::string(snapshot)}));
}

StateMark Runner::mark() const {
  // The number of the adjustment comes first: a loop that replaces the present one after it has another mark.
  const std::uint64_t adjustment = impl_->adjustment.load();
  const std::shared_ptr<Loop> loop = impl_->loop();
  return {adjustment, loop->status().changes(), loop->status().state()};
}
Result<KeptState> Runner::keep() {
  // An adjustment may take as long as a load, and nothing of it is lost if the caller comes again.
  const std::unique_lock adjusting(impl_->adjusting, std::try_to_lock);
  if (!adjusting) return fail(ErrorCode::kUnavailable, fmt::format("scene '{}' is being adjusted", name()));
  const Impl::HeldLoop loop(*impl_);
  TM_ASSIGN_OR_RETURN(kept, loop->read([&] { return loop->do_keep(); }));
  return KeptState{impl_->adjustments, kept.paused, write_snapshot(loop->model(), impl_->scene_hash, kept.state),
                   kept.held};
}
bool Runner::turns(std::chrono::nanoseconds late) const { return impl_->loop()->turns(Clock::now(), late); }
bool Runner::device_lost() const { return impl_->loop()->status().device_lost(); }

const v1::Scene* Runner::source() const { return impl_->source ? &impl_->source->scene : nullptr; }

Result<v1::AdjustSceneResponse> Runner::adjust(const v1::SceneAdjustments& changes) {
  if (!impl_->source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(impl_->adjusting);
  TM_ASSIGN_OR_RETURN(wanted, with_changes(impl_->adjustments, changes));
  if (wanted.SerializeAsString() != impl_->adjustments.SerializeAsString()) {
    TM_RETURN_IF_ERROR(impl_->replace_loop(std::move(wanted)));
  }
  v1::AdjustSceneResponse response;
  *response.mutable_status() = status();
  *response.mutable_adjustments() = impl_->adjustments;
  return response;
}

Result<v1::SceneStatus> Runner::Impl::apply(const EditPointer& edit) {
  return std::visit([&](const auto& kind) { return apply(kind, edit); }, *edit);
}

/// Adjusts also to the values that the scene has: a replay needs what that does to the energy balance.
Result<v1::SceneStatus> Runner::Impl::apply(const Adjust& adjust, const EditPointer&) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  TM_ASSIGN_OR_RETURN(wanted, with_changes(adjustments, adjust.values));
  TM_RETURN_IF_ERROR(replace_loop(std::move(wanted)));
  return loop()->status().make();
}

Result<v1::SceneStatus> Runner::Impl::apply(const Restore& restore, const EditPointer& edit) {
  const HeldLoop held(*this);
  // The scene's own arrays have the sizes that the snapshot must have. A scene whose device failed has none to compare
  // with.
  TM_ASSIGN_OR_RETURN(own, held->read([&] { return held->do_save(); }));
  TM_ASSIGN_OR_RETURN(state, read_snapshot(held->model(), scene_hash, own.world.history, restore.snapshot));
  return held->call([&] { return held->do_restore(state, edit); });
}

Result<v1::SceneStatus> Runner::Impl::apply(const Reset&, const EditPointer& edit) {
  return call([&edit](Loop& loop) { return loop.do_reset(edit); });
}

Result<v1::SceneStatus> Runner::Impl::apply(const ChangeScene& change, const EditPointer& edit) {
  return call([&](Loop& loop) { return loop.do_edit(change.edit, edit); });
}

/// Compiles the adjusted scene while the present loop steps. Then takes the present loop's state, and puts a loop that
/// goes on from it in its place.
Result<void> Runner::Impl::replace_loop(v1::SceneAdjustments wanted) {
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(adjusted(source->scene, wanted), source->options));
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  world->set_topology_version(topology.version());  // values do not change what clients see of the mesh
  const auto edit = std::make_shared<const Edit>(Adjust{wanted});
  const std::unique_lock lock(commands);
  const std::shared_ptr<Loop> old = loop();
  TM_ASSERT(hash_of_layout(world->model()) == hash_of_layout(old->model()), "values do not change the order of nodes");
  TM_ASSIGN_OR_RETURN(handed_over, old->call([&] { return old->do_hand_over(); }));
  std::shared_ptr<Loop> next;
  try {
    world->take_over(handed_over.state.world);
    handed_over.start.before = old;
    handed_over.start.edit = edit;
    handed_over.start.signal = signal;
    next = std::make_shared<Loop>(backend.backend, std::move(world), handed_over.start);
  } catch (const std::exception& failure) {
    (void)old->call([&] { return old->do_go_on(std::move(handed_over.start.recording)); });
    return fail(ErrorCode::kUnavailable, fmt::format("the device failed: {}; the scene is unchanged", failure.what()));
  }
  // Nothing from here on can fail: the new loop steps.
  scene_hash = compiled.scene_hash;
  adjustments.Swap(&wanted);
  const std::lock_guard swap(present_mutex);
  present = next;
  ++adjustment;
  if (cancelled) next->cancel();
  return {};
}

Result<void> Runner::submit_pose(std::string_view tool, const v1::ToolPose& pose, PoseSource source) {
  const auto index = impl_->find_tool(tool);
  if (!index) {
    count_malformed_pose();
    return tl::make_unexpected(index.error());
  }
  return impl_->loop()->submit_pose(*index, pose, source);
}
void Runner::count_malformed_pose() { impl_->loop()->count_malformed_pose(); }

void Runner::set_output_signal(std::function<void()> signal) {
  const std::unique_lock lock(impl_->commands);
  impl_->signal = std::move(signal);
  const std::shared_ptr<Loop> loop = impl_->loop();
  (void)loop->call([&] { return loop->do_set_signal(impl_->signal); });
}

bool Runner::take_frame(v1::Frame& frame) { return impl_->loop()->outputs().take_frame(frame); }
bool Runner::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  return impl_->loop()->outputs().take_feedback(feedback);
}
bool Runner::take_status(v1::SceneStatus& status) { return impl_->loop()->take_status(status); }

}  // namespace tensormass::world
