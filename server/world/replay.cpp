#include "world/replay.h"

#include <algorithm>
#include <string>

#include <fmt/format.h>

#include "core/recording_limits.h"
#include "model/scene_input.h"
#include "world/recording.h"

namespace tensormass::world {

namespace {

Result<void> read_poses_of(const model::Model& model, const v1::RecordedStep& message, const std::string& where,
                           Replay::Step& out) {
  for (const v1::RecordedPose& pose : message.poses()) {
    const auto tool = std::find_if(model.tools.begin(), model.tools.end(),
                                   [&](const model::ToolModel& one) { return one.name == pose.tool(); });
    if (tool == model.tools.end()) {
      return fail(ErrorCode::kNotFound, fmt::format("{}.poses: the scene has no tool '{}'", where, pose.tool()));
    }
    TM_ASSIGN_OR_RETURN(received, read_pose(pose, *tool, fmt::format("{}.poses ({})", where, pose.tool())));
    out.poses.emplace_back(tool - model.tools.begin(), received);
  }
  return {};
}

bool changes_tools(const EditPointer& edit) {
  const auto* adjust = std::get_if<Adjust>(edit.get());
  return adjust != nullptr && adjust->values.has_tools();
}

Result<Replay::Step> read_step(const model::Model& model, const v1::RecordedStep& message, const std::string& where) {
  Replay::Step out;
  out.index = message.index();
  out.step = message.step();
  out.diagnosed = message.diagnosed();
  out.rejected = message.rejected();
  out.evaluates_all = message.evaluates_all();
  TM_ASSIGN_OR_RETURN(limit, model::read_number(message.cg_iteration_limit(), 1, model.cg_max_iterations,
                                                where + ".cg_iteration_limit"));
  out.cg_limit = static_cast<std::uint32_t>(limit);
  return out;
}

/// Reads the edits before a step. next: the first edit of the request that no step has had; advanced.
Result<std::vector<EditPointer>> read_edits(const v1::RecordedStep& step, const v1::ReplaySceneRequest& request,
                                            int& next, const std::string& where) {
  std::vector<EditPointer> out;
  for (; next < request.edits_size() && request.edits(next).index() == step.index(); ++next) {
    if (out.size() == kMaxEditsOfStep) {
      return invalid(
          fmt::format("edits[{}]: more than kMaxEditsOfStep = {} before a step; a recording has only those "
                      "on which something depends",
                      next, kMaxEditsOfStep));
    }
    TM_ASSIGN_OR_RETURN(edit, read_edit(request.edits(next), fmt::format("edits[{}]", next)));
    out.push_back(std::move(edit));
  }
  if (out.size() != step.edits()) {
    return invalid(
        fmt::format("{}.edits: {} edits came before this step when it was recorded, but the request has {} "
                    "of them; replay with tools of this version or newer",
                    where, step.edits(), out.size()));
  }
  // Recordings did not always have edits.
  if (out.empty() && step.reset()) out.push_back(std::make_shared<const Edit>(Reset{}));
  return out;
}

}  // namespace

Result<Replay> read_replay(const model::Model& model, std::uint64_t scene_hash, const v1::ReplaySceneRequest& request) {
  if (request.scene_hash() != scene_hash) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("the recording is of another scene than the loaded '{}', or of other values; load the "
                            "recorded scene, and adjust it to RecordingStart.adjustments",
                            model.name));
  }
  if (!model.lockstep) {
    return fail(
        ErrorCode::kFailedPrecondition,
        fmt::format("scene '{}' runs by the clock; load it with stepping.lockstep to replay steps", model.name));
  }
  if (request.steps().empty() || request.steps_size() > limits::kMaxReplayedSteps) {
    return invalid(fmt::format("steps: {} are not within [1, limits::kMaxReplayedSteps = {}]", request.steps_size(),
                               limits::kMaxReplayedSteps));
  }
  Replay out;
  int next_edit = 0;
  bool waits = false;
  for (int i = 0; i < request.steps_size(); ++i) {
    TM_ASSIGN_OR_RETURN(step, read_step(model, request.steps(i), fmt::format("steps[{}]", i)));
    if (i > 0 && step.index != out.steps.back().index + 1) {
      return invalid(fmt::format("steps[{}].index: {} does not follow {}; steps were lost there", i, step.index,
                                 out.steps.back().index));
    }
    step.checks = std::find(request.check_indices().begin(), request.check_indices().end(), step.index) !=
                  request.check_indices().end();
    TM_ASSIGN_OR_RETURN(edits, read_edits(request.steps(i), request, next_edit, fmt::format("steps[{}]", i)));
    waits = waits || std::any_of(edits.begin(), edits.end(), changes_tools);
    step.edits = std::move(edits);
    step.waits_for_tools = waits;
    if (!waits) TM_RETURN_IF_ERROR(read_poses_of(model, request.steps(i), fmt::format("steps[{}]", i), step));
    out.steps.push_back(std::move(step));
  }
  if (next_edit != request.edits_size()) {
    return invalid(fmt::format("edits[{}].index: {} is that of no step after the edits before it", next_edit,
                               request.edits(next_edit).index()));
  }
  return out;
}

Result<void> read_poses(const model::Model& model, const v1::ReplaySceneRequest& request, std::size_t first,
                        std::span<Replay::Step> steps) {
  for (std::size_t i = 0; i < steps.size(); ++i) {
    if (!steps[i].waits_for_tools) continue;
    const int place = static_cast<int>(first + i);
    TM_RETURN_IF_ERROR(read_poses_of(model, request.steps(place), fmt::format("steps[{}]", place), steps[i]));
  }
  return {};
}

}  // namespace tensormass::world
