#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "bus/bus_counts.h"
#include "control/refusals.h"
#include "control/scene_registry.h"
#include "tensormass/v1/control.pb.h"
#include "world/runner.h"

/// What Prometheus scrapes of a daemon: docs/metrics.md has the table of names, and tests/metrics holds it against
/// them.
///
///     loop, publisher ──> relaxed atomics ──> read_metrics ──> DaemonMetrics ──> to_text ──> GetMetrics, --metrics
///
/// A scrape waits for no step, and no step for a scrape.
namespace tensormass::metrics {

/// Everything that the text is made of.
struct DaemonMetrics {
  v1::GetVersionResponse identity;
  std::uint64_t malformed_messages = 0;
  double memory_bytes = 0, memory_limit_bytes = 0;
  const control::Refusals* refusals;  ///< outlives this
  control::SceneRegistry::LossesOfScenes losses{};
  bus::BusCounts bus{};
  std::vector<world::SceneMetrics> scenes{};  ///< at most limits::kMaxScenes
};

/// Reads the present numbers. registry: outlives the result. Any thread may call it.
DaemonMetrics read_metrics(const control::SceneRegistry& registry, const v1::GetVersionResponse& identity,
                           std::uint64_t malformed_messages, const bus::BusCounts& bus = {});

/// Returns the text format of Prometheus. Families without a sample have their lines HELP and TYPE.
std::string to_text(const DaemonMetrics& metrics);

}  // namespace tensormass::metrics
