#pragma once

#include <chrono>
#include <cstddef>
#include <cstdint>

/// Limits of `--state` and of what watches the daemon, with their unit and what happens beyond them.
namespace tensormass::limits {

/// Bytes of all files of a state folder unless `--max-state-mib` says otherwise; what would pass it is not written.
inline constexpr std::uint64_t kDefaultStateMib = 16'384;
/// Snapshots of a scene that are kept. An older one is removed when a new one is complete.
inline constexpr std::size_t kStateGenerations = 3;
/// Bytes of the adjusted values in a snapshot's file; a larger one counts as damaged.
inline constexpr std::size_t kMaxStateAdjustmentBytes = std::size_t{1} << 20;
/// Time between two snapshots of a scene whose state changes.
inline constexpr std::chrono::milliseconds kStatePeriod{4000};
/// A snapshot waits for this many times as long as the one before kept the scene from stepping, if that is longer.
inline constexpr int kStateRest = 100;
/// Time that a daemon which ends waits for the last snapshots before it releases the hands.
inline constexpr std::chrono::milliseconds kLastStateTime{200};
/// Time after which a loop or the publisher that has not turned counts as hanging.
inline constexpr std::chrono::milliseconds kTurnTime{2000};

}  // namespace tensormass::limits
