#pragma once

// The measurements of a run as text and as JSON. Pure functions; nothing fails.

#include <cstdint>
#include <string>

#include "haptic/loop.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {

/// Server, scene, tool, transport and device of a run.
struct RunLabel {
  std::string server;
  std::string scene;
  std::string tool;
  std::string transport;
  std::string device;
};

/// A few lines for people.
std::string to_text(const LoopReport& report, const RunLabel& label);

/// One JSON object for programs, durations in s. max_torque_n_m and max_jaw_torque_n_m only for a device that has them.
/// A histogram carries its buckets as [upper bound in s, count], so that the histograms of several clients can be
/// added.
std::string to_json(const LoopReport& report, const RunLabel& label);

/// Tells people, in one line without its end, that the scene has recovered `count` times since the last such line.
std::string recovery_line(std::uint64_t count);

/// The line for a tool that another client claims.
std::string claimed_line(std::uint64_t client_id);
/// Says that the scene has the tool no more, or has it again.
std::string removed_line(bool removed);

/// Explains to people why no pose of a run was answered, from the scene's `status` after the run.
/// `poses_rejected_before` is status.poses_rejected() before the run.
std::string why_unanswered(const v1::SceneStatus& status, std::uint64_t poses_rejected_before);

}  // namespace tensormass::haptic
