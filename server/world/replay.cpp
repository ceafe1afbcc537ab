#include "world/replay.h"

#include <algorithm>
#include <string>

#include <fmt/format.h>

#include "core/recording_limits.h"
#include "model/scene_input.h"
#include "world/recording.h"

namespace tensormass::world {

namespace {

Result<Replay::Step> read_step(const model::Model& model, const v1::RecordedStep& message, const std::string& where) {
  Replay::Step out;
  out.index = message.index();
  out.step = message.step();
  out.reset = message.reset();
  out.diagnosed = message.diagnosed();
  out.rejected = message.rejected();
  TM_ASSIGN_OR_RETURN(limit, model::read_number(message.cg_iteration_limit(), 1, model.cg_max_iterations,
                                                where + ".cg_iteration_limit"));
  out.cg_limit = static_cast<std::uint32_t>(limit);
  for (const v1::RecordedPose& pose : message.poses()) {
    const auto tool = std::find_if(model.tools.begin(), model.tools.end(),
                                   [&](const model::ToolModel& one) { return one.name == pose.tool(); });
    if (tool == model.tools.end()) {
      return fail(ErrorCode::kNotFound, fmt::format("{}.poses: the scene has no tool '{}'", where, pose.tool()));
    }
    TM_ASSIGN_OR_RETURN(received, read_pose(pose, *tool, fmt::format("{}.poses ({})", where, pose.tool())));
    out.poses.emplace_back(tool - model.tools.begin(), received);
  }
  return out;
}

}  // namespace

Result<Replay> read_replay(const model::Model& model, std::uint64_t scene_hash, const v1::ReplaySceneRequest& request) {
  if (request.scene_hash() != scene_hash) {
    return fail(
        ErrorCode::kFailedPrecondition,
        fmt::format("the recording is of another scene than the loaded '{}'; load the recorded scene", model.name));
  }
  if (request.steps().empty() || request.steps_size() > limits::kMaxReplayedSteps) {
    return invalid(fmt::format("steps: {} are not within [1, limits::kMaxReplayedSteps = {}]", request.steps_size(),
                               limits::kMaxReplayedSteps));
  }
  Replay out;
  for (int i = 0; i < request.steps_size(); ++i) {
    TM_ASSIGN_OR_RETURN(step, read_step(model, request.steps(i), fmt::format("steps[{}]", i)));
    if (i > 0 && step.index != out.steps.back().index + 1) {
      return invalid(fmt::format("steps[{}].index: {} does not follow {}; steps were lost there", i, step.index,
                                 out.steps.back().index));
    }
    step.checks = std::find(request.check_indices().begin(), request.check_indices().end(), step.index) !=
                  request.check_indices().end();
    out.steps.push_back(std::move(step));
  }
  return out;
}

}  // namespace tensormass::world
