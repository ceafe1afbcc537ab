#pragma once

#include <atomic>
#include <chrono>
#include <condition_variable>
#include <cstdint>
#include <deque>
#include <functional>
#include <future>
#include <limits>
#include <memory>
#include <mutex>
#include <new>
#include <optional>
#include <span>
#include <string_view>
#include <thread>
#include <vector>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/result.h"
#include "tensormass/v1/control.pb.h"
#include "world/attachment_changes.h"
#include "world/generation.h"
#include "world/hand_phase.h"
#include "world/iteration_budget.h"
#include "world/loop_outputs.h"
#include "world/loop_status.h"
#include "world/pose_inbox.h"
#include "world/present.h"
#include "world/recording.h"
#include "world/replay.h"
#include "world/snapshot.h"
#include "world/step_clock.h"
#include "world/world.h"

/// The loop of a scene, on a thread of its own:
///
///     wait for the next step or a command -> run commands -> take the newest poses -> step the world -> publish
///      ^                                                                                                   |
///      +---------------------------------------------------------------------------------------------------+
///
///     from               through                     to           who waits                 what is dropped
///
///     client's pose      PoseInbox, one a tool       the loop     writers, for each other   all but the newest pose
///     control (Runner)   queue of commands, mutex    the loop     the caller, for a result  nothing
///     the loop           LoopOutputs, mailboxes      publisher    nobody                    all but the newest frame
///     the loop           LoopStatus, atomics         anyone       nobody                    -
///     the loop           Recording, rings            one reader   nobody                    steps, and the reader sees
///     it
///
/// The loop waits for no client, no publisher and no caller: it and they hold the queue's mutex only to put a command
/// in, to take one out and to wake the loop. Only the loop's thread touches the world, so the world needs no lock. A
/// step allocates nothing.
namespace tensormass::world {

Result<const model::BodyModel*> find_body(const model::Model& model, std::string_view name);
/// Returns the place of a tool.
Result<std::size_t> find_tool(const model::Model& model, std::string_view name);

class Loop {
 public:
  /// The state that fields are measured from, by the thread that asked and not by the loop.
  struct FieldSource {
    backend::RowState state;
    std::uint64_t step;
    double simulated_time_s;
    GenerationPointer generation;
    std::shared_ptr<const model::Model> edited;  ///< the model as it is now, in a scene with editing; else nullptr
  };

  /// Starts the thread. device: for the status
  Loop(SceneDevice device, std::unique_ptr<World> world, GenerationPointer generation);
  /// Ends the thread after the step at hand. No `call` may be under way.
  ~Loop();
  Loop(const Loop&) = delete;
  Loop& operator=(const Loop&) = delete;

  // -- any thread -----------------------------------------------------------------------------------------------------

  /// Runs a command between two steps and waits for its result.
  /// command: Result<T>(), called once on the loop's thread; may use the commands below. If the device fails while it
  /// runs, the scene stops and `call` returns kUnavailable.
  template <class Command>
  auto call(Command command) -> decltype(command());
  /// The same for a command that changes nothing: without memory it fails with kResourceExhausted, and the scene goes
  /// on.
  template <class Command>
  auto read(Command command) -> decltype(command());

  /// Makes other values ready for do_take_values, while the scene steps. Only one thread at a time may change values or
  /// swap the world. Fails, with the scene unchanged, if host or device have no memory for them.
  Result<World::Values> prepare_values(std::shared_ptr<const model::Model> next) const;
  /// The present values of the scene. A state of it may be of earlier ones: commands return those of theirs.
  GenerationPointer generation() const { return generation_.get(); }
  const LoopStatus& status() const { return status_; }
  /// Fails with kNotFound, and counts the pose as malformed, if the scene has no such tool.
  Result<void> submit_pose(std::string_view tool, const v1::ToolPose& pose, PoseSource source);
  void count_malformed_pose() { poses_.malformed.fetch_add(1, std::memory_order_relaxed); }
  /// Returns false if the loop should have turned at least `late` ago: a step or a command hangs. A loop that waits for
  /// a command, or for a step that is not due, is well.
  bool turns(Clock::time_point now, Clock::duration late) const {
    return now.time_since_epoch().count() - due_by_.load(std::memory_order_relaxed) < late.count();
  }
  /// Ends the step at hand and a `do_step` in progress, because nobody will see the scene again.
  void cancel() {
    const std::lock_guard lock(cancelling_);
    cancelled_.store(true, std::memory_order_relaxed);
    world_->stop();
  }
  bool cancelled() const { return cancelled_.load(std::memory_order_relaxed); }
  /// Waits until there is work on a scene that runs by the clock since `seen`, a count that this returns, or until
  /// `stop_waiting`: blades have swept something, or the step of `wake_at` is done. The loop itself waits for nobody.
  std::uint32_t wait_for_work(std::uint32_t seen) const {
    work_.wait(seen);
    return work_.load();
  }
  void wake_at(std::uint64_t step) {
    wakes_at_.store(step);
    tell_of_work();  // it may be past
  }
  void stop_waiting() { tell_of_work(); }

  // -- the publisher's thread -----------------------------------------------------------------------------------------

  LoopOutputs& outputs() { return outputs_; }
  bool take_status(v1::SceneStatus& status) { return status_.take(status); }

  // -- commands, for `call` -------------------------------------------------------------------------------------------

  Result<v1::SceneStatus> do_pause();
  Result<v1::SceneStatus> do_resume();
  /// Makes `count` steps of a scene in lockstep or paused; the last one brings a frame and diagnostics.
  Result<v1::SceneStatus> do_step(std::uint32_t count);
  /// edit: the same, for a recording; made by the caller, because without memory nothing may be half done
  Result<v1::SceneStatus> do_reset(EditPointer edit);
  Result<v1::SceneStatus> do_edit(const v1::SceneEdit& change, EditPointer edit);
  Result<v1::Frame> do_frame();
  Result<v1::GetPositionsResponse> do_positions(std::string_view body);
  Result<FieldSource> do_copy_state();
  Result<v1::ToolFeedback> do_feedback(std::string_view tool);
  Result<void> do_set_signal(std::function<void()> signal);

  // Commands of recordings, snapshots and adjustments, in loop_recording.cpp.

  struct StartedRecording {
    std::shared_ptr<Recording> recording;
    std::uint64_t step = 0;
    std::optional<LoopCopy> state;  ///< before the first recorded step; no value: it is the scene's start
    GenerationPointer generation;
  };
  /// Records from the next step on.
  Result<StartedRecording> do_record(const RecordingOptions& options);
  /// Ends a recording, if it is still this one.
  Result<void> do_stop_recording(const std::shared_ptr<Recording>& recording);
  /// Makes recorded steps; see ReplayScene. Their edits are done before, by the caller.
  Result<v1::ReplaySceneResponse> do_replay(std::span<const Replay::Step> steps);
  struct SavedState {
    LoopCopy state;
    GenerationPointer generation;
  };
  /// Copies the state for a reader, which leaves the run as it is.
  Result<World::Copied> do_copy();
  /// Copies the state, for one that will be restored.
  Result<SavedState> do_save();
  struct Kept : SavedState {
    bool paused = false;
    std::chrono::nanoseconds held{};  ///< time for which the loop could not step
  };
  /// As `do_save`, but refuses a loop that was cancelled: its last step may have ended midway.
  Result<Kept> do_keep();
  /// edit: the Restore that brought the state. generation: of the state; fails with kUnavailable if it has passed.
  Result<v1::SceneStatus> do_restore(const LoopCopy& state, EditPointer edit, const GenerationPointer& generation);
  /// A world that takes the place of the present one.
  struct Swap {
    std::unique_ptr<World> world;
    GenerationPointer generation;             ///< that of the world
    EditPointer edit;                         ///< what the change was, for a recording; nullptr: it has none
    std::shared_ptr<SurfaceChanges> surface;  ///< without a revision; nullptr: clients see the same surface
    bool takes_state = true;                  ///< false: it stays at its start
    /// As of places_before (tool_changes.h); no value: the same tools.
    std::optional<std::vector<std::size_t>> places = {};
    /// As of change_of (attachment_changes.h); no value: the same attachments.
    std::optional<AttachmentChange> attachments = {};
    bool same_values = false;  ///< only tools and attachments differ, so that the energy balance goes on
  };
  /// Puts another world of the scene in place of the present one, whose state it takes. On success `swap.world` is the
  /// world before, which may take long to end. On failure the scene is unchanged. Clears a fault of the guard.
  Result<void> do_swap(Swap& swap);
  /// Other values of the scene.
  struct NewValues {
    World::Values values;
    GenerationPointer generation;  ///< that of the values
    EditPointer edit;              ///< for a recording
  };
  /// Gives the world other values between two steps. Clears a fault of the guard. Afterwards `next` has what may take
  /// long to end.
  Result<void> do_take_values(NewValues& next);
  /// Returns whether a tool touches tissue.
  Result<bool> do_touching() const;
  /// Takes what blades have swept since the last call.
  Result<std::vector<SweptWay>> do_take_ways();

 private:
  using State = LoopStatus::State;
  static constexpr std::size_t kNone = std::numeric_limits<std::size_t>::max();
  /// Half of the range: a difference of two times must not overflow.
  static constexpr Clock::rep kNotDue = std::numeric_limits<Clock::rep>::max() / 2;

  void run();
  /// Says until when the loop may be silent; see `turns`.
  void promise_turn(Clock::time_point due_by) {
    due_by_.store(due_by.time_since_epoch().count(), std::memory_order_relaxed);
  }
  bool runs() const;
  bool wait_for_turn();
  void run_commands();
  void enqueue(std::function<void()> command);
  bool frame_due();
  enum class Diagnostics : std::uint8_t { kIfDue, kNow, kNever };
  bool step_once(bool with_frame, Diagnostics diagnostics = Diagnostics::kIfDue);
  bool make_step(bool with_frame, Diagnostics diagnostics);
  void take_poses();
  /// The tool whose poses may start steps; kNone: no tool is in a hand.
  std::size_t leading_tool() const;
  /// Says whether a pose has come that starts the coming step ahead of its schedule (hand_phase.h).
  bool hand_came() const;
  void take_phase(Clock::time_point now);
  bool step_due(Clock::time_point now) const;
  void expire_poses(Clock::time_point now);
  void measure_pose_ages(Clock::time_point now);
  void record_step(StepEnd end);
  void go_on_from_new_state();
  void go_on_with_new_values(GenerationPointer next, EditPointer edit, bool parts_change = false);
  void take_tools(const PoseInboxes& inboxes, std::span<const std::size_t> places);
  void tell_of_tools(const model::Model& before, std::span<const std::size_t> places);
  void tell_of_attachments(const AttachmentChange& change);
  void publish_new_values();
  void take_edits();
  void tell_what_broke();
  void tell_what_was_cut();
  bool lockstep_frame_due(Clock::time_point now, bool last);
  void diagnose();
  void set_state(State next);
  void come_to_rest(bool with_frame);
  void stop_with_fault(std::string reason);
  void stop_for_device(const std::exception& failure);
  Result<void> require_state() const;
  tl::unexpected<Error> unload_error(std::string_view left) const;
  tl::unexpected<Error> changes_error() const;
  /// Ends a recording whose reader is stuck.
  void drop_abandoned_recording();
  tl::unexpected<Error> lockstep_error(std::string_view what) const;
  Clock::duration lockstep_frame_interval() const;

  void tell_of_work() {
    work_.fetch_add(1);
    work_.notify_all();
  }

  const model::Model& model() const { return world_->model(); }

  std::unique_ptr<World> world_;  // the loop's own; replaced with `cancelling_`, which `cancel` takes to read it

  // Shared with other threads.
  PoseCounts poses_;
  Present<Generation> generation_;
  IterationBudget budget_;
  const std::shared_ptr<SceneCounts> counts_ = std::make_shared<SceneCounts>();
  LoopOutputs outputs_;
  SurfaceChangesMaker surface_;
  std::vector<double> told_m3_;   // [body] removed volume at the last event; empty: the scene has no editing
  std::uint32_t told_shape_ = 0;  // Editor::shape_revision at the last event
  LoopStatus status_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::function<void()>> commands_;  // guarded by mutex_
  bool quit_ = false;                           // guarded by mutex_
  std::mutex cancelling_;
  std::atomic<bool> cancelled_{false};
  std::atomic<Clock::rep> due_by_{kNotDue};
  std::atomic<std::uint32_t> work_{0};  // counts what wait_for_work waits for
  std::atomic<std::uint64_t> wakes_at_{std::numeric_limits<std::uint64_t>::max()};
  std::atomic<bool> listens_{false};  // the loop waits for a pose: wake it

  // The loop's own.
  StepClock clock_;
  HandPhase hand_;
  PoseInboxes inboxes_;                    // those of the generation
  std::size_t leading_ = kNone;            // tool whose poses hand_ knows
  std::vector<Clock::time_point> expiry_;  // [tool]: when its newest pose expires by real time; max: it does not
  double frame_phase_ = 0;                 // frames that are due, less than one after each step
  Clock::time_point last_lockstep_frame_{};
  std::uint64_t next_diagnostics_ = 0;  // step
  bool device_failed_ = false;
  std::shared_ptr<Recording> recording_;  // nullptr: nobody records

  std::thread thread_;  // last: uses all of the above
};

template <class Command>
auto Loop::read(Command command) -> decltype(command()) {
  return call([command]() -> decltype(command()) {
    try {
      return command();
    } catch (const std::bad_alloc&) {
      return fail(ErrorCode::kResourceExhausted, "the server has no memory for the answer; the scene goes on");
    }
  });
}

template <class Command>
auto Loop::call(Command command) -> decltype(command()) {
  TM_ASSERT(std::this_thread::get_id() != thread_.get_id(), "the loop must not wait for a command of its own");
  const auto guarded = [this, command]() -> decltype(command()) {
    try {
      return command();
    } catch (const std::exception& failure) {
      stop_for_device(failure);
      return fail(ErrorCode::kUnavailable,
                  fmt::format("scene '{}': the device failed: {}; unload the scene and load it again", model().name,
                              failure.what()));
    }
  };
  auto task = std::make_shared<std::packaged_task<decltype(command())()>>(guarded);
  auto result = task->get_future();
  enqueue([task] { (*task)(); });
  return result.get();
}

}  // namespace tensormass::world
