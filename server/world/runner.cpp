#include "world/runner.h"

#include <algorithm>
#include <atomic>
#include <cmath>
#include <map>
#include <mutex>
#include <optional>
#include <span>
#include <thread>
#include <variant>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/log.h"
#include "core/names.h"
#include "core/thread_name.h"
#include "model/values.h"
#include "world/adjustments.h"
#include "world/compiled_scene.h"
#include "world/cuts.h"
#include "world/edits.h"
#include "world/fields.h"
#include "world/hashes.h"
#include "world/loop.h"
#include "world/messages.h"
#include "world/snapshot.h"

namespace tensormass::world {

namespace {

/// Simulated time between two cuts of what blades sweep in a scene that steps by hand.
constexpr double kBetweenCutsS = 0.1;

std::string write_snapshot(const Generation& generation, const LoopCopy& copy) {
  return world::write_snapshot(*generation.model, generation.scene_hash, by_node(*generation.model, copy));
}

}  // namespace

/// The message of a scene and how it was compiled, for `adjust`.
struct Source {
  v1::Scene scene;
  RunnerOptions options;
};

/// The loop, and what stays constant while the scene is loaded.
///
/// An adjustment swaps the loop's world between two steps. What a caller gets of a state comes with the generation of
/// that state, so nobody waits for an adjustment.
struct Runner::Impl {
  Impl(CompiledScene compiled, std::unique_ptr<World> world, std::unique_ptr<const Source> from)
      : report(std::move(compiled.report)),
        backend{compiled.backend->name(), compiled.backend->device(), {}},
        source(std::move(from)),
        topology(make_topology(world->model(), new_topology_version())) {
    for (std::size_t i = 0; i < world->model().tools.size(); ++i) tool_index.emplace(world->model().tools[i].name, i);
    world->set_topology_version(topology.version());
    auto generation =
        std::make_shared<const Generation>(Generation{0,
                                                      world->shared_model(),
                                                      compiled.scene_hash,
                                                      source ? adjustments_of(source->scene) : v1::SceneAdjustments{},
                                                      false,
                                                      {}});
    loop = std::make_unique<Loop>(backend.backend, std::move(world), std::move(generation));
    if (has_blades() && !loop->generation()->model->lockstep) changer.start(*this);
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

  /// Runs a command on the loop's thread and waits for its result.
  /// command: Result<T>(Loop&)
  template <class Command>
  auto call(const Command& command) {
    return loop->call([&] { return command(*loop); });
  }

  /// The same for a command that changes nothing.
  template <class Command>
  auto read(const Command& command) {
    return loop->read([&] { return command(*loop); });
  }

  /// Does an edit of the list in edits.h.
  Result<v1::SceneStatus> apply(const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Adjust& adjust, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Restore& restore, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const Reset& reset, const EditPointer& edit);
  Result<v1::SceneStatus> apply(const ChangeScene& change, const EditPointer& edit);
  Result<void> take_values(v1::SceneAdjustments wanted);
  Result<void> write_values(const v1::Scene& scene, v1::SceneAdjustments wanted,
                            std::shared_ptr<const model::Model> model);
  GenerationPointer next_generation(const Generation& present, std::shared_ptr<const model::Model> model,
                                    std::uint64_t scene_hash, v1::SceneAdjustments wanted, model::SceneCuts cuts) const;
  Result<void> swap_world(v1::SceneAdjustments wanted, model::SceneCuts cuts, const EditPointer& reset = nullptr);
  Result<v1::SceneStatus> cut(const v1::SceneEdit& edit);
  void refuse(std::string_view what, const Error& error) const;
  void forget_parts() {
    coming.reset();
    comes = false;
  }
  Result<v1::SceneStatus> step_in_parts(std::uint32_t count);
  Result<void> change_values(v1::SceneAdjustments wanted);
  Result<void> take_next_part();
  Result<void> take_due_part();
  Result<void> take_last_part();
  /// Returns the values that the scene has after the last part of a change. Needs `adjusting`.
  v1::SceneAdjustments wanted_values() const { return coming ? coming->wanted : loop->generation()->adjustments; }
  Result<void> take_cuts(model::SceneCuts cuts);
  Result<void> cut_what_was_swept();
  bool has_blades() const { return source != nullptr && loop->generation()->model->links.blades.count() > 0; }

  /// A change of stiffness that comes in parts.
  struct Coming {
    v1::SceneAdjustments wanted;
    std::uint64_t step = 0;  ///< after which the next part comes
  };

  /// Changes a scene that runs by the clock on a thread of its own: cuts what blades sweep, as long as something new
  /// was swept, and takes the parts of a change of values.
  class Changer {
   public:
    void start(Impl& of) {
      if (impl_ != nullptr) return;
      impl_ = &of;
      thread_ = std::thread([this] { run(); });
    }
    ~Changer() {
      if (impl_ == nullptr) return;
      ends_ = true;
      impl_->loop->stop_waiting();
      thread_.join();
    }

   private:
    void run() {
      name_thread("change");
      for (std::uint32_t seen = 0; !ends_;) {
        seen = impl_->loop->wait_for_work(seen);
        if (ends_ || impl_->loop->cancelled()) continue;
        if (const auto part = impl_->take_due_part(); !part) impl_->refuse("values", part.error());
        if (!impl_->has_blades()) continue;
        if (const auto cut = impl_->cut_what_was_swept(); !cut) impl_->refuse("cut", cut.error());
      }
    }

    Impl* impl_ = nullptr;
    std::atomic<bool> ends_{false};
    std::thread thread_;
  };

  const v1::SceneReport report;
  const BackendDescription backend;
  const std::unique_ptr<const Source> source;  // nullptr: the scene cannot be adjusted
  const v1::Topology topology;
  std::map<std::string, std::size_t, std::less<>> tool_index;

  std::mutex adjusting;            // one change of values or cuts at a time
  std::optional<Coming> coming;    // guarded by `adjusting`
  std::atomic<bool> comes{false};  // `coming` has a value
  std::unique_ptr<Loop> loop;      // its thread ends before all of the above
  Changer changer;                 // last: uses the loop
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
  if (impl_->has_blades() || impl_->comes) return impl_->step_in_parts(count);
  return impl_->call([count](Loop& loop) { return loop.do_step(count); });
}
Result<v1::SceneStatus> Runner::edit(const v1::SceneEdit& change) {
  if (!change.cuts().empty()) return impl_->cut(change);
  return impl_->apply(std::make_shared<const Edit>(ChangeScene{change}));
}
Result<v1::SceneStatus> Runner::reset() { return impl_->apply(std::make_shared<const Edit>(Reset{})); }
v1::SceneStatus Runner::status() const { return impl_->loop->status().make(); }
SceneMetrics Runner::metrics() const {
  const Loop* const loop = impl_->loop.get();
  const LoopStatus& status = loop->status();
  SceneMetrics out{status.make(), impl_->report.bytes_total(), {}, status.statistics(), status.counts()};
  for (const auto& [name, tool] : impl_->tool_index) {
    const PoseInbox& inbox = loop->inbox(tool);
    out.tools.push_back({name, inbox.received(), inbox.rejected(), inbox.superseded()});
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
  TM_ASSIGN_OR_RETURN(index, impl_->find_tool(tool));
  return impl_->read([i = index](Loop& loop) { return loop.do_feedback(i); });
}

Result<StartedRecording> Runner::record(const RecordingOptions& options) {
  TM_ASSIGN_OR_RETURN(started, impl_->call([&](Loop& loop) { return loop.do_record(options); }));
  const Generation& generation = *started.generation;
  const model::Model& model = *generation.model;
  StartedRecording out{started.recording, {}};
  out.start.set_scene(model.name);
  out.start.set_backend(impl_->backend.backend);
  out.start.set_device(impl_->backend.device);
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
  std::span<const Replay::Step> left = replay.steps;
  while (!left.empty()) {
    for (const EditPointer& edit : left.front().edits) {
      if (impl_->loop->cancelled()) {
        return fail(ErrorCode::kUnavailable,
                    fmt::format("scene '{}' is being unloaded; step {} was not replayed", name(), left.front().index));
      }
      const bool heals = std::holds_alternative<Reset>(*edit) && !impl_->loop->generation()->cuts.empty();
      const auto done = impl_->apply(edit);
      if (done && (heals || std::holds_alternative<Adjust>(*edit))) ++number;
      if (!done) {
        return fail(done.error().code,
                    fmt::format("an edit before recorded step {}: {}", left.front().index, done.error().message));
      }
    }
    const auto next =
        std::find_if(left.begin() + 1, left.end(), [](const Replay::Step& step) { return !step.edits.empty(); });
    const std::span<const Replay::Step> part(left.begin(), next);
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

Result<v1::SceneStatus> Runner::Impl::apply(const EditPointer& edit) {
  return std::visit([&](const auto& kind) { return apply(kind, edit); }, *edit);
}

/// Adjusts also to the values that the scene has: a replay needs what that does to the energy balance.
Result<v1::SceneStatus> Runner::Impl::apply(const Adjust& adjust, const EditPointer&) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  TM_ASSIGN_OR_RETURN(wanted, with_changes(loop->generation()->adjustments, adjust.values));
  TM_RETURN_IF_ERROR(take_values(std::move(wanted)));
  forget_parts();
  return loop->status().make();
}

/// Changes values at once, or, where a tool touches tissue whose stiffness changes much, from part to part. Each part
/// is an adjustment of its own, so a recording has it and a snapshot names its values. Needs `adjusting`.
Result<void> Runner::Impl::change_values(v1::SceneAdjustments wanted) {
  // Refuses bad values before the first part.
  const v1::SceneAdjustments part = next_part(loop->generation()->adjustments, wanted);
  const bool in_parts = part.SerializeAsString() != wanted.SerializeAsString();
  TM_ASSIGN_OR_RETURN(touching, loop->call([&] { return loop->do_touching(); }));
  if (!in_parts || !touching) {
    TM_RETURN_IF_ERROR(take_values(std::move(wanted)));
    forget_parts();
    return {};
  }
  TM_RETURN_IF_ERROR(model::with_values(*loop->generation()->model, adjusted(source->scene, wanted)));
  coming = Coming{std::move(wanted), 0};
  const auto taken = take_next_part();
  if (!taken) forget_parts();
  return taken;
}

/// Takes the next part of the change that comes. Without a tool that touches it is the last one. Needs `adjusting`.
Result<void> Runner::Impl::take_next_part() {
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(touching, loop->call([&] { return loop->do_touching(); }));
  v1::SceneAdjustments part = next_part(present->adjustments, coming->wanted);
  v1::SceneAdjustments last = with_cuts_of(present->adjustments, coming->wanted);
  const bool ends = !touching || part.SerializeAsString() == last.SerializeAsString();
  TM_RETURN_IF_ERROR(take_values(ends ? std::move(last) : std::move(part)));
  if (ends) {
    forget_parts();
    return {};
  }
  const auto steps = std::max(1L, std::lround(kBetweenPartsS / present->model->dt_s));
  coming->step = loop->status().make().step() + static_cast<std::uint64_t>(steps);
  comes = true;
  loop->wake_at(coming->step);
  if (!present->model->lockstep) changer.start(*this);
  return {};
}

/// Takes the next part if its step is done.
Result<void> Runner::Impl::take_due_part() {
  const std::lock_guard lock(adjusting);
  if (!coming || loop->status().make().step() < coming->step) return {};
  const auto taken = take_next_part();
  if (!taken) forget_parts();
  return taken;
}

/// Takes what is left of a change at once: nothing touches after a reset. Needs `adjusting`.
Result<void> Runner::Impl::take_last_part() {
  if (!coming) return {};
  TM_RETURN_IF_ERROR(take_values(with_cuts_of(loop->generation()->adjustments, coming->wanted)));
  forget_parts();
  return {};
}

/// Gives the scene other values and cuts: in place if only numbers change, else by another world. Needs `adjusting`.
Result<void> Runner::Impl::take_values(v1::SceneAdjustments wanted) {
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, read_cuts(source->scene, wanted, present->cuts));
  if (cuts == present->cuts) {
    const v1::Scene scene = adjusted(source->scene, wanted);
    TM_ASSIGN_OR_RETURN(model, model::with_values(*present->model, scene));
    if (model != nullptr) return write_values(scene, std::move(wanted), std::move(model));
  }
  return swap_world(std::move(wanted), std::move(cuts));
}

/// Gives the world other values in place. Needs `adjusting`. scene: with the values; model: of that scene
Result<void> Runner::Impl::write_values(const v1::Scene& scene, v1::SceneAdjustments wanted,
                                        std::shared_ptr<const model::Model> model) {
  const GenerationPointer present = loop->generation();
  const auto edit = std::make_shared<const Edit>(Adjust{wanted});
  TM_ASSIGN_OR_RETURN(values, loop->prepare_values(model));
  auto next = next_generation(*present, std::move(model), hash_of(scene), std::move(wanted), present->cuts);
  Loop::NewValues all{std::move(values), std::move(next), edit};
  return loop->call([&] { return loop->do_take_values(all); });
}

/// scene_hash: of the values without the cuts
GenerationPointer Runner::Impl::next_generation(const Generation& present, std::shared_ptr<const model::Model> model,
                                                std::uint64_t scene_hash, v1::SceneAdjustments wanted,
                                                model::SceneCuts cuts) const {
  const bool is_adjusted = wanted.SerializeAsString() != adjustments_of(source->scene).SerializeAsString();
  if (!cuts.empty()) scene_hash = hash_of_cut(scene_hash, wanted);
  return std::make_shared<const Generation>(
      Generation{present.number + 1, std::move(model), scene_hash, std::move(wanted), is_adjusted, std::move(cuts)});
}

/// A cut is an adjustment of the values, so that recordings and snapshots have it.
Result<v1::SceneStatus> Runner::Impl::cut(const v1::SceneEdit& edit) {
  if (!source) return fail(ErrorCode::kFailedPrecondition, "the scene was not loaded from a message");
  const std::lock_guard lock(adjusting);
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, cut_edges(source->scene, edit, present->cuts));
  TM_RETURN_IF_ERROR(take_cuts(std::move(cuts)));
  return loop->status().make();
}

/// Goes on with the scene cut. Needs `adjusting`.
Result<void> Runner::Impl::take_cuts(model::SceneCuts cuts) {
  v1::SceneAdjustments wanted = loop->generation()->adjustments;
  write_cuts(cuts, wanted);
  return swap_world(std::move(wanted), std::move(cuts));
}

/// Says why tissue stays whole although a blade went through, or keeps its values. The scene goes on.
void Runner::Impl::refuse(std::string_view what, const Error& error) const {
  log::warn(fmt::format("{} refused", what), {{"scene", topology.scene()}, {"reason", error.message}});
}

/// Makes steps by hand. Cuts what was swept, and takes parts of a change of values, where the number of steps says so,
/// so that a run repeats.
Result<v1::SceneStatus> Runner::Impl::step_in_parts(std::uint32_t count) {
  const auto steps =
      static_cast<std::uint64_t>(std::max(1L, std::lround(kBetweenCutsS / loop->generation()->model->dt_s)));
  for (;;) {
    const std::uint64_t made = loop->status().make().step();
    std::uint64_t part = has_blades() ? std::min<std::uint64_t>(count, steps - made % steps) : count;
    {
      const std::lock_guard lock(adjusting);
      if (coming && coming->step > made) part = std::min(part, coming->step - made);
    }
    TM_ASSIGN_OR_RETURN(status, call([&](Loop& of) { return of.do_step(static_cast<std::uint32_t>(part)); }));
    if (const auto taken = take_due_part(); !taken) refuse("values", taken.error());
    if (has_blades() && status.step() % steps == 0) {
      if (const auto cut = cut_what_was_swept(); !cut) refuse("cut", cut.error());
    }
    if (count == part) return loop->status().make();
    count -= static_cast<std::uint32_t>(part);
  }
}

/// Cuts what blades have swept since the last call.
Result<void> Runner::Impl::cut_what_was_swept() {
  const std::lock_guard lock(adjusting);
  TM_ASSIGN_OR_RETURN(ways, loop->call([&] { return loop->do_take_ways(); }));
  if (ways.empty()) return {};
  const GenerationPointer present = loop->generation();
  TM_ASSIGN_OR_RETURN(cuts, cut_along(source->scene, ways, present->cuts));
  return cuts == present->cuts ? Result<void>{} : take_cuts(std::move(cuts));
}

Result<v1::SceneStatus> Runner::Impl::apply(const Restore& restore, const EditPointer& edit) {
  for (;;) {
    const GenerationPointer present = loop->generation();
    TM_ASSIGN_OR_RETURN(state, read_snapshot(*present->model, present->scene_hash, restore.snapshot));
    const LoopCopy copy = in_layout(*present->model, state);
    auto restored = loop->call([&] { return loop->do_restore(copy, edit, present); });
    // Adjusted since: the snapshot is read again, and refused with the reason.
    if (restored || loop->generation() == present) return restored;
  }
}

/// A reset heals cuts: the scene is the one that was loaded again.
Result<v1::SceneStatus> Runner::Impl::apply(const Reset&, const EditPointer& edit) {
  if (source) {
    const std::lock_guard lock(adjusting);
    TM_RETURN_IF_ERROR(take_last_part());
    if (const GenerationPointer present = loop->generation(); !present->cuts.empty()) {
      v1::SceneAdjustments wanted = present->adjustments;
      write_cuts({}, wanted);
      TM_RETURN_IF_ERROR(swap_world(std::move(wanted), {}, edit));
      return loop->status().make();
    }
  }
  return loop->call([&] { return loop->do_reset(edit); });
}

Result<v1::SceneStatus> Runner::Impl::apply(const ChangeScene& change, const EditPointer& edit) {
  return loop->call([&] { return loop->do_edit(change.edit, edit); });
}

/// Compiles the adjusted scene while the present world steps. Then swaps the two. Needs `adjusting`.
/// cuts: those of `wanted`. reset: the edit that takes the scene to its start; nullptr: it goes on from its state
Result<void> Runner::Impl::swap_world(v1::SceneAdjustments wanted, model::SceneCuts cuts, const EditPointer& reset) {
  const GenerationPointer present = loop->generation();
  const bool same_cuts = cuts == present->cuts;
  TM_ASSIGN_OR_RETURN(compiled, compile_scene(adjusted(source->scene, wanted), source->options, {}, cuts));
  TM_ASSIGN_OR_RETURN(world, World::create(std::move(compiled.model), *compiled.backend));
  world->set_topology_version(topology.version());  // values do not change what clients see of the mesh
  TM_ASSERT(!same_cuts || hash_of_layout(world->model()) == hash_of_layout(*present->model),
            "values do not change the order of nodes");
  const auto edit = std::make_shared<const Edit>(Adjust{wanted});
  const bool has_frames = world->model().visible.count() > 0;
  std::shared_ptr<SurfaceChanges> surface = same_cuts || !has_frames ? nullptr : changes_of(world->model(), cuts);
  const auto next =
      next_generation(*present, world->shared_model(), compiled.scene_hash, std::move(wanted), std::move(cuts));
  Loop::Swap swap{std::move(world), next, reset == nullptr ? edit : nullptr, std::move(surface), reset == nullptr};
  return loop->call([&]() -> Result<void> {
    TM_RETURN_IF_ERROR(loop->do_swap(swap));
    if (reset != nullptr) TM_RETURN_IF_ERROR(loop->do_reset(reset));
    return {};
  });
}

Result<void> Runner::submit_pose(std::string_view tool, const v1::ToolPose& pose, PoseSource source) {
  const auto index = impl_->find_tool(tool);
  if (!index) {
    count_malformed_pose();
    return tl::make_unexpected(index.error());
  }
  return impl_->loop->submit_pose(*index, pose, source);
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
