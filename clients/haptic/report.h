#pragma once

#include <string>

#include "haptic/loop.h"

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

}  // namespace tensormass::haptic
