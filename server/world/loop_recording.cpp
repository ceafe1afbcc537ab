#include <algorithm>
#include <array>
#include <new>
#include <numeric>

#include "world/cut_state.h"
#include "world/cuts.h"
#include "world/hashes.h"
#include "world/loop.h"
#include "world/tool_changes.h"

/// The loop's commands for recordings, replays, snapshots and adjustments. Each runs between two steps.
namespace tensormass::world {

void Loop::record_step(StepEnd end) {
  end.server_time_ns = unix_time_ns();
  end.recovered = world_->recovering();
  recording_->end_step(end);
  if (!end.rejected && recording_->check_due()) {
    recording_->take_check(end.step, world_->state(), world_->shared_model());
  }
}

Result<Loop::StartedRecording> Loop::do_record(const RecordingOptions& options) {
  TM_RETURN_IF_ERROR(require_state());
  drop_abandoned_recording();
  if (recording_) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("scene '{}' is being recorded; end that recording first", model().name));
  }
  StartedRecording out;
  if (options.reset) {
    (void)do_reset(nullptr);  // nothing records it yet
  } else {
    TM_ASSIGN_OR_RETURN(copy, do_save());
    out.state = std::move(copy.state);
  }
  out.generation = generation();
  out.step = world_->step_count();
  out.recording = recording_ = std::make_shared<Recording>(model(), options);
  return out;
}

Result<void> Loop::do_stop_recording(const std::shared_ptr<Recording>& recording) {
  if (recording_ == recording) recording_.reset();
  return {};
}

Result<v1::ReplaySceneResponse> Loop::do_replay(std::span<const Replay::Step> steps) {
  TM_ASSERT(model().lockstep, "read_replay refuses a scene that runs by the clock");
  v1::ReplaySceneResponse response;
  for (const Replay::Step& step : steps) {
    const auto unloaded = [&] { return unload_error(fmt::format("step {} was not replayed", step.index)); };
    if (cancelled_.load(std::memory_order_relaxed)) return unloaded();
    TM_RETURN_IF_ERROR(status_.require_not_faulted());
    if (step.step != world_->step_count() + 1) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("recorded step {} of the scene cannot follow its step {}; replay from the start",
                              step.step, world_->step_count()));
    }
    world_->set_cg_limit(step.cg_limit);
    if (step.evaluates_all) world_->evaluate_all_next();
    for (const auto& [tool, received] : step.poses) {
      world_->set_tool_target(tool, received.pose, received.stamp, received.valid_for_s, received.level);
      if (recording_) recording_->take_pose(tool, received);
    }
    const Clock::time_point begin = Clock::now();
    const bool last = &step == &steps.back();
    const bool good =
        make_step(lockstep_frame_due(begin, last), step.diagnosed ? Diagnostics::kNow : Diagnostics::kNever);
    if (cancelled_.load(std::memory_order_relaxed)) return unloaded();
    if (device_failed_) TM_RETURN_IF_ERROR(status_.require_not_faulted());
    status_.take_time(begin, Clock::now(), true);
    if (good == step.rejected) {
      return fail(ErrorCode::kFailedPrecondition,
                  good ? fmt::format("step {} was rejected by a guard when it was recorded, and is good now", step.step)
                       : fmt::format("step {} was good when it was recorded. {}", step.step,
                                     status_.require_not_faulted().error().message));
    }
    if (good && step.checks) {
      *response.add_checks() = make_check(step.index, step.step, world_->state(), model().layout.row_of_node);
    }
  }
  *response.mutable_status() = status_.make();
  return response;
}

Result<World::Copied> Loop::do_copy() {
  TM_RETURN_IF_ERROR(require_state());
  return world_->copy();
}

Result<Loop::SavedState> Loop::do_save() {
  TM_ASSIGN_OR_RETURN(copy, do_copy());
  world_->evaluate_all_next();
  return SavedState{{std::move(copy), next_diagnostics_}, generation()};
}

Result<Loop::Kept> Loop::do_keep() {
  const Clock::time_point begin = Clock::now();
  if (cancelled_.load(std::memory_order_relaxed)) return unload_error("its state was not kept");
  TM_ASSIGN_OR_RETURN(copy, do_save());
  return Kept{std::move(copy), status_.state() == v1::SceneStatus::STATE_PAUSED, Clock::now() - begin};
}

void Loop::drop_abandoned_recording() {
  if (!recording_ || !recording_->abandoned()) return;
  recording_->evict();
  recording_.reset();
}

Result<void> Loop::do_swap(Swap& swap) {
  TM_RETURN_IF_ERROR(require_state());
  std::unique_ptr<World>& next = swap.world;
  const GenerationPointer before = generation();
  const double area_m2 = area_of(swap.generation->cuts), cut_m2 = area_m2 - area_of(before->cuts);
  const bool cuts = swap.generation->cuts != before->cuts;
  const std::vector<FreedPiece> freed = freed_pieces(before->cuts, swap.generation->cuts);
  const bool tools_change = swap.places.has_value(), parts_change = tools_change || swap.attachments.has_value();
  std::shared_ptr<const RecordedTools> recorded;
  if (parts_change && recording_ && !recording_->takes_change()) return changes_error();
  try {
    try {
      if (tools_change && recording_) recorded = std::make_shared<const RecordedTools>(next->model());
      if (!tools_change) {
        swap.places.emplace(model().tools.size());
        std::iota(swap.places->begin(), swap.places->end(), std::size_t{0});
      }
      if (swap.takes_state) {
        World::Saved saved = World::by_node(*world_->shared_model(), world_->copy());
        if (cuts) {
          TM_ASSIGN_OR_RETURN(tissue, cut_state(*world_->shared_model(), saved.tissue, next->model()));
          saved.tissue = std::move(tissue);
        }
        if (swap.attachments) {
          saved.tissue = with_attachments(*world_->shared_model(), next->model(), saved, swap.attachments->places);
        }
        if (tools_change) saved = with_tools(*world_->shared_model(), next->model(), saved, *swap.places);
        if (swap.same_values) {
          next->restore(saved);
        } else {
          next->take_over(saved);
        }
        next->sweeps().go_on_with(world_->sweeps(), *swap.places);
      }
    } catch (const std::bad_alloc&) {
      throw;
    } catch (const std::exception& failure) {
      return fail(ErrorCode::kUnavailable,
                  fmt::format("the device failed: {}; the scene is unchanged", failure.what()));
    }
  } catch (const std::bad_alloc&) {
    return fail(ErrorCode::kResourceExhausted, "the server has no memory for the change; the scene is unchanged");
  }
  // Nothing from here on can fail.
  {
    const std::lock_guard lock(cancelling_);
    world_.swap(next);
    if (cancelled()) world_->stop();
  }
  if (recorded != nullptr) recording_->go_on_with(std::move(recorded));
  if (tools_change) take_tools(swap.generation->inboxes, *swap.places);
  go_on_with_new_values(std::move(swap.generation), std::move(swap.edit), parts_change);
  if (tools_change) tell_of_tools(*before->model, *swap.places);
  if (swap.attachments) tell_of_attachments(*swap.attachments);
  status_.take_cut_area(area_m2);
  if (swap.surface != nullptr) outputs_.set_changes(surface_.number(std::move(swap.surface)));
  if (cut_m2 > 0) {
    outputs_.add_event({.kind = EventKind::kCut, .step = world_->step_count(), .value = cut_m2});
  } else if (!cuts && !swap.same_values) {  // edges may be cut before any element is
    outputs_.add_event({.kind = EventKind::kAdjusted, .step = world_->step_count()});
  }
  for (const FreedPiece& piece : freed) {
    outputs_.add_event(
        {.kind = EventKind::kPieceFree, .step = world_->step_count(), .body = piece.body, .value = piece.volume_m3});
  }
  publish_new_values();
  return {};
}

/// Goes on with other tools. Needs no memory. inboxes: those of the next generation; places: as of places_before
void Loop::take_tools(const PoseInboxes& inboxes, std::span<const std::size_t> places) {
  std::array<bool, limits::kMaxTools> stays{};
  std::array<Clock::time_point, limits::kMaxTools> expiry{};
  std::size_t leading = kNone;
  for (std::size_t i = 0; i < places.size(); ++i) {
    const bool is_new = places[i] == kNewTool;
    expiry[i] = is_new ? Clock::time_point::max() : expiry_[places[i]];
    if (is_new) continue;
    stays[places[i]] = true;
    if (places[i] == leading_) leading = i;
  }
  for (std::size_t i = 0; i < inboxes_.size(); ++i) {
    if (!stays[i]) poses_.add(*inboxes_[i]);
  }
  inboxes_ = inboxes;
  expiry_.assign(expiry.begin(), expiry.begin() + static_cast<std::ptrdiff_t>(places.size()));
  leading_ = leading;
}

/// Tells of tools that have gone and come. before: the model with the former
void Loop::tell_of_tools(const model::Model& before, std::span<const std::size_t> places) {
  for (std::size_t i = 0; i < before.tools.size(); ++i) {
    if (std::find(places.begin(), places.end(), i) != places.end()) continue;
    outputs_.add_event(
        {.kind = EventKind::kToolRemoved, .step = world_->step_count(), .tool_name = FixedName(before.tools[i].name)});
  }
  for (std::size_t i = 0; i < places.size(); ++i) {
    if (places[i] != kNewTool) continue;
    outputs_.add_event({.kind = EventKind::kToolAdded,
                        .step = world_->step_count(),
                        .tool = static_cast<std::uint32_t>(i),
                        .position_m = world_->tip_m(i)});
  }
}

/// Tells of attachments that have gone and come.
void Loop::tell_of_attachments(const AttachmentChange& change) {
  for (const AttachmentChange::Told& one : change.told) {
    outputs_.add_event({.kind = one.added ? EventKind::kAttachmentAdded : EventKind::kAttachmentRemoved,
                        .step = world_->step_count(),
                        .attachment_name = one.name,
                        .value = static_cast<double>(one.springs)});
  }
}

/// Tells everybody that the world has other values, tools or attachments.
void Loop::go_on_with_new_values(GenerationPointer next, EditPointer edit, bool parts_change) {
  const bool was_faulted = status_.state() == v1::SceneStatus::STATE_FAULTED;
  outputs_.go_on_with(*world_, parts_change);
  status_.go_on_with(world_->shared_model());
  (void)generation_.replace(std::move(next));
  next_diagnostics_ = 0;
  if (was_faulted) clock_.restart(Clock::now());
  if (recording_ && edit) recording_->take_edit({std::move(edit), world_->step_count()});
  outputs_.take_step(Clock::now());
  if (parts_change) outputs_.repeat_changes();  // with the version of the new topology
  take_edits();
}

void Loop::publish_new_values() {
  if (status_.state() == v1::SceneStatus::STATE_PAUSED) outputs_.release_tools();
  status_.take_stamp(outputs_.stamp());
  outputs_.publish(true);
}

Result<World::Values> Loop::prepare_values(std::shared_ptr<const model::Model> next) const try {
  return world_->prepare_values(std::move(next));
} catch (const std::bad_alloc&) {
  return fail(ErrorCode::kResourceExhausted, "the server has no memory for the change; the scene is unchanged");
} catch (const std::exception& failure) {
  return fail(ErrorCode::kUnavailable, fmt::format("the device failed: {}; the scene is unchanged", failure.what()));
}

Result<void> Loop::do_take_values(NewValues& next) {
  TM_RETURN_IF_ERROR(require_state());
  world_->take_values(next.values);
  go_on_with_new_values(std::move(next.generation), std::move(next.edit));
  outputs_.add_event({.kind = EventKind::kAdjusted, .step = world_->step_count()});
  publish_new_values();
  return {};
}

Result<bool> Loop::do_touching() const {
  return std::any_of(world_->readings().begin(), world_->readings().end(),
                     [](const ToolReading& reading) { return reading.touching; });
}

Result<std::vector<SweptWay>> Loop::do_take_ways() {
  TM_RETURN_IF_ERROR(require_state());
  if (!world_->sweeps().has_news()) return std::vector<SweptWay>();
  try {
    return world_->sweeps().take_ways();
  } catch (const std::bad_alloc&) {
    return fail(ErrorCode::kResourceExhausted, "the server has no memory for the cut; the scene goes on");
  }
}

Result<v1::SceneStatus> Loop::do_restore(const LoopCopy& state, EditPointer edit, const GenerationPointer& generation) {
  TM_RETURN_IF_ERROR(require_state());
  if (generation_.get() != generation) {
    return fail(ErrorCode::kUnavailable, fmt::format("scene '{}' was adjusted at the same time", model().name));
  }
  if (const auto fits = world_->check_shares(state.world); !fits) {
    return fail(fits.error().code, "snapshot.ablated_elements: " + fits.error().message);
  }
  budget_.clear();
  world_->restore(state.world);
  next_diagnostics_ = state.next_diagnostics;
  outputs_.add_event({.kind = EventKind::kRestored, .step = state.world.step_count});
  if (recording_) recording_->take_edit({std::move(edit), state.world.step_count});
  go_on_from_new_state();
  return status_.make();
}

}  // namespace tensormass::world
