#include "world/runner.h"

#include <atomic>
#include <condition_variable>
#include <deque>
#include <future>
#include <map>
#include <mutex>
#include <optional>
#include <thread>

#include <fmt/format.h>

#include "core/limits.h"
#include "world/compiled_scene.h"
#include "world/fields.h"
#include "world/findings.h"
#include "world/iteration_budget.h"
#include "world/messages.h"
#include "world/pose_inbox.h"
#include "world/step_clock.h"

/// The loop of a scene:
///
///   apply commands -> take the newest poses -> step the world -> leave results in mailboxes -> wait for the next step
///
/// Nothing in it waits for a client, a publisher or the control plane, and a step allocates nothing.
namespace tensormass::world {

struct Runner::Impl {
  using State = v1::SceneStatus::State;
  /// How often the elements of a running scene are looked at.
  static constexpr double kWatchRateHz = 4;

  Impl(CompiledScene compiled, std::unique_ptr<World> started)
      : backend(compiled.backend->name()),
        report(std::move(compiled.report)),
        world(std::move(started)),
        model(world->model()),
        topology(make_topology(model, unix_time_ns())),
        inboxes(model.tools.size()),
        snapshots(model.tools.size()),
        frames(FrameSlot{{}, std::vector<float>(3 * std::size_t{model.visible.count()}), snapshots}),
        feedback_out(FeedbackSlot{{}, snapshots}),
        feedback_for_status(FeedbackSlot{{}, snapshots}),
        clock(model.rate_hz),
        state(model.lockstep ? v1::SceneStatus::STATE_LOCKSTEP : v1::SceneStatus::STATE_RUNNING),
        budget(model),
        findings(model, budget) {
    for (std::size_t i = 0; i < model.tools.size(); ++i) {
      tool_index.emplace(model.tools[i].name, i);
      snapshots[i].reading = world->readings()[i];
    }
    stamp.server_time_ns = unix_time_ns();
    leave_feedback();
    leave_frame();
    thread = std::thread([this] { run(); });
  }

  ~Impl() {
    {
      const std::lock_guard lock(mutex);
      quit = true;
    }
    wake.notify_one();
    thread.join();
  }

  // -- the loop's thread ----------------------------------------------------------------------------------------------

  void run() {
    clock.restart(Clock::now());
    for (;;) {
      if (!wait_for_turn()) break;
      apply_commands();
      if (state != v1::SceneStatus::STATE_RUNNING || Clock::now() < clock.begin()) continue;
      const Clock::time_point begin = Clock::now();
      const bool due = frame_due();
      if (!step_once(due)) continue;
      const Clock::time_point end = Clock::now();
      statistics.add(end - begin, end, clock.finish(end));
      budget.take_step(std::chrono::duration<double>(end - begin).count(), world->last(), world->guard_event());
      world->set_cg_limit(budget.limit());
    }
  }

  /// Until the next step is due or a command arrives; false to quit.
  bool wait_for_turn() {
    std::unique_lock lock(mutex);
    const auto called = [&] { return quit || !commands.empty(); };
    if (state == v1::SceneStatus::STATE_RUNNING) {
      wake.wait_until(lock, clock.begin(), called);
    } else {
      wake.wait(lock, called);
    }
    return !quit;
  }

  void apply_commands() {
    for (;;) {
      std::function<void()> command;
      {
        const std::lock_guard lock(mutex);
        if (commands.empty()) return;
        command = std::move(commands.front());
        commands.pop_front();
      }
      command();
    }
  }

  /// Frames a second of real time, at most one a step, evenly spread over the steps.
  bool frame_due() {
    frame_phase += model.frame_rate_hz / model.rate_hz;
    if (frame_phase < 1 - 1e-9) return false;  // 60 Hz of 60 Hz is every step, whatever rounding says
    frame_phase = std::min(frame_phase - 1, 1.0);
    return true;
  }

  /// One step and its results into the mailboxes. False if the guard stopped the scene.
  /// with_watch: look at the elements although it is not time to.
  bool step_once(bool with_frame, bool with_watch = false) {
    for (std::size_t i = 0; i < inboxes.size(); ++i) {
      if (const ReceivedPose* pose = inboxes[i].take()) {
        world->set_tool_target(i, pose->pose);
        snapshots[i].pose_sequence = pose->sequence;
        snapshots[i].client_time_ns = pose->client_time_ns;
        snapshots[i].client_id = pose->client_id;
      }
    }
    bool good = false;
    try {
      good = world->step(with_frame && has_frames());
      if (!good) gather_frame();
      if (good && (with_watch || world->step_count() >= next_watch)) watch();
    } catch (const std::exception& failure) {
      stop_for_device(failure);
      return false;
    }
    findings.take_step(*world);
    if (!good) {
      stop_with_fault(to_text(*world->guard_event()));
      return false;
    }
    stamp = {world->step_count(), world->simulated_time_s(), unix_time_ns()};
    step_count.store(stamp.step, std::memory_order_relaxed);
    simulated_time_s.store(stamp.simulated_time_s, std::memory_order_relaxed);
    for (std::size_t i = 0; i < snapshots.size(); ++i) snapshots[i].reading = world->readings()[i];
    leave_feedback();
    if (with_frame) leave_frame();
    signal_output();
    return true;
  }

  /// Looks at the elements, a few times in a second.
  void watch() {
    world->watch();
    next_watch = world->step_count() + 1 + static_cast<std::uint64_t>(model.rate_hz / kWatchRateHz);
    findings.take_watch(*world);
  }

  void leave_feedback() {
    if (snapshots.empty()) return;
    for (Latest<FeedbackSlot>* mailbox : {&feedback_out, &feedback_for_status}) {
      FeedbackSlot& slot = mailbox->writing();
      slot.stamp = stamp;
      slot.tools = snapshots;  // same size: copies in place
      mailbox->publish();
    }
  }

  bool has_frames() const { return model.visible.count() > 0; }

  /// Before `leave_frame`, where the world did not gather it in its step.
  void gather_frame() {
    if (has_frames()) world->gather_visible();
  }

  void leave_frame() {
    if (!has_frames()) return;
    FrameSlot& slot = frames.writing();
    const std::span<const float> positions = world->visible_positions();
    slot.stamp = stamp;
    std::copy(positions.begin(), positions.end(), slot.positions.begin());
    slot.tools = snapshots;
    if (frames.publish()) frames_replaced.fetch_add(1, std::memory_order_relaxed);
  }

  void signal_output() {
    if (output_signal) output_signal();
  }

  /// A scene that does not step leaves no force on any hand, and where it stands in every picture: frames are fewer
  /// than steps. with_frame: it has been gathered.
  void come_to_rest(bool with_frame) {
    for (ToolSnapshot& snapshot : snapshots) {
      snapshot.reading.force_n.setZero();
      snapshot.reading.torque_n_m.setZero();
      snapshot.reading.stiffness_n_per_m.setZero();
    }
    stamp.server_time_ns = unix_time_ns();
    leave_feedback();
    if (with_frame) leave_frame();
    signal_output();
  }

  void stop_with_fault(std::string reason) {
    {
      const std::lock_guard lock(fault_mutex);
      fault = std::move(reason);
    }
    set_state(v1::SceneStatus::STATE_FAULTED);
    come_to_rest(!device_failed);
  }

  /// The device's failure is of this scene alone. What it holds of the scene cannot be trusted any more.
  void stop_for_device(const std::exception& failure) {
    device_failed = true;
    stop_with_fault(fmt::format("the device failed in step {}: {}. Unload the scene and load it again",
                                world->step_count() + 1, failure.what()));
  }

  void set_state(State next) {
    state = next;
    statistics.interrupt();
    clock.restart(Clock::now());
    status_due.store(true, std::memory_order_relaxed);
  }

  // -- commands, run by the loop --------------------------------------------------------------------------------------

  Result<void> require_not_faulted() {
    if (state != v1::SceneStatus::STATE_FAULTED) return {};
    const std::lock_guard lock(fault_mutex);
    return fail(ErrorCode::kFailedPrecondition, fmt::format("scene '{}' is stopped: {}", model.name, fault));
  }

  /// A scene that a guard stopped still shows its last good state.
  Result<void> require_state() { return device_failed ? require_not_faulted() : Result<void>{}; }

  Result<v1::SceneStatus> do_pause() {
    TM_RETURN_IF_ERROR(require_not_faulted());
    if (state == v1::SceneStatus::STATE_LOCKSTEP) return lockstep_error("pause");
    if (state == v1::SceneStatus::STATE_PAUSED) return make_status();
    gather_frame();
    set_state(v1::SceneStatus::STATE_PAUSED);
    come_to_rest(true);
    return make_status();
  }

  Result<v1::SceneStatus> do_resume() {
    TM_RETURN_IF_ERROR(require_not_faulted());
    if (state == v1::SceneStatus::STATE_LOCKSTEP) return lockstep_error("resume");
    set_state(v1::SceneStatus::STATE_RUNNING);
    return make_status();
  }

  tl::unexpected<Error> lockstep_error(std::string_view what) {
    return fail(
        ErrorCode::kFailedPrecondition,
        fmt::format("scene '{}' is in lockstep: it steps only when asked, there is nothing to {}", model.name, what));
  }

  Result<v1::SceneStatus> do_step(std::uint32_t count) {
    TM_RETURN_IF_ERROR(require_not_faulted());
    if (state != v1::SceneStatus::STATE_LOCKSTEP) {
      return fail(
          ErrorCode::kFailedPrecondition,
          fmt::format("scene '{}' runs by the clock; load it with stepping.lockstep to step it by hand", model.name));
    }
    for (std::uint32_t i = 0; i < count; ++i) {
      if (cancelled.load(std::memory_order_relaxed)) {
        return fail(ErrorCode::kUnavailable,
                    fmt::format("scene '{}' is being unloaded; {} of {} steps were done", model.name, i, count));
      }
      const Clock::time_point begin = Clock::now();
      // The last step's frame is what the caller asks for next; those between go out at the stream's rate.
      const bool frame = i + 1 == count || begin - last_lockstep_frame >= lockstep_frame_interval();
      if (frame) last_lockstep_frame = begin;
      if (!step_once(frame, i + 1 == count)) TM_RETURN_IF_ERROR(require_not_faulted());
      const Clock::time_point end = Clock::now();
      statistics.add(end - begin, end, true);
    }
    return make_status();
  }

  Clock::duration lockstep_frame_interval() const {
    if (!(model.frame_rate_hz > 0)) return Clock::duration::max();
    return std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / model.frame_rate_hz));
  }

  Result<v1::SceneStatus> do_reset() {
    world->reset();
    device_failed = false;
    {
      const std::lock_guard lock(fault_mutex);
      fault.clear();
    }
    if (state == v1::SceneStatus::STATE_FAULTED) {
      set_state(model.lockstep ? v1::SceneStatus::STATE_LOCKSTEP : v1::SceneStatus::STATE_RUNNING);
    }
    stamp = {0, 0, unix_time_ns()};
    step_count = 0;
    simulated_time_s = 0;
    budget.clear();
    world->set_cg_limit(budget.limit());
    findings.clear();
    next_watch = 0;
    for (std::size_t i = 0; i < snapshots.size(); ++i) {
      inboxes[i].take();  // a pose from before the reset is not one for after it
      snapshots[i] = {};
      snapshots[i].reading = world->readings()[i];
    }
    leave_feedback();
    leave_frame();
    signal_output();
    return make_status();
  }

  Result<v1::Frame> do_frame() {
    TM_RETURN_IF_ERROR(require_state());
    if (!has_frames()) {
      return fail(ErrorCode::kFailedPrecondition,
                  fmt::format("scene '{}' has no frames: streams.frame_rate_hz is 0", model.name));
    }
    world->gather_visible();
    v1::Frame frame;
    frame.set_topology_version(topology.version());
    frame.set_sequence(frame_sequence.load(std::memory_order_relaxed));
    fill_frame(model, stamp, world->visible_positions(), snapshots, frame);
    return frame;
  }

  Result<v1::GetPositionsResponse> do_positions(std::string_view name) {
    TM_RETURN_IF_ERROR(require_state());
    TM_ASSIGN_OR_RETURN(body, find_body(name));
    const std::vector<double> positions = world->positions(*body);
    v1::GetPositionsResponse response;
    response.set_step(world->step_count());
    response.set_positions(positions.data(), positions.size() * sizeof(double));
    return response;
  }

  /// What fields are measured from, by whoever asked and not by the loop.
  struct FieldSource {
    backend::RowState state;
    std::uint64_t step;
    double simulated_time_s;
  };
  Result<FieldSource> do_copy_state() {
    TM_RETURN_IF_ERROR(require_state());
    return FieldSource{world->state(), world->step_count(), world->simulated_time_s()};
  }

  Result<const model::BodyModel*> find_body(std::string_view name) const {
    for (const model::BodyModel& body : model.bodies) {
      if (body.name == name) return &body;
    }
    return fail(ErrorCode::kNotFound, fmt::format("scene '{}' has no body '{}'", model.name, name));
  }

  Result<v1::ToolFeedback> do_feedback(std::size_t tool) {
    v1::ToolFeedback feedback;
    fill_feedback(model, stamp, tool, snapshots[tool], feedback);
    return feedback;
  }

  // -- any thread -----------------------------------------------------------------------------------------------------

  /// Runs `command` on the loop between two steps and waits for its result, which is an error if the device fails.
  template <class Command>
  auto on_loop(Command command) -> decltype(command()) {
    const auto guarded = [this, command]() -> decltype(command()) {
      try {
        return command();
      } catch (const std::exception& failure) {
        stop_for_device(failure);
        return fail(ErrorCode::kUnavailable,
                    fmt::format("scene '{}': the device failed: {}; unload the scene and load it again", model.name,
                                failure.what()));
      }
    };
    auto task = std::make_shared<std::packaged_task<decltype(command())()>>(guarded);
    auto result = task->get_future();
    {
      const std::lock_guard lock(mutex);
      commands.emplace_back([task] { (*task)(); });
    }
    wake.notify_one();
    return result.get();
  }

  Result<std::size_t> find_tool(std::string_view tool) const {
    const auto found = tool_index.find(tool);
    if (found == tool_index.end()) {
      return fail(ErrorCode::kNotFound, fmt::format("scene '{}' has no tool '{}'", model.name, tool));
    }
    return found->second;
  }

  v1::SceneStatus make_status() const {
    v1::SceneStatus status;
    status.set_scene(model.name);
    status.set_state(state);
    status.set_step(step_count.load(std::memory_order_relaxed));
    status.set_simulated_time_s(simulated_time_s.load(std::memory_order_relaxed));
    status.set_server_time_ns(unix_time_ns());
    status.set_target_rate_hz(model.lockstep ? 0 : model.rate_hz);
    status.set_reached_rate_hz(statistics.reached_rate_hz());
    status.set_missed_deadlines(statistics.missed_deadlines());
    const StepStatistics::Percentiles times = statistics.percentiles();
    status.set_step_time_p50_s(times.p50_s);
    status.set_step_time_p99_s(times.p99_s);
    status.set_step_time_max_s(times.max_s);
    std::uint64_t received = 0, rejected = malformed_poses.load(std::memory_order_relaxed), superseded = 0;
    for (const PoseInbox& inbox : inboxes) {
      received += inbox.received();
      rejected += inbox.rejected();
      superseded += inbox.superseded();
    }
    status.set_poses_received(received);
    status.set_poses_rejected(rejected);
    status.set_poses_superseded(superseded);
    status.set_frames_published(frame_sequence.load(std::memory_order_relaxed));
    status.set_frames_replaced(frames_replaced.load(std::memory_order_relaxed));
    status.set_backend(backend);
    findings.add_to(status);
    {
      const std::lock_guard lock(fault_mutex);
      status.set_fault(fault);
    }
    const std::lock_guard lock(status_mutex);
    if (const FeedbackSlot* newer = feedback_for_status.take()) newest_feedback = newer;
    if (newest_feedback != nullptr) {
      for (std::size_t i = 0; i < newest_feedback->tools.size(); ++i) {
        fill_feedback(model, newest_feedback->stamp, i, newest_feedback->tools[i], *status.add_tools());
      }
    }
    return status;
  }

  const std::string backend;
  const v1::SceneReport report;
  const std::unique_ptr<World> world;
  const model::Model& model;
  const v1::Topology topology;
  std::map<std::string, std::size_t, std::less<>> tool_index;

  // Between the loop and others.
  std::deque<PoseInbox> inboxes;        // a deque because an inbox does not move
  std::vector<ToolSnapshot> snapshots;  // the loop's own; others get copies
  Latest<FrameSlot> frames;
  Latest<FeedbackSlot> feedback_out;
  mutable Latest<FeedbackSlot> feedback_for_status;  // its reader's side guarded by status_mutex
  mutable const FeedbackSlot* newest_feedback = nullptr;
  mutable std::mutex status_mutex;
  std::function<void()> output_signal;
  std::atomic<bool> status_due{true};
  Clock::time_point next_status{};  // the publisher's

  std::mutex mutex;
  std::condition_variable wake;
  std::deque<std::function<void()>> commands;  // guarded by mutex
  bool quit = false;                           // guarded by mutex

  std::atomic<bool> cancelled{false};

  // The loop's own.
  StepClock clock;
  StepStamp stamp;
  double frame_phase = 0;
  Clock::time_point last_lockstep_frame{};
  std::uint64_t next_watch = 0;  // step
  bool device_failed = false;

  // Written by the loop, read by anyone.
  std::atomic<State> state;
  StepStatistics statistics;
  std::atomic<std::uint64_t> step_count{0}, frame_sequence{0}, frames_replaced{0}, malformed_poses{0};
  std::atomic<double> simulated_time_s{0};
  IterationBudget budget;
  Findings findings;
  mutable std::mutex fault_mutex;
  std::string fault;

  std::thread thread;
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

const std::string& Runner::name() const { return impl_->model.name; }
const v1::SceneReport& Runner::report() const { return impl_->report; }
const v1::Topology& Runner::topology() const { return impl_->topology; }

Result<v1::SceneStatus> Runner::pause() {
  return impl_->on_loop([this] { return impl_->do_pause(); });
}
Result<v1::SceneStatus> Runner::resume() {
  return impl_->on_loop([this] { return impl_->do_resume(); });
}
Result<v1::SceneStatus> Runner::step(std::uint32_t count) {
  if (count == 0 || count > limits::kMaxStepsPerCall) {
    return invalid(
        fmt::format("count: {} is not within [1, limits::kMaxStepsPerCall = {}]", count, limits::kMaxStepsPerCall));
  }
  return impl_->on_loop([this, count] { return impl_->do_step(count); });
}
Result<v1::SceneStatus> Runner::reset() {
  return impl_->on_loop([this] { return impl_->do_reset(); });
}
void Runner::cancel() { impl_->cancelled.store(true, std::memory_order_relaxed); }
v1::SceneStatus Runner::status() const { return impl_->make_status(); }
Result<v1::Frame> Runner::frame() {
  return impl_->on_loop([this] { return impl_->do_frame(); });
}
Result<v1::GetPositionsResponse> Runner::positions(std::string_view body) {
  return impl_->on_loop([this, body] { return impl_->do_positions(body); });
}
Result<v1::GetFieldsResponse> Runner::fields(const v1::GetFieldsRequest& request) {
  TM_ASSIGN_OR_RETURN(body, impl_->find_body(request.body()));
  TM_ASSIGN_OR_RETURN(source, impl_->on_loop([this] { return impl_->do_copy_state(); }));
  TM_ASSIGN_OR_RETURN(response, measure_fields(impl_->model, source.state, *body, request));
  response.set_step(source.step);
  response.set_simulated_time_s(source.simulated_time_s);
  return std::move(response);
}
Result<v1::ToolFeedback> Runner::feedback(std::string_view tool) const {
  TM_ASSIGN_OR_RETURN(index, impl_->find_tool(tool));
  return impl_->on_loop([this, i = index] { return impl_->do_feedback(i); });
}

Result<void> Runner::submit_pose(std::string_view tool, const v1::ToolPose& pose) {
  const auto index = impl_->find_tool(tool);
  if (!index) {
    count_malformed_pose();
    return tl::make_unexpected(index.error());
  }
  return impl_->inboxes[*index].submit(tool, pose);
}
void Runner::count_malformed_pose() { impl_->malformed_poses.fetch_add(1, std::memory_order_relaxed); }

void Runner::set_output_signal(std::function<void()> signal) {
  (void)impl_->on_loop([this, &signal]() -> Result<void> {
    impl_->output_signal = std::move(signal);
    impl_->signal_output();
    return {};
  });
}

bool Runner::take_frame(v1::Frame& frame) {
  const FrameSlot* slot = impl_->frames.take();
  if (slot == nullptr) return false;
  frame.set_topology_version(impl_->topology.version());
  frame.set_sequence(impl_->frame_sequence.fetch_add(1, std::memory_order_relaxed) + 1);
  fill_frame(impl_->model, slot->stamp, slot->positions, slot->tools, frame);
  return true;
}

bool Runner::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  const FeedbackSlot* slot = impl_->feedback_out.take();
  if (slot == nullptr) return false;
  feedback.resize(slot->tools.size());
  for (std::size_t i = 0; i < slot->tools.size(); ++i) {
    fill_feedback(impl_->model, slot->stamp, i, slot->tools[i], feedback[i]);
  }
  return true;
}

bool Runner::take_status(v1::SceneStatus& status) {
  const Clock::time_point now = Clock::now();
  const bool changed = impl_->status_due.exchange(false, std::memory_order_relaxed);
  const double rate_hz = impl_->model.status_rate_hz;
  if (!changed && (rate_hz == 0 || now < impl_->next_status)) return false;
  if (rate_hz > 0) {
    impl_->next_status = now + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / rate_hz));
  }
  status = impl_->make_status();
  return true;
}

}  // namespace tensormass::world
