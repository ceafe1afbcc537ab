#include "world/recording.h"

#include <algorithm>
#include <cmath>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/limits.h"
#include "model/scene_input.h"
#include "world/hashes.h"

namespace tensormass::world {

RecordedTools::RecordedTools(const model::Model& model) {
  for (const model::ToolModel& tool : model.tools) {
    names.push_back(tool.name);
    joints.push_back(tool.joints.size());
  }
}

Recording::Recording(const model::Model& model, const RecordingOptions& options)
    : check_every_(options.check_every_steps),
      lease_(options.lease),
      tools_(std::make_shared<const RecordedTools>(model)),
      steps_(options.room_for_steps),
      // A step has at most one pose a tool. Where tools are added, poses may run out of room before steps do.
      poses_(std::max<std::size_t>(1, model.tools.size()) * options.room_for_steps),
      checks_(options.room_for_checks),
      edits_(options.room_for_edits) {
  coming_edits_.reserve(kMaxEditsOfStep + 1);  // so that taking one cannot fail
}

void Recording::go_on_with(std::shared_ptr<const RecordedTools> tools) noexcept {
  tools_ = std::move(tools);
  has_coming_.fill(false);
}

void Recording::take_pose(std::size_t tool, const ReceivedPose& received) {
  TM_ASSERT(tool < tools_->names.size(), "a pose is for a tool of the scene");
  coming_[tool] = received;
  has_coming_[tool] = true;
}

void Recording::take_edit(DoneEdit done) {
  const bool keeps_state =
      std::holds_alternative<Adjust>(*done.edit) || std::holds_alternative<ChangeScene>(*done.edit);
  if (!keeps_state) has_coming_.fill(false);
  add_edit(coming_edits_, std::move(done));
}

/// Whether the rings take the coming step with its edits.
bool Recording::has_room_for_step(std::size_t poses) const {
  if (steps_.room() == 0 || poses_.room() < poses || edits_.room() < coming_edits_.size()) return false;
  std::size_t coming = 0;
  for (const DoneEdit& done : coming_edits_) coming += bytes_of(*done.edit);
  const std::size_t waiting = edit_bytes_.load(std::memory_order_relaxed);
  return coming == 0 || waiting == 0 || waiting + coming <= limits::kMaxRecordedEditBytes;
}

void Recording::end_step(const StepEnd& end) {
  const std::uint64_t index = index_.load(std::memory_order_relaxed) + 1;
  const auto poses = static_cast<std::size_t>(std::count(has_coming_.begin(), has_coming_.end(), true));
  if (has_room_for_step(poses)) {
    const auto edits = static_cast<std::uint32_t>(coming_edits_.size());
    for (DoneEdit& done : coming_edits_) {
      edit_bytes_.fetch_add(bytes_of(*done.edit), std::memory_order_relaxed);
      edits_.back() = std::move(done);
      edits_.push();
    }
    for (std::size_t tool = 0; tool < tools_->names.size(); ++tool) {
      if (!has_coming_[tool]) continue;
      poses_.back() = {tool, coming_[tool], tools_};
      poses_.push();
    }
    steps_.back() = {end, index, static_cast<std::uint32_t>(poses), edits};
    steps_.push();
  }
  has_coming_.fill(false);
  coming_edits_.clear();
  index_.store(index, std::memory_order_release);
}

void Recording::take_check(std::uint64_t step, backend::RowState state, std::shared_ptr<const model::Model> model) {
  if (checks_.room() == 0) {
    lost_checks_.fetch_add(1, std::memory_order_relaxed);
    return;
  }
  checks_.back() = {index_.load(std::memory_order_relaxed), step, std::move(state), std::move(model)};
  checks_.push();
}

bool Recording::abandoned() const {
  return std::chrono::steady_clock::now() - taken_.load(std::memory_order_relaxed) > lease_;
}

void Recording::evict() {
  evicted_.store(true, std::memory_order_relaxed);
  close();
  const std::lock_guard lock(freeing_);
  if (free_) free_();
}

void Recording::on_evicted(std::function<void()> free) {
  const std::lock_guard lock(freeing_);
  free_ = std::move(free);
}

/// Adds a gap if steps before `next` did not come.
void Recording::add_lost(std::uint64_t next, v1::RecordSceneResponse& response) {
  TM_ASSERT(next > read_index_, "indices ascend");
  const std::uint64_t count = next - read_index_ - 1;
  if (count == 0) return;
  v1::LostSteps& lost = *response.add_lost();
  lost.set_first_index(read_index_ + 1);
  lost.set_count(count);
}

/// Moves the edits of a step into the message and returns their bytes.
std::size_t Recording::add_edits(const Step& step, v1::RecordedStep& out, v1::RecordSceneResponse& response) {
  std::size_t bytes = 0;
  out.set_edits(step.edits);
  for (std::uint32_t i = 0; i < step.edits; ++i) {
    DoneEdit* done = edits_.front();
    TM_ASSERT(done != nullptr, "edits are pushed before their step");
    write_edit(step.index, *done, *response.add_edits());
    if (std::holds_alternative<Reset>(*done->edit)) out.set_reset(true);
    bytes += bytes_of(*done->edit);
    done->edit.reset();  // frees the snapshot here, not when the loop comes round to the slot
    edits_.pop();
  }
  edit_bytes_.fetch_sub(bytes, std::memory_order_relaxed);
  return bytes;
}

bool Recording::take(v1::RecordSceneResponse& response) {
  response.Clear();
  std::size_t edit_bytes = 0;
  taken_.store(std::chrono::steady_clock::now(), std::memory_order_relaxed);
  // Before the rings: what the loop did before it closed is in them then.
  const bool ended = closed();
  while (const Step* step = steps_.front()) {
    if (response.steps_size() == kMaxSteps || edit_bytes >= kMaxEditBytes) break;
    add_lost(step->index, response);
    read_index_ = step->index;
    v1::RecordedStep& out = *response.add_steps();
    out.set_index(step->index);
    out.set_step(step->end.step);
    out.set_cg_iteration_limit(step->end.cg_limit);
    out.set_diagnosed(step->end.diagnosed);
    out.set_rejected(step->end.rejected);
    out.set_recovered(step->end.recovered);
    out.set_evaluates_all(step->end.evaluates_all);
    out.set_server_time_ns(step->end.server_time_ns);
    for (std::uint32_t i = 0; i < step->poses; ++i) {
      const TakenPose* pose = poses_.front();
      TM_ASSERT(pose != nullptr, "poses are pushed before their step");
      write_pose(pose->tools->names[pose->tool], pose->received, pose->tools->joints[pose->tool], *out.add_poses());
      poses_.pop();
    }
    edit_bytes += add_edits(*step, out, response);
    steps_.pop();
  }
  if (ended && steps_.front() == nullptr) {
    const std::uint64_t last = index_.load(std::memory_order_acquire);
    add_lost(last + 1, response);
    read_index_ = last;
  }
  if (const Check* check = checks_.front()) {
    *response.add_checks() = make_check(check->index, check->step, check->state, check->model->layout.row_of_node);
    checks_.pop();
  }
  response.set_lost_checks(lost_checks_.load(std::memory_order_relaxed));
  return response.steps_size() > 0 || response.checks_size() > 0 || response.lost_size() > 0;
}

v1::StateCheck make_check(std::uint64_t index, std::uint64_t step, const backend::RowState& state,
                          std::span<const std::uint32_t> row_of_node) {
  v1::StateCheck check;
  check.set_index(index);
  check.set_step(step);
  check.set_hash(hash_of(state, row_of_node));
  const auto displacement = [&](std::uint32_t row) { return state.displacement.data() + 4 * std::size_t{row}; };
  double largest_squared = 0;
  for (const std::uint32_t row : row_of_node) {
    const double* u = displacement(row);
    largest_squared = std::max(largest_squared, u[0] * u[0] + u[1] * u[1] + u[2] * u[2]);
  }
  check.set_largest_displacement_m(std::sqrt(largest_squared));
  const std::size_t count = std::min(row_of_node.size(), limits::kSampledNodes);
  std::vector<double> samples;
  for (std::size_t i = 0; i < count; ++i) {
    const double* u = displacement(row_of_node[i * row_of_node.size() / count]);
    samples.insert(samples.end(), u, u + 3);
  }
  check.set_sample_displacements(samples.data(), samples.size() * sizeof(double));
  return check;
}

void write_pose(const std::string& tool, const ReceivedPose& received, std::size_t joints, v1::RecordedPose& out) {
  const Pose& pose = received.pose;
  out.set_tool(tool);
  out.mutable_position_m()->set_x(pose.position_m[0]);
  out.mutable_position_m()->set_y(pose.position_m[1]);
  out.mutable_position_m()->set_z(pose.position_m[2]);
  out.mutable_orientation()->set_w(pose.orientation[0]);
  out.mutable_orientation()->set_x(pose.orientation[1]);
  out.mutable_orientation()->set_y(pose.orientation[2]);
  out.mutable_orientation()->set_z(pose.orientation[3]);
  for (std::size_t i = 0; i < joints; ++i) out.add_joint_values(pose.joint_values[i]);
  if (received.valid_for_s == kExpired) {
    out.set_expired(true);
  } else if (std::isfinite(received.valid_for_s)) {
    out.set_valid_for_s(received.valid_for_s);
  }
  out.set_level(received.level);
  out.set_sequence(received.stamp.sequence);
  out.set_client_time_ns(received.stamp.client_time_ns);
  out.set_client_id(received.stamp.client_id);
}

Result<ReceivedPose> read_pose(const v1::RecordedPose& message, const model::ToolModel& tool, std::string_view where) {
  TM_ASSIGN_OR_RETURN(position, model::read_vector(message.position_m(), fmt::format("{}.position_m", where)));
  // Checked, but not normalized again: that could change the last bit.
  TM_RETURN_IF_ERROR(model::read_orientation(message.orientation(), fmt::format("{}.orientation", where)));
  const v1::Quaternion& q = message.orientation();
  if (q.w() == 0 && q.x() == 0 && q.y() == 0 && q.z() == 0) {
    return invalid(fmt::format("{}.orientation: all zero; a recorded pose has a unit quaternion", where));
  }
  TM_ASSIGN_OR_RETURN(joints,
                      model::read_joints(message.joint_values(), tool.joints, fmt::format("{}.joint_values", where)));
  ReceivedPose out;
  out.pose = {position, {q.w(), q.x(), q.y(), q.z()}, joints};
  out.stamp = {
      .sequence = message.sequence(), .client_time_ns = message.client_time_ns(), .client_id = message.client_id()};
  if (message.expired()) {
    if (message.has_valid_for_s()) {
      return invalid(fmt::format("{}: has expired and valid_for_s; a pose that expired has none", where));
    }
    out.valid_for_s = kExpired;
  } else if (message.has_valid_for_s()) {
    TM_ASSIGN_OR_RETURN(valid_for_s,
                        model::read_number(message.valid_for_s(), limits::kMinPoseValidForS, limits::kMaxPoseValidForS,
                                           fmt::format("{}.valid_for_s", where)));
    out.valid_for_s = valid_for_s;
  }
  TM_ASSIGN_OR_RETURN(level, model::read_level(message.level(), tool, fmt::format("{}.level", where)));
  out.level = level;
  return out;
}

}  // namespace tensormass::world
