#pragma once

#include <string>

#include "haptic/loop.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::haptic {

/// What a report is about.
struct RunLabel {
  std::string server;
  std::string scene;
  std::string tool;
  std::string transport;
  std::string device;
};

/// For people: a few lines.
std::string to_text(const LoopReport& report, const RunLabel& label);

/// For programs: one JSON object; durations in seconds. Histograms carry their buckets as [upper bound in s, count], so
/// that those of several clients can be added.
std::string to_json(const LoopReport& report, const RunLabel& label);

/// For people: why a run had no answer to any pose, as far as the scene's status after it tells.
/// `poses_rejected_before` is the status' count before it.
std::string why_unanswered(const v1::SceneStatus& status, std::uint64_t poses_rejected_before);

}  // namespace tensormass::haptic
