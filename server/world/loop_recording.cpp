#include "world/hashes.h"
#include "world/loop.h"

/// The loop's commands for recordings, replays, snapshots and adjustments. Each runs between two steps.
namespace tensormass::world {

void Loop::record_step(std::uint64_t step, std::uint32_t cg_limit, bool diagnosed, bool rejected) {
  recording_->end_step({.step = step,
                        .server_time_ns = unix_time_ns(),
                        .cg_limit = cg_limit,
                        .diagnosed = diagnosed,
                        .rejected = rejected,
                        .recovered = world_->recovering()});
  if (!rejected && recording_->check_due()) recording_->take_check(step, world_->state());
}

Result<Loop::StartedRecording> Loop::do_record(const RecordingOptions& options) {
  TM_RETURN_IF_ERROR(require_state());
  drop_abandoned_recording();
  if (recording_) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("scene '{}' is being recorded; end that recording first", model_.name));
  }
  StartedRecording out;
  if (options.reset) {
    (void)do_reset(nullptr);  // nothing records it yet
  } else {
    TM_ASSIGN_OR_RETURN(state, do_save());
    out.state = std::move(state);
  }
  out.step = world_->step_count();
  out.recording = recording_ = std::make_shared<Recording>(model_, options);
  return out;
}

Result<void> Loop::do_stop_recording(const std::shared_ptr<Recording>& recording) {
  if (recording_ == recording) recording_.reset();
  return {};
}

Result<v1::ReplaySceneResponse> Loop::do_replay(std::span<const Replay::Step> steps) {
  TM_ASSERT(model_.lockstep, "read_replay refuses a scene that runs by the clock");
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
    for (const auto& [tool, received] : step.poses) {
      world_->set_tool_target(tool, received.pose, received.stamp, received.valid_for_s);
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
      *response.add_checks() = make_check(step.index, step.step, world_->state(), model_.layout.row_of_node);
    }
  }
  *response.mutable_status() = status_.make();
  return response;
}

Result<LoopState> Loop::do_save() {
  TM_RETURN_IF_ERROR(require_state());
  return LoopState{world_->save(), next_diagnostics_};
}

Result<Loop::Kept> Loop::do_keep() {
  const Clock::time_point begin = Clock::now();
  if (cancelled_.load(std::memory_order_relaxed)) return unload_error("its state was not kept");
  TM_ASSIGN_OR_RETURN(state, do_save());
  return Kept{std::move(state), status_.state() == v1::SceneStatus::STATE_PAUSED, Clock::now() - begin};
}

void Loop::drop_abandoned_recording() {
  if (!recording_ || !recording_->abandoned()) return;
  recording_->evict();
  recording_.reset();
}

Result<Loop::HandedOver> Loop::do_hand_over() {
  TM_ASSIGN_OR_RETURN(state, do_save());
  handed_over_ = true;
  Start start{.paused = status_.state() == v1::SceneStatus::STATE_PAUSED,
              .frames_published = outputs_.frames_published(),
              .statistics = status_.statistics(),
              .counts = status_.counts()};
  start.recording = std::move(recording_);
  start.inboxes = inboxes_;
  return HandedOver{std::move(state), std::move(start)};
}

Result<void> Loop::do_go_on(std::shared_ptr<Recording> recording) {
  handed_over_ = false;
  recording_ = std::move(recording);
  clock_.restart(Clock::now());
  return {};
}

Result<v1::SceneStatus> Loop::do_restore(const LoopState& state, EditPointer edit) {
  if (const auto fits = world_->check_shares(state.world); !fits) {
    return fail(fits.error().code, "snapshot.ablated_elements: " + fits.error().message);
  }
  budget_.clear();
  world_->restore(state.world);
  next_diagnostics_ = state.next_diagnostics;
  if (recording_) recording_->take_edit({std::move(edit), state.world.step_count});
  go_on_from_new_state();
  return status_.make();
}

}  // namespace tensormass::world
