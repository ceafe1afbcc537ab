#include "world/loop_outputs.h"

#include <algorithm>
#include <span>
#include <utility>

#include "core/assert.h"
#include "core/attachment_limits.h"

namespace tensormass::world {

namespace {

/// Returns the largest numbers that a frame of the scene may have. With editing, attachments may come.
FrameSlot largest_frame(World& world, const ToolReadings& tools) {
  const std::size_t springs = world.model().editing ? limits::kMaxAddedSprings : 0;
  return {{},
          std::vector<float>(world.visible_positions().size() + 6 * springs),  // two ends of a spring
          tools,
          std::vector<std::uint8_t>(world.broken_springs().size() + springs / 8)};
}

}  // namespace

LoopOutputs::LoopOutputs(World& world, std::shared_ptr<SceneCounts> counts)
    : world_(&world),
      shown_{world.shared_model(), 0},
      first_topology_version_(world.topology_version()),
      tools_(world.readings()),
      frames_(largest_frame(world, tools_)),
      feedback_(FeedbackSlot{{}, tools_}),
      status_feedback_(FeedbackSlot{{}, tools_}),
      counts_(std::move(counts)) {
  take_step(Clock::now());
  for (std::size_t i = 0; i < tools_.size(); ++i) answered_[i] = tools_[i].newest.arrived;
}

void LoopOutputs::go_on_with(World& world, bool parts_change) noexcept {
  TM_ASSERT(parts_change || (world.readings().size() == tools_.size() &&
                             world.model().visible.count() == world_->model().visible.count() &&
                             world.broken_springs().size() == world_->broken_springs().size()),
            "slots have the sizes of what they take");
  world_ = &world;
  if (parts_change) {
    tools_ = world.readings();
    ++stamp_.part_changes;
  }
  Shown next{world.shared_model(), stamp_.part_changes};
  const std::lock_guard lock(shown_mutex_);
  std::swap(shown_, next);
}

void LoopOutputs::repeat_changes() {
  if (newest_changes_ != nullptr) leave_changes();
}

void LoopOutputs::take_step(Clock::time_point began) {
  const std::span<const ToolReading> readings = world_->readings();
  TM_ASSERT(readings.size() == tools_.size(), "a reading for each tool");
  stamp_ = {.step = world_->step_count(),
            .simulated_time_s = world_->simulated_time_s(),
            .server_time_ns = unix_time_ns(),
            .began = began,
            .ended = Clock::now(),
            .topology_version = world_->topology_version(),
            .part_changes = stamp_.part_changes};
  stamp_changes();
  tools_ = readings;
}

void LoopOutputs::stamp_changes() {
  if (newest_changes_ == nullptr) return;
  stamp_.revision = newest_changes_->revision;
  stamp_.appended_vertex_count = newest_changes_->appended_vertex_count;
}

void LoopOutputs::set_changes(SurfaceChangesPointer changes) {
  TM_ASSERT(changes != nullptr, "changes of a surface");
  TM_ASSERT(newest_changes_ == nullptr || stamp_.topology_version != world_->topology_version() ||
                changes->revision >= newest_changes_->revision,
            "a revision never falls");
  newest_changes_ = std::move(changes);
  stamp_.topology_version = world_->topology_version();
  stamp_changes();
  leave_changes();
}

void LoopOutputs::leave_changes() {
  for (Latest<ChangesSlot>* mailbox : {&changes_, &shown_changes_}) {
    mailbox->writing() = {newest_changes_, world_->topology_version()};
    mailbox->publish();
  }
}

void LoopOutputs::add_event(SceneEvent event) {
  if (event.tool != SceneEvent::kNone) event.tool_name = FixedName(world_->model().tools[event.tool].name);
  if (event.attachment != SceneEvent::kNone) {
    event.attachment_name = FixedName(world_->model().attachments[event.attachment].name);
  }
  log_.add(event, unix_time_ns());
  leave_events();
}

void LoopOutputs::leave_events() {
  events_.writing() = {log_, first_topology_version_};
  events_.publish();
}

void LoopOutputs::note_guard() {
  const GuardEvent* event = world_->guard_event();
  const bool begins = world_->recovering() && !was_recovering_;
  was_recovering_ = world_->recovering();
  if (event == nullptr) return;
  const bool stopped = event->outcome == GuardEvent::Outcome::kStopped;
  if (!begins && !stopped) return;
  add_event({.kind = stopped ? EventKind::kGuard : EventKind::kHeld, .step = world_->step_count(), .guard = *event});
}

void LoopOutputs::release_tools() {
  for (ToolReading& tool : tools_) {
    tool.force_n.setZero();
    tool.torque_n_m.setZero();
    tool.friction_n.setZero();
    tool.joint_loads = {};
    tool.stiffness_n_per_m.setZero();
    tool.yielding = {};
    tool.touching = false;
  }
  stamp_.server_time_ns = unix_time_ns();
}

void LoopOutputs::gather_frame() {
  if (has_frames()) world_->gather_visible();
}

void LoopOutputs::publish(bool with_frame) {
  leave_feedback();
  if (with_frame) leave_frame();
  if (signal_) signal_();
}

void LoopOutputs::set_signal(std::function<void()> signal) {
  signal_ = std::move(signal);
  if (signal_) signal_();
}

void LoopOutputs::leave_feedback() {
  if (tools_.empty()) return;
  for (Latest<FeedbackSlot>* mailbox : {&feedback_, &status_feedback_}) {
    FeedbackSlot& slot = mailbox->writing();
    slot.stamp = stamp_;
    slot.tools = tools_;
    mailbox->publish();
  }
}

void LoopOutputs::leave_frame() {
  if (!has_frames()) return;
  FrameSlot& slot = frames_.writing();
  const std::span<const float> positions = world_->visible_positions();
  const std::span<const std::uint8_t> broken = world_->broken_springs();
  TM_ASSERT(slot.positions.capacity() >= positions.size() && slot.broken_springs.capacity() >= broken.size(),
            "a slot has room for what it takes, so copying allocates nothing");
  slot.stamp = stamp_;
  slot.positions.assign(positions.begin(), positions.end());
  slot.tools = tools_;
  slot.broken_springs.assign(broken.begin(), broken.end());
  if (frames_.publish()) frames_replaced_.fetch_add(1, std::memory_order_relaxed);
}

v1::Frame LoopOutputs::frame() {
  TM_ASSERT(has_frames(), "only a scene with visible nodes has frames");
  world_->gather_visible();
  v1::Frame frame;
  frame.set_sequence(frames_published_.load(std::memory_order_relaxed));
  fill_frame(world_->model(), stamp_, world_->visible_positions(), tools_.all(), world_->broken_springs(), frame);
  return frame;
}

v1::ToolFeedback LoopOutputs::feedback(std::size_t tool) const {
  TM_ASSERT(tool < tools_.size(), "feedback is of a tool of the scene");
  v1::ToolFeedback feedback;
  fill_feedback(world_->model(), stamp_, tool, tools_[tool], feedback);
  return feedback;
}

bool LoopOutputs::take_frame(v1::Frame& frame) {
  const FrameSlot* slot = frames_.take();
  if (slot == nullptr) return false;
  const Shown now = shown();
  if (slot->stamp.part_changes != now.part_changes) return false;
  frame.set_sequence(frames_published_.fetch_add(1, std::memory_order_relaxed) + 1);
  fill_frame(*now.model, slot->stamp, slot->positions, slot->tools.all(), slot->broken_springs, frame);
  return true;
}

bool LoopOutputs::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  const FeedbackSlot* slot = feedback_.take();
  if (slot == nullptr) return false;
  const Shown now = shown();
  if (slot->stamp.part_changes != now.part_changes) return false;
  const bool counts = std::exchange(answered_changes_, now.part_changes) == now.part_changes;
  feedback.resize(slot->tools.size());
  for (std::size_t i = 0; i < slot->tools.size(); ++i) {
    fill_feedback(*now.model, slot->stamp, i, slot->tools[i], feedback[i]);
    if (!counts) answered_[i] = slot->tools[i].newest.arrived;  // so far that of another tool
    if (!now.model->lockstep) count_answer(i, slot->tools[i].newest.arrived);
  }
  return true;
}

bool LoopOutputs::take_changes(v1::SurfaceChanges& changes) {
  const ChangesSlot* slot = changes_.take();
  if (slot == nullptr) return false;
  fill_changes(*slot, changes);
  return true;
}

bool LoopOutputs::take_events(v1::SceneEvents& events) {
  const EventsSlot* slot = events_.take();
  if (slot == nullptr) return false;
  fill_events(*shown().model, *slot, events);
  return true;
}

bool LoopOutputs::changes(v1::SurfaceChanges& changes) const {
  const std::lock_guard lock(changes_mutex_);
  if (const ChangesSlot* newer = shown_changes_.take()) newest_shown_changes_ = newer;
  if (newest_shown_changes_ == nullptr) return false;
  fill_changes(*newest_shown_changes_, changes);
  return true;
}

/// Counts the time from a pose to its force, once for each pose. A scene in lockstep steps when somebody asks for it,
/// so the time says nothing there.
void LoopOutputs::count_answer(std::size_t tool, Clock::time_point arrived) {
  if (arrived == answered_[tool] || arrived == Clock::time_point{}) return;
  answered_[tool] = arrived;
  counts_->poses_to_force.add(std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - arrived).count());
}

void LoopOutputs::add_to(v1::SceneStatus& status) const {
  status.set_frames_published(frames_published_.load(std::memory_order_relaxed));
  status.set_frames_replaced(frames_replaced_.load(std::memory_order_relaxed));
  const std::lock_guard lock(status_mutex_);
  if (const FeedbackSlot* newer = status_feedback_.take()) newest_status_feedback_ = newer;
  if (newest_status_feedback_ == nullptr) return;
  const FeedbackSlot& slot = *newest_status_feedback_;
  const Shown now = shown();
  if (slot.stamp.part_changes != now.part_changes) return;  // those of the present tools are on their way
  for (std::size_t i = 0; i < slot.tools.size(); ++i) {
    fill_feedback(*now.model, slot.stamp, i, slot.tools[i], *status.add_tools());
  }
}

}  // namespace tensormass::world
