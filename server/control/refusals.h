#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <string_view>

namespace tensormass::control {

/// Limits beyond which the control plane refuses something, for metrics (docs/metrics.md).
enum class Limit : std::uint8_t {
  kScenes,             ///< limits::kMaxScenes
  kSceneMemory,        ///< --max-scene-mib
  kMemory,             ///< --max-memory-mib
  kLoadTime,           ///< --max-load-s
  kLongCalls,          ///< limits::kMaxLongCalls
  kWaitingCalls,       ///< limits::kMaxWaitingCalls
  kResetCalls,         ///< limits::kMaxResetCalls
  kControlConnection,  ///< what a connection may be and do (core/http2_limits.h)
  kRole,               ///< the role of the client's key (access/rules.h)
};
inline constexpr std::array<std::string_view, 9> kLimitNames{
    "max_scenes",        "max_scene_mib",   "max_memory_mib",     "max_load_s", "max_long_calls",
    "max_waiting_calls", "max_reset_calls", "control_connection", "role"};
static_assert(static_cast<std::size_t>(Limit::kRole) + 1 == kLimitNames.size(), "a name for each limit");

/// Counts of refusals since the daemon started. Any thread counts and reads.
class Refusals {
 public:
  void count(Limit limit) { counts_[static_cast<std::size_t>(limit)].fetch_add(1, std::memory_order_relaxed); }
  std::uint64_t of(Limit limit) const {
    return counts_[static_cast<std::size_t>(limit)].load(std::memory_order_relaxed);
  }

 private:
  std::array<std::atomic<std::uint64_t>, kLimitNames.size()> counts_{};
};

/// What recordings of a scene lost since it was loaded, for metrics: steps and checks that did not reach their client,
/// and recordings that ended because their client took nothing for limits::kRecordingLease. Any thread counts and
/// reads.
struct RecordingLosses {
  std::atomic<std::uint64_t> steps{0}, checks{0}, recordings{0};
};

}  // namespace tensormass::control
