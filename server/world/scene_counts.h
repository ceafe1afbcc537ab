#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>

#include "solver/step_result.h"
#include "world/duration_counts.h"
#include "world/guard.h"

namespace tensormass::world {

/// What metrics say of a scene, beside its status (docs/metrics.md). Counts start at the scene's load and only grow: a
/// reset does not clear them.
///
///     the loop's thread, the publisher's --> relaxed atomics --> any thread
struct SceneCounts {
  template <std::size_t kCount>
  using Counts = std::array<std::atomic<std::uint64_t>, kCount>;
  /// Index in `faults` of a device that failed. The others are those of the breaches.
  static constexpr std::size_t kDeviceFault = kBreachNames.size();

  /// Age of the newest pose of a tool at the start of a step, as long as its client streams poses (valid_for_s).
  DurationCounts pose_ages;
  /// Time from the arrival of a pose until the message with its force was written.
  DurationCounts poses_to_force;
  std::atomic<std::uint64_t> cg_iterations{0}, held_steps{0};
  Counts<kBreachNames.size()> guard_events{}, recoveries{};  ///< [Breach] that the step left first
  Counts<kBreachNames.size() + 1> faults{};                  ///< [Breach], and kDeviceFault

  /// Counts a step of the loop. event: of the guard, or nullptr. recovery_begins: a recovery began with the step.
  void take_step(const solver::StepResult& result, const GuardEvent* event, bool recovery_begins) {
    add_to(cg_iterations, result.cg_iterations);
    if (event == nullptr) return;
    const auto reason = static_cast<std::size_t>(event->first.breach);
    add_to(guard_events[reason], 1);
    if (recovery_begins) add_to(recoveries[reason], 1);
    if (event->outcome == GuardEvent::Outcome::kHeld) add_to(held_steps, 1);
    if (event->outcome == GuardEvent::Outcome::kStopped) add_to(faults[reason], 1);
  }
  void take_device_fault() { add_to(faults[kDeviceFault], 1); }

 private:
  static void add_to(std::atomic<std::uint64_t>& count, std::uint64_t more) {
    count.fetch_add(more, std::memory_order_relaxed);
  }
};

}  // namespace tensormass::world
