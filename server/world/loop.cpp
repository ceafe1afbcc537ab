#include "world/loop.h"

#include <sys/prctl.h>

#include <algorithm>
#include <cmath>
#include <utility>

#include "core/names.h"
#include "core/thread_name.h"
#include "world/device_loss.h"
#include "world/scene_edit.h"

namespace tensormass::world {

namespace {
/// Diagnostics of a running scene, a second of simulated time.
constexpr double kDiagnosticsRateHz = 4;
/// Two sums of the same volumes in another order differ by less than this share. No tissue went in between.
constexpr double kSameVolume = 1e-9;

/// Returns when a pose expires by real time.
Clock::time_point expiry_of(const ReceivedPose& pose) {
  if (!std::isfinite(pose.valid_for_s)) return Clock::time_point::max();
  return pose.stamp.arrived +
         std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(pose.valid_for_s));
}
}  // namespace

Loop::Loop(SceneDevice device, std::unique_ptr<World> world, GenerationPointer generation)
    : world_(std::move(world)),
      generation_(std::move(generation)),
      budget_(model()),
      outputs_(*world_, counts_),
      surface_(model()),
      told_m3_(world_->removed().size()),
      status_(world_->shared_model(), std::move(device), budget_, generation_, poses_, outputs_, counts_),
      clock_(model().rate_hz),
      hand_(clock_.period()),
      inboxes_(generation_.get()->inboxes),
      expiry_(model().tools.size(), Clock::time_point::max()) {
  TM_ASSERT(inboxes_.size() == expiry_.size(), "an inbox for each tool");
  // So that other tools need no memory between two steps.
  inboxes_.reserve(limits::kMaxTools);
  expiry_.reserve(limits::kMaxTools);
  status_.take_stamp(outputs_.stamp());
  take_edits();
  outputs_.publish(true);
  thread_ = std::thread([this] { run(); });
}

Loop::~Loop() {
  {
    const std::lock_guard lock(mutex_);
    quit_ = true;
  }
  wake_.notify_one();
  thread_.join();
  if (recording_) recording_->close();
  TM_ASSERT(commands_.empty(), "nobody waits for a loop that ends");
}

Result<void> Loop::submit_pose(std::string_view name, const v1::ToolPose& pose, PoseSource source) {
  const GenerationPointer present = generation();
  const auto tool = find_tool(*present->model, name);
  if (!tool) {
    count_malformed_pose();
    return tl::make_unexpected(tool.error());
  }
  TM_RETURN_IF_ERROR(present->inboxes[*tool]->submit(present->model->tools[*tool], pose, source));
  if (!listens_.load()) return {};
  { const std::lock_guard lock(mutex_); }  // the loop now waits, or has seen the pose
  wake_.notify_one();
  return {};
}

void Loop::enqueue(std::function<void()> command) {
  {
    const std::lock_guard lock(mutex_);
    commands_.push_back(std::move(command));
  }
  wake_.notify_one();
}

// -- the loop's thread ------------------------------------------------------------------------------------------------

void Loop::run() {
  name_thread("loop " + model().name);
  // By default the kernel lets timers fire 50 us late, to save power. docs/decisions/haptics.md has the numbers.
  prctl(PR_SET_TIMERSLACK, 1UL);
  clock_.restart(Clock::now());
  while (wait_for_turn()) {
    run_commands();
    const Clock::time_point begin = Clock::now();
    if (!runs() || !step_due(begin)) continue;
    take_phase(begin);
    if (!step_once(frame_due())) continue;
    const Clock::time_point end = Clock::now();
    status_.take_time(begin, end, clock_.finish(end));
    budget_.take_step(std::chrono::duration<double>(end - begin).count(), world_->last(), world_->guard_event());
    world_->set_cg_limit(budget_.limit());
  }
}

/// Whether the scene steps by the clock.
bool Loop::runs() const { return status_.state() == v1::SceneStatus::STATE_RUNNING; }

/// Waits until the next step is due or a command arrives. Returns false if the loop must end.
bool Loop::wait_for_turn() {
  std::unique_lock lock(mutex_);
  const auto called = [&] { return quit_ || !commands_.empty(); };
  if (runs()) {
    promise_turn(clock_.begin());
    const bool has_hand = leading_tool() != kNone;
    if (!wake_.wait_until(lock, has_hand ? hand_.listen_from(clock_.begin()) : clock_.begin(), called) && has_hand) {
      listens_.store(true);
      wake_.wait_until(lock, clock_.begin(), [&] { return called() || hand_came(); });
      listens_.store(false);
    }
  } else {
    due_by_.store(kNotDue, std::memory_order_relaxed);
    wake_.wait(lock, called);
  }
  promise_turn(Clock::now());
  return !quit_;
}

std::size_t Loop::leading_tool() const {
  const auto in_hand = [](Clock::time_point expiry) { return expiry != Clock::time_point::max(); };
  const auto first = std::find_if(expiry_.begin(), expiry_.end(), in_hand);
  return first == expiry_.end() ? kNone : static_cast<std::size_t>(first - expiry_.begin());
}

bool Loop::hand_came() const {
  const std::size_t tool = leading_tool();
  return tool != kNone && hand_.starts(inboxes_[tool]->newest_arrival(), clock_.begin());
}

/// Tells the status where the coming step, which starts `now`, lies beside the hand.
void Loop::take_phase(Clock::time_point now) {
  if (leading_tool() == kNone) return status_.take_phase({}, {});
  hand_.take_lead(clock_.begin() - now);
  status_.take_phase(hand_.pose_period(), hand_.lead());
}

bool Loop::step_due(Clock::time_point now) const {
  return now >= clock_.begin() || (now >= hand_.listen_from(clock_.begin()) && hand_came());
}

void Loop::run_commands() {
  for (;;) {
    std::function<void()> command;
    {
      const std::lock_guard lock(mutex_);
      if (commands_.empty()) return;
      command = std::move(commands_.front());
      commands_.pop_front();
    }
    command();
  }
}

/// Says whether the coming step brings a frame: frame_rate_hz of them a second, spread evenly, at most one a step.
bool Loop::frame_due() {
  frame_phase_ += model().frame_rate_hz / model().rate_hz;
  if (frame_phase_ < 1 - 1e-9) return false;  // at equal rates every step brings one, whatever rounding says
  frame_phase_ = std::min(frame_phase_ - 1, 1.0);
  return true;
}

/// Gives the newest poses to the world.
void Loop::take_poses() {
  for (std::size_t i = 0; i < inboxes_.size(); ++i) {
    const ReceivedPose* newest = inboxes_[i]->take();
    if (newest == nullptr) continue;
    ReceivedPose received = *newest;
    if (!received.has_joints) received.pose.joint_values = world_->tool_target(i).joint_values;
    world_->set_tool_target(i, received.pose, received.stamp, received.valid_for_s, received.level);
    expiry_[i] = expiry_of(received);
    if (i == leading_tool()) {
      if (std::exchange(leading_, i) != i) hand_ = HandPhase(clock_.period());
      hand_.take(received.stamp);
    }
    if (recording_) recording_->take_pose(i, received);
  }
}

/// Retires tools whose newest pose has expired by real time. A scene that is slower than that would hold a dead
/// client's tool in the tissue for as much longer. The world's own clock is that of the simulation, so a replay needs
/// to know.
void Loop::expire_poses(Clock::time_point now) {
  for (std::size_t i = 0; i < expiry_.size(); ++i) {
    if (now < expiry_[i]) continue;
    expiry_[i] = Clock::time_point::max();
    const ReceivedPose expired{world_->tool_target(i), true, world_->readings()[i].newest, kExpired};
    world_->set_tool_target(i, expired.pose, expired.stamp, expired.valid_for_s);
    if (recording_) recording_->take_pose(i, expired);
  }
}

/// Measures how old the poses are that the coming step uses. Only a client that streams poses says how long they are
/// valid; the pose of a script may be old.
void Loop::measure_pose_ages(Clock::time_point now) {
  for (std::size_t i = 0; i < expiry_.size(); ++i) {
    if (expiry_[i] != Clock::time_point::max()) status_.take_pose_age(now - world_->readings()[i].newest.arrived);
  }
}

/// Makes one step with the newest poses. Returns false if the scene stopped: state() is STATE_FAULTED then.
bool Loop::step_once(bool with_frame, Diagnostics diagnostics) {
  take_poses();
  if (runs()) {
    const Clock::time_point now = Clock::now();
    expire_poses(now);
    measure_pose_ages(now);
  }
  return make_step(with_frame, diagnostics);
}

/// Makes one step and publishes its results. Returns false if the scene stopped: state() is STATE_FAULTED then.
bool Loop::make_step(bool with_frame, Diagnostics diagnostics) {
  const Clock::time_point began = Clock::now();
  promise_turn(began);
  StepEnd end{
      .step = world_->step_count() + 1, .cg_limit = world_->cg_limit(), .evaluates_all = world_->evaluates_all_next()};
  bool good = false;
  try {
    good = world_->step(with_frame && outputs_.has_frames());
    if (!good) outputs_.gather_frame();
    end.rejected = !good;
    end.diagnosed = good && (diagnostics == Diagnostics::kNow ||
                             (diagnostics == Diagnostics::kIfDue && world_->step_count() >= next_diagnostics_));
    if (end.diagnosed) diagnose();
    if (recording_) record_step(end);
  } catch (const backend::StepStopped&) {
    stop_with_fault("the scene is being unloaded");
    return false;
  } catch (const std::exception& failure) {
    stop_for_device(failure);
    return false;
  }
  status_.take_step(*world_);
  outputs_.note_guard();
  take_edits();
  tell_what_broke();
  tell_what_was_cut();
  if (!good) {
    TM_ASSERT(world_->guard_event() != nullptr, "a step that failed left a guard event");
    stop_with_fault(to_text(*world_->guard_event(), world_->model()));
    return false;
  }
  outputs_.take_step(began);
  status_.take_stamp(outputs_.stamp());
  outputs_.publish(with_frame);
  // Last: whoever wakes up asks the status for the step.
  if (runs() && (world_->sweeps().has_news() || world_->step_count() == wakes_at_.load())) tell_of_work();
  return true;
}

void Loop::diagnose() {
  world_->diagnose();
  next_diagnostics_ = world_->step_count() + 1 + static_cast<std::uint64_t>(model().rate_hz / kDiagnosticsRateHz);
  status_.take_diagnostics(*world_);
}

void Loop::set_state(State next) {
  status_.set_state(next);
  clock_.restart(Clock::now());
}

/// Publishes a scene that stops stepping: without forces, and with a frame of its last step, because frames are rarer
/// than steps. with_frame: the frame has been gathered.
void Loop::come_to_rest(bool with_frame) {
  outputs_.release_tools();
  outputs_.publish(with_frame);
}

void Loop::stop_with_fault(std::string reason) {
  status_.set_fault(std::move(reason));
  clock_.restart(Clock::now());
  come_to_rest(!device_failed_);
}

/// Stops this scene after its device failed; other scenes go on. Its state on the device cannot be trusted any more.
void Loop::stop_for_device(const std::exception& failure) {
  device_failed_ = true;
  if (loses_device(failure.what())) status_.take_device_loss();
  status_.take_device_fault();
  std::string reason = "device failed";  // short enough to need no memory
  try {
    reason = fmt::format("the device failed in step {}: {}. Unload the scene and load it again",
                         world_->step_count() + 1, failure.what());
  } catch (const std::bad_alloc&) {
  }
  stop_with_fault(std::move(reason));
}

// -- commands ---------------------------------------------------------------------------------------------------------

/// Refuses requests for a state that the device lost. A scene that the guard stopped still shows its last good state.
Result<void> Loop::require_state() const { return device_failed_ ? status_.require_not_faulted() : Result<void>{}; }

tl::unexpected<Error> Loop::lockstep_error(std::string_view what) const {
  return fail(
      ErrorCode::kFailedPrecondition,
      fmt::format("scene '{}' is in lockstep: it steps only when asked, there is nothing to {}", model().name, what));
}

/// left: what was not done.
tl::unexpected<Error> Loop::unload_error(std::string_view left) const {
  return fail(ErrorCode::kUnavailable, fmt::format("scene '{}' is being unloaded; {}", model().name, left));
}

tl::unexpected<Error> Loop::changes_error() const {
  return fail(
      ErrorCode::kResourceExhausted,
      fmt::format("scene '{}' is recorded and had world::kMaxChangesOfStep = {} edits since its last step; make "
                  "a step first",
                  model().name, kMaxChangesOfStep));
}

Result<v1::SceneStatus> Loop::do_pause() {
  TM_RETURN_IF_ERROR(status_.require_not_faulted());
  if (status_.state() == v1::SceneStatus::STATE_LOCKSTEP) return lockstep_error("pause");
  if (status_.state() == v1::SceneStatus::STATE_PAUSED) return status_.make();
  outputs_.gather_frame();
  set_state(v1::SceneStatus::STATE_PAUSED);
  come_to_rest(true);
  return status_.make();
}

Result<v1::SceneStatus> Loop::do_resume() {
  TM_RETURN_IF_ERROR(status_.require_not_faulted());
  if (status_.state() == v1::SceneStatus::STATE_LOCKSTEP) return lockstep_error("resume");
  set_state(v1::SceneStatus::STATE_RUNNING);
  return status_.make();
}

Result<v1::SceneStatus> Loop::do_step(std::uint32_t count) {
  TM_RETURN_IF_ERROR(status_.require_not_faulted());
  if (status_.state() == v1::SceneStatus::STATE_RUNNING) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("scene '{}' runs by the clock; pause it, or load it with stepping.lockstep, to step it by "
                            "hand",
                            model().name));
  }
  for (std::uint32_t i = 0; i < count; ++i) {
    const auto unloaded = [&] { return unload_error(fmt::format("{} of {} steps were done", i, count)); };
    if (cancelled_.load(std::memory_order_relaxed)) return unloaded();
    const Clock::time_point begin = Clock::now();
    const bool last = i + 1 == count;
    if (!step_once(lockstep_frame_due(begin, last), last ? Diagnostics::kNow : Diagnostics::kIfDue)) {
      if (cancelled_.load(std::memory_order_relaxed)) return unloaded();
      const Result<void> fault = status_.require_not_faulted();
      TM_ASSERT(!fault, "a step that failed stopped the scene");
      return tl::make_unexpected(fault.error());
    }
    const Clock::time_point end = Clock::now();
    status_.take_time(begin, end, true);
  }
  if (status_.state() == v1::SceneStatus::STATE_PAUSED) come_to_rest(true);
  return status_.make();
}

/// Says whether a step of a call brings a frame. The caller asks for the last step's frame next. Frames before it go
/// out at the stream's rate.
bool Loop::lockstep_frame_due(Clock::time_point now, bool last) {
  if (!last && now - last_lockstep_frame_ < lockstep_frame_interval()) return false;
  last_lockstep_frame_ = now;
  return true;
}

Clock::duration Loop::lockstep_frame_interval() const {
  if (!(model().frame_rate_hz > 0)) return Clock::duration::max();
  return std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(1 / model().frame_rate_hz));
}

Result<v1::SceneStatus> Loop::do_reset(EditPointer edit) {
  world_->reset();
  budget_.clear();
  world_->set_cg_limit(budget_.limit());
  next_diagnostics_ = 0;
  outputs_.add_event({.kind = EventKind::kReset, .step = 0});
  if (recording_) recording_->take_edit({std::move(edit), 0});
  go_on_from_new_state();
  return status_.make();
}

Result<v1::SceneStatus> Loop::do_edit(const v1::SceneEdit& change, EditPointer edit) {
  TM_RETURN_IF_ERROR(status_.require_not_faulted());
  if (recording_ && !recording_->takes_change()) return changes_error();
  TM_ASSIGN_OR_RETURN(read, read_scene_edit(model(), change, world_->broken_springs()));
  TM_RETURN_IF_ERROR(world_->edit(read.ablations, read.springs));
  if (recording_) recording_->take_edit({std::move(edit), world_->step_count()});
  take_edits();
  tell_what_broke();
  if (status_.state() != v1::SceneStatus::STATE_RUNNING) {  // else the next step brings a frame
    outputs_.gather_frame();
    outputs_.publish(true);
  }
  return status_.make();
}

/// Tells clients what edits have left, and of a surface that is another one.
void Loop::take_edits() {
  status_.take_edits(*world_);
  if (world_->editor() == nullptr) return;
  SurfaceChangesPointer changes = surface_.take(model(), *world_->editor());
  if (changes == nullptr) return;
  outputs_.set_changes(std::move(changes));
  // Clients get no event of tissue that only pales.
  if (std::exchange(told_shape_, world_->editor()->shape_revision()) == world_->editor()->shape_revision()) return;
  const std::span<const RemovedTissue> removed = world_->removed();
  for (std::size_t i = 0; i < removed.size(); ++i) {
    const RemovedTissue& of_body = removed[i];
    const double more_m3 = of_body.volume_m3 - std::exchange(told_m3_[i], of_body.volume_m3);
    if (!(more_m3 > kSameVolume * of_body.volume_m3)) continue;
    outputs_.add_event({.kind = EventKind::kAblated,
                        .step = world_->step_count(),
                        .body = static_cast<std::uint32_t>(i),
                        .tool = of_body.tool,
                        .value = more_m3,
                        .position_m = of_body.position_m});
  }
}

/// Tells of springs that broke in the last step or edit.
void Loop::tell_what_broke() {
  for (const BrokenSprings& one : world_->newly_broken()) {
    SceneEvent event{.kind = one.severed ? EventKind::kSevered : EventKind::kBroken,
                     .step = world_->step_count(),
                     .tool = one.tool,
                     .attachment = one.attachment,
                     .value = static_cast<double>(one.count)};
    if (one.tool != SceneEvent::kNone) event.position_m = world_->tip_m(one.tool);
    outputs_.add_event(event);
  }
}

/// Tells of tools that began or ended to cut in the last step.
void Loop::tell_what_was_cut() {
  for (const CutCourse& one : world_->sweeps().take_courses()) {
    outputs_.add_event({.kind = one.ended ? EventKind::kCutEnded : EventKind::kCutBegun,
                        .step = world_->step_count(),
                        .body = one.body,
                        .tool = one.tool,
                        .value = one.area_m2,
                        .work_j = one.work_j,
                        .position_m = world_->tip_m(one.tool)});
  }
}

/// Clears what was said about the state before, and publishes the new one.
void Loop::go_on_from_new_state() {
  device_failed_ = false;
  status_.clear();
  if (status_.state() == v1::SceneStatus::STATE_FAULTED) {
    set_state(model().lockstep ? v1::SceneStatus::STATE_LOCKSTEP : v1::SceneStatus::STATE_RUNNING);
  }
  for (const std::shared_ptr<PoseInbox>& inbox : inboxes_) inbox->take();  // drops poses that were sent before
  std::fill(expiry_.begin(), expiry_.end(), Clock::time_point::max());
  outputs_.take_step(Clock::now());
  status_.take_stamp(outputs_.stamp());
  take_edits();
  outputs_.publish(true);
}

Result<v1::Frame> Loop::do_frame() {
  TM_RETURN_IF_ERROR(require_state());
  if (!outputs_.has_frames()) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("scene '{}' has no frames: streams.frame_rate_hz is 0", model().name));
  }
  return outputs_.frame();
}

Result<const model::BodyModel*> find_body(const model::Model& model, std::string_view name) {
  for (const model::BodyModel& body : model.bodies) {
    if (body.name == name) return &body;
  }
  return fail(ErrorCode::kNotFound,
              fmt::format("scene '{}' has no body '{}'; it has: {}", model.name, name,
                          list_names(model.bodies, [](const model::BodyModel& body) { return body.name; })));
}

Result<std::size_t> find_tool(const model::Model& model, std::string_view name) {
  for (std::size_t i = 0; i < model.tools.size(); ++i) {
    if (model.tools[i].name == name) return i;
  }
  return fail(ErrorCode::kNotFound,
              fmt::format("scene '{}' has no tool '{}'; it has: {}", model.name, name,
                          list_names(model.tools, [](const model::ToolModel& tool) { return tool.name; })));
}

Result<v1::ToolFeedback> Loop::do_feedback(std::string_view name) {
  TM_ASSIGN_OR_RETURN(tool, find_tool(model(), name));
  return outputs_.feedback(tool);
}

Result<v1::GetPositionsResponse> Loop::do_positions(std::string_view name) {
  TM_RETURN_IF_ERROR(require_state());
  TM_ASSIGN_OR_RETURN(body, find_body(model(), name));
  const std::vector<double> positions = world_->positions(*body);
  v1::GetPositionsResponse response;
  response.set_step(world_->step_count());
  response.set_positions(positions.data(), positions.size() * sizeof(double));
  return response;
}

Result<Loop::FieldSource> Loop::do_copy_state() {
  TM_RETURN_IF_ERROR(require_state());
  // Edits change the world's model between two steps, so whoever measures needs a copy of it.
  return FieldSource{world_->state(), world_->step_count(), world_->simulated_time_s(), generation(),
                     model().edit_tables ? std::make_shared<const model::Model>(model()) : nullptr};
}

Result<void> Loop::do_set_signal(std::function<void()> signal) {
  outputs_.set_signal(std::move(signal));
  return {};
}

}  // namespace tensormass::world
