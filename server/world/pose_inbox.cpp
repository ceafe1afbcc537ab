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
  const bool has_session = message.session() != 0;
  if (!has_session && message.client_id() == 0 && message.sequence() == 0) return true;
  const std::uint64_t id = has_session ? message.session() : message.client_id();
  const auto known = std::find_if(clients_.begin(), clients_.end(), [&](const Client& client) {
    return client.id == id && client.has_session == has_session && client.last_sequence > 0;
  });
  if (known != clients_.end()) {
    if (message.sequence() <= known->last_sequence) return false;
    known->last_sequence = message.sequence();
    return true;
  }
  if (message.sequence() == 0) return false;
  clients_[next_client_++ % kClients] = {id, has_session, message.sequence()};
  return true;
}

Result<void> PoseInbox::may_move(const v1::ToolPose& message, std::string_view where, Clock::time_point now,
                                 Clock::time_point expiry) {
  if (claim_.holds(now) && !claim_.is_of(message)) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("{}: client {:#x} claims it, and goes on sending poses; end that client, or take the tool "
                            "over with MoveTool",
                            where, claim_.client_id));
  }
  if (taken_.holds(now) && taken_.is_of(message)) {
    taken_.until = std::max(taken_.until, expiry);
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("{}: MoveTool took it over; send nothing for valid_for_s, or begin a new session", where));
  }
  return {};
}

bool PoseInbox::claim(const v1::ToolPose& message, PoseSource source, Clock::time_point now, Clock::time_point expiry) {
  if (source == PoseSource::kOperator && claim_.holds(now) && !claim_.is_of(message)) taken_ = claim_;
  claim_ = {};
  if (message.session() == 0 || !message.has_valid_for_s()) return false;
  claim_ = {message.session(), message.client_id(), expiry};
  return true;
}

Result<void> PoseInbox::submit(const model::ToolModel& tool, const v1::ToolPose& message, PoseSource source,
                               Clock::time_point now) {
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
  const auto level = model::read_level(message.level(), tool, where + ".level");
  if (!level) return refuse(level.error());
  const Clock::time_point expiry =
      message.has_valid_for_s()
          ? now + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(*valid_for_s))
          : now;

  const std::lock_guard lock(writers_);
  if (source == PoseSource::kClient) {
    if (const auto moves = may_move(message, where, now, expiry); !moves) return refuse(moves.error());
  }
  if (!is_newer(message)) {
    return refuse({ErrorCode::kInvalidArgument,
                   fmt::format("{}: sequence {} is not newer than the client's last; count up from 1", where,
                               message.sequence())});
  }
  TM_ASSERT(position->allFinite(), "the loop takes finite poses only");
  newest_.writing() = {
      {*position, *orientation, *joints},
      has_joints,
      {message.sequence(), message.client_time_ns(), message.client_id(), now, claim(message, source, now, expiry)},
      *valid_for_s,
      *level};
  if (newest_.publish()) superseded_.fetch_add(1, std::memory_order_relaxed);
  received_.fetch_add(1, std::memory_order_relaxed);
  if (message.has_valid_for_s()) newest_arrival_.store(now.time_since_epoch().count());
  return {};
}

}  // namespace tensormass::world
