#include "world/pose_inbox.h"

#include <algorithm>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/limits.h"
#include "model/scene_input.h"

namespace tensormass::world {

namespace {

Result<double> read_validity(const v1::ToolPose& message, std::string_view where) {
  if (!message.has_valid_for_s()) return kUntilTheNext;
  return model::read_number(message.valid_for_s(), limits::kMinPoseValidForS, limits::kMaxPoseValidForS,
                            fmt::format("{}.valid_for_s", where));
}

}  // namespace

bool PoseInbox::is_newer(const v1::ToolPose& message) {
  if (message.client_id() == 0 && message.sequence() == 0) return true;
  const auto known = std::find_if(clients_.begin(), clients_.end(), [&](const Client& client) {
    return client.id == message.client_id() && client.last_sequence > 0;
  });
  if (known != clients_.end()) {
    if (message.sequence() <= known->last_sequence) return false;
    known->last_sequence = message.sequence();
    return true;
  }
  if (message.sequence() == 0) return false;
  clients_[next_client_++ % kClients] = {message.client_id(), message.sequence()};
  return true;
}

Result<void> PoseInbox::submit(const model::ToolModel& tool, const v1::ToolPose& message) {
  const auto refuse = [&](Error error) {
    rejected_.fetch_add(1, std::memory_order_relaxed);
    return tl::make_unexpected(std::move(error));
  };
  const std::string where = fmt::format("pose of tool '{}'", tool.name);
  if (tool.fixed) {
    return refuse(
        {ErrorCode::kFailedPrecondition, where + ": the scene says that this tool is fixed, so it takes no poses"});
  }
  if (!message.has_position_m()) return refuse({ErrorCode::kInvalidArgument, where + ": give position_m"});
  const auto position = model::read_vector(message.position_m(), where + ".position_m");
  if (!position) return refuse(position.error());
  const auto orientation = model::read_orientation(message.orientation(), where + ".orientation");
  if (!orientation) return refuse(orientation.error());
  const bool has_joints = message.joint_values_size() > 0;
  const auto joints = has_joints ? model::read_joints(message.joint_values(), tool.joints, where + ".joint_values")
                                 : Result<decltype(Pose::joint_values)>({});
  if (!joints) return refuse(joints.error());
  const auto valid_for_s = read_validity(message, where);
  if (!valid_for_s) return refuse(valid_for_s.error());

  const std::lock_guard lock(writers_);
  if (!is_newer(message)) {
    return refuse({ErrorCode::kInvalidArgument,
                   fmt::format("{}: sequence {} is not newer than the client's last; count up from 1", where,
                               message.sequence())});
  }
  TM_ASSERT(position->allFinite(), "the loop takes finite poses only");
  newest_.writing() = {{*position, *orientation, *joints},
                       has_joints,
                       {message.sequence(), message.client_time_ns(), message.client_id(), Clock::now()},
                       *valid_for_s};
  if (newest_.publish()) superseded_.fetch_add(1, std::memory_order_relaxed);
  received_.fetch_add(1, std::memory_order_relaxed);
  return {};
}

}  // namespace tensormass::world
