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
#include "world/hand_phase.h"
#include "world/iteration_budget.h"
#include "world/loop_outputs.h"
#include "world/loop_status.h"
#include "world/pose_inbox.h"
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

class Loop {
 public:
  /// The state that fields are measured from, by the thread that asked and not by the loop.
  struct FieldSource {
    backend::RowState state;
    std::uint64_t step;
    double simulated_time_s;
    std::shared_ptr<const model::Model> model;  ///< as it is now, in a scene with editing; else nullptr
  };

  /// How a loop begins, if it goes on where another one ended.
  struct Start {
    bool paused = false;
    /// The loop before it, which has handed over and steps no more.
    std::shared_ptr<const Loop> before = nullptr;
    std::shared_ptr<Recording> recording = nullptr;
    EditPointer edit = nullptr;                      ///< what the change was, for the recording
    std::shared_ptr<PoseInboxes> inboxes = nullptr;  ///< nullptr: new ones
    std::function<void()> signal = nullptr;          ///< as of do_set_signal
    std::shared_ptr<FrameCount> frames_published = std::make_shared<FrameCount>(0);
    std::shared_ptr<StepStatistics> statistics = std::make_shared<StepStatistics>();
    std::shared_ptr<SceneCounts> counts = std::make_shared<SceneCounts>();
  };

  /// Starts the thread. backend: its name, for the status.
  Loop(std::string backend, std::unique_ptr<World> world, const Start& start);
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

  const model::Model& model() const { return model_; }
  const LoopStatus& status() const { return status_; }
  Result<const model::BodyModel*> find_body(std::string_view name) const;
  Result<void> submit_pose(std::size_t tool, const v1::ToolPose& pose, PoseSource source);
  void count_malformed_pose() { inboxes_->malformed.fetch_add(1, std::memory_order_relaxed); }
  /// Returns false if the loop should have turned at least `late` ago: a step or a command hangs. A loop that waits for
  /// a command, or for a step that is not due, is well.
  bool turns(Clock::time_point now, Clock::duration late) const {
    return now.time_since_epoch().count() - due_by_.load(std::memory_order_relaxed) < late.count();
  }
  const PoseInbox& inbox(std::size_t tool) const { return inboxes_->tools[tool]; }
  /// Ends the step at hand and a `do_step` in progress, because nobody will see the scene again.
  void cancel() {
    cancelled_.store(true, std::memory_order_relaxed);
    world_->stop();
  }

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
  Result<v1::ToolFeedback> do_feedback(std::size_t tool) { return outputs_.feedback(tool); }
  Result<void> do_set_signal(std::function<void()> signal);

  // Commands of recordings, snapshots and adjustments, in loop_recording.cpp.

  struct StartedRecording {
    std::shared_ptr<Recording> recording;
    std::uint64_t step = 0;
    std::optional<LoopState> state;  ///< before the first recorded step; no value: it is the scene's start
  };
  /// Records from the next step on.
  Result<StartedRecording> do_record(const RecordingOptions& options);
  /// Ends a recording, if it is still this one.
  Result<void> do_stop_recording(const std::shared_ptr<Recording>& recording);
  /// Makes recorded steps; see ReplayScene. Their edits are done before, by the caller.
  Result<v1::ReplaySceneResponse> do_replay(std::span<const Replay::Step> steps);
  Result<LoopState> do_save();
  struct Kept {
    LoopState state;
    bool paused = false;
    std::chrono::nanoseconds held{};  ///< time for which the loop could not step
  };
  /// As `do_save`, but refuses a loop that was cancelled: its last step may have ended midway.
  Result<Kept> do_keep();
  /// edit: the Restore that brought the state.
  Result<v1::SceneStatus> do_restore(const LoopState& state, EditPointer edit);

  struct HandedOver {
    LoopState state;
    Start start;
  };
  /// Stops stepping and returns the state, from which another loop goes on. The recording leaves this one.
  Result<HandedOver> do_hand_over();
  /// Steps again, because the other loop could not be made. recording: as it was handed over.
  Result<void> do_go_on(std::shared_ptr<Recording> recording);

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
  bool step_due(Clock::time_point now) const;
  void expire_poses(Clock::time_point now);
  void measure_pose_ages(Clock::time_point now);
  void record_step(std::uint64_t step, std::uint32_t cg_limit, bool diagnosed, bool rejected);
  void go_on_from_new_state();
  bool lockstep_frame_due(Clock::time_point now, bool last);
  void diagnose();
  void set_state(State next);
  void come_to_rest(bool with_frame);
  void stop_with_fault(std::string reason);
  void stop_for_device(const std::exception& failure);
  Result<void> require_state() const;
  tl::unexpected<Error> unload_error(std::string_view left) const;
  /// Ends a recording whose reader is stuck.
  void drop_abandoned_recording();
  tl::unexpected<Error> lockstep_error(std::string_view what) const;
  Clock::duration lockstep_frame_interval() const;

  const std::unique_ptr<World> world_;
  const model::Model& model_;

  // Shared with other threads.
  const std::shared_ptr<PoseInboxes> inboxes_;
  IterationBudget budget_;
  LoopOutputs outputs_;
  LoopStatus status_;
  std::mutex mutex_;
  std::condition_variable wake_;
  std::deque<std::function<void()>> commands_;  // guarded by mutex_
  bool quit_ = false;                           // guarded by mutex_
  std::atomic<bool> cancelled_{false};
  std::atomic<Clock::rep> due_by_{kNotDue};
  std::atomic<bool> listens_{false};  // the loop waits for a pose: wake it

  // The loop's own.
  StepClock clock_;
  HandPhase hand_;
  std::size_t leading_ = kNone;            // tool whose poses hand_ knows
  std::vector<Clock::time_point> expiry_;  // [tool]: when its newest pose expires by real time; max: it does not
  double frame_phase_ = 0;                 // frames that are due, less than one after each step
  Clock::time_point last_lockstep_frame_{};
  std::uint64_t next_diagnostics_ = 0;  // step
  bool device_failed_ = false;
  bool handed_over_ = false;              // another loop steps this scene
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
                  fmt::format("scene '{}': the device failed: {}; unload the scene and load it again", model_.name,
                              failure.what()));
    }
  };
  auto task = std::make_shared<std::packaged_task<decltype(command())()>>(guarded);
  auto result = task->get_future();
  enqueue([task] { (*task)(); });
  return result.get();
}

}  // namespace tensormass::world
