#pragma once

#include <cstdint>

#include "core/scalar.h"
#include "model/model.h"
#include "physics/tool/pose.h"

/// A tool of a stepping scene: how it follows the poses of a client, and what a client gets back.
///
///     client ──ReceivedPose──> inbox ──> ToolMotion ──shape's pose──> step ──ToolForce──> ToolReading ──> client
///
///     tool's frame     what clients send and receive
///     shape's frame    the tool's frame moved by tip_offset_m; contact is computed there (physics/tool/tool.h)
namespace tensormass::world {

using physics::Pose;

/// The numbers of a pose's message. Feedback repeats them, so that a client can measure its delay.
struct PoseStamp {
  std::uint64_t sequence = 0;
  std::uint64_t client_time_ns = 0;
  std::uint64_t client_id = 0;
};

struct ReceivedPose {
  Pose pose;
  PoseStamp stamp;
};

/// A tool at the end of a step. Feedback, frames and the status all carry this.
struct ToolReading {
  Pose pose;
  PoseStamp newest;  ///< stamp of the newest pose that the step used; all zero before the first
  Vec3<double> force_n = Vec3<double>::Zero();
  Vec3<double> torque_n_m = Vec3<double>::Zero();  ///< about the tool's position
  /// A haptic client closes its own loop with this.
  Mat3<double> stiffness_n_per_m = Mat3<double>::Zero();
};

/// The motion of one tool, step by step.
class ToolMotion {
 public:
  explicit ToolMotion(const model::ToolModel& tool) : tool_(&tool) { place(); }

  /// Puts the tool at its initial pose, where it stays until the next target.
  void place() { target_ = current_ = tool_->initial_pose; }
  void set_target(const Pose& target) { target_ = target; }
  /// Starts a step of length dt_s: moves the tool towards its target, at most at its maximum speed.
  void move(double dt_s);
  /// Takes the last `move` back: its step failed.
  void take_back() { current_ = before_; }

  const Pose& pose() const { return current_; }
  /// Pose of the shape at a fraction of the step: 0 is its start, 1 its end.
  Pose shape_at(double fraction) const { return physics::between(to_, from_, 1 - fraction); }
  /// Vector from the tool's position to the origin of its shape's frame [m].
  Vec3<double> lever() const { return lever(current_); }

 private:
  Vec3<double> lever(const Pose& pose) const { return physics::rotation(pose) * tool_->tip_offset_m; }
  Pose shape_of(const Pose& pose) const { return {pose.position_m + lever(pose), pose.orientation, pose.joint_values}; }
  double longest_way(const Pose& from, const Pose& to) const;

  const model::ToolModel* tool_;
  Pose target_;     // the newest pose that a client sent
  Pose current_;    // in the simulation
  Pose before_;     // at the start of the step
  Pose from_, to_;  // poses of the shape at the start and the end of the step
};

}  // namespace tensormass::world
