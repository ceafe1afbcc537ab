#include "world/loop_outputs.h"

#include <algorithm>
#include <span>
#include <utility>

#include "core/assert.h"

namespace tensormass::world {

LoopOutputs::LoopOutputs(World& world, std::shared_ptr<FrameCount> frames_published,
                         std::shared_ptr<SceneCounts> counts)
    : world_(world),
      model_(world.model()),
      tools_(model_.tools.size()),
      frames_(FrameSlot{{},
                        std::vector<float>(world.visible_positions().size()),
                        tools_,
                        std::vector<std::uint8_t>(world.broken_springs().size())}),
      feedback_(FeedbackSlot{{}, tools_}),
      status_feedback_(FeedbackSlot{{}, tools_}),
      frames_published_(std::move(frames_published)),
      counts_(std::move(counts)),
      answered_(tools_.size()) {
  take_step(Clock::now());
  for (std::size_t i = 0; i < tools_.size(); ++i) answered_[i] = tools_[i].newest.arrived;
}

void LoopOutputs::take_step(Clock::time_point began) {
  const std::span<const ToolReading> readings = world_.readings();
  TM_ASSERT(readings.size() == tools_.size(), "a reading for each tool");
  stamp_ = {world_.step_count(), world_.simulated_time_s(), unix_time_ns(), began,
            Clock::now(),        world_.topology_version()};
  std::copy(readings.begin(), readings.end(), tools_.begin());
}

void LoopOutputs::release_tools() {
  for (ToolReading& tool : tools_) {
    tool.force_n.setZero();
    tool.torque_n_m.setZero();
    tool.friction_n.setZero();
    tool.joint_loads = {};
    tool.stiffness_n_per_m.setZero();
    tool.touching = false;
  }
  stamp_.server_time_ns = unix_time_ns();
}

void LoopOutputs::gather_frame() {
  if (has_frames()) world_.gather_visible();
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
    TM_ASSERT(slot.tools.size() == tools_.size(), "a slot has the size of what it takes, so copying allocates nothing");
    slot.stamp = stamp_;
    slot.tools = tools_;
    mailbox->publish();
  }
}

void LoopOutputs::leave_frame() {
  if (!has_frames()) return;
  FrameSlot& slot = frames_.writing();
  const std::span<const float> positions = world_.visible_positions();
  const std::span<const std::uint8_t> broken = world_.broken_springs();
  TM_ASSERT(slot.positions.size() == positions.size() && slot.tools.size() == tools_.size() &&
                slot.broken_springs.size() == broken.size(),
            "a slot has the size of what it takes, so copying allocates nothing");
  slot.stamp = stamp_;
  std::copy(positions.begin(), positions.end(), slot.positions.begin());
  slot.tools = tools_;
  std::copy(broken.begin(), broken.end(), slot.broken_springs.begin());
  if (frames_.publish()) frames_replaced_.fetch_add(1, std::memory_order_relaxed);
}

v1::Frame LoopOutputs::frame() {
  TM_ASSERT(has_frames(), "only a scene with visible nodes has frames");
  world_.gather_visible();
  v1::Frame frame;
  frame.set_sequence(frames_published_->load(std::memory_order_relaxed));
  fill_frame(model_, stamp_, world_.visible_positions(), tools_, world_.broken_springs(), frame);
  return frame;
}

v1::ToolFeedback LoopOutputs::feedback(std::size_t tool) const {
  TM_ASSERT(tool < tools_.size(), "feedback is of a tool of the scene");
  v1::ToolFeedback feedback;
  fill_feedback(model_, stamp_, tool, tools_[tool], feedback);
  return feedback;
}

bool LoopOutputs::take_frame(v1::Frame& frame) {
  const FrameSlot* slot = frames_.take();
  if (slot == nullptr) return false;
  frame.set_sequence(frames_published_->fetch_add(1, std::memory_order_relaxed) + 1);
  fill_frame(model_, slot->stamp, slot->positions, slot->tools, slot->broken_springs, frame);
  return true;
}

bool LoopOutputs::take_feedback(std::vector<v1::ToolFeedback>& feedback) {
  const FeedbackSlot* slot = feedback_.take();
  if (slot == nullptr) return false;
  feedback.resize(slot->tools.size());
  for (std::size_t i = 0; i < slot->tools.size(); ++i) {
    fill_feedback(model_, slot->stamp, i, slot->tools[i], feedback[i]);
    count_answer(i, slot->tools[i].newest.arrived);
  }
  return true;
}

/// Counts the time from a pose to its force, once for each pose. A scene in lockstep steps when somebody asks for it,
/// so the time says nothing there.
void LoopOutputs::count_answer(std::size_t tool, Clock::time_point arrived) {
  if (model_.lockstep || arrived == answered_[tool] || arrived == Clock::time_point{}) return;
  answered_[tool] = arrived;
  counts_->poses_to_force.add(std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - arrived).count());
}

void LoopOutputs::add_to(v1::SceneStatus& status) const {
  status.set_frames_published(frames_published_->load(std::memory_order_relaxed));
  status.set_frames_replaced(frames_replaced_.load(std::memory_order_relaxed));
  const std::lock_guard lock(status_mutex_);
  if (const FeedbackSlot* newer = status_feedback_.take()) newest_status_feedback_ = newer;
  if (newest_status_feedback_ == nullptr) return;
  const FeedbackSlot& slot = *newest_status_feedback_;
  for (std::size_t i = 0; i < slot.tools.size(); ++i) {
    fill_feedback(model_, slot.stamp, i, slot.tools[i], *status.add_tools());
  }
}

}  // namespace tensormass::world
