#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>

#include "backend/backend.h"
#include "model/model.h"
#include "world/guard.h"

namespace tensormass::world {

/// How many conjugate-gradient iterations a solve may take, so that steps keep to the scene's budget of time: lowered
/// while they take longer, raised while there is room, never below the scene's floor. A change waits for the median of
/// some steps, since a single one may be late for reasons of its own. Only a step that the guard had to make again for
/// its residual raises it at once: that costs more than the iterations which were saved. Written by the loop, read by
/// anyone.
class IterationBudget {
 public:
  explicit IterationBudget(const model::Model& model);

  /// event: World::guard_event.
  void take_step(double step_s, const solver::StepResult& result, const GuardEvent* event = nullptr);
  /// The scene is at rest again.
  void clear();

  std::uint32_t limit() const { return limit_.load(std::memory_order_relaxed); }
  /// Median of the last steps that were looked at [s]; 0 before.
  double step_s() const { return median_s_.load(std::memory_order_relaxed); }

 private:
  static constexpr std::size_t kWindow = 8;  // steps

  void adapt();
  void set_limit(std::uint32_t limit);
  void begin_window();

  const model::Model& model_;
  std::array<double, kWindow> times_s_{};
  std::size_t filled_ = 0;
  double worst_residual_ = 0;
  std::uint32_t most_used_ = 0;
  std::atomic<std::uint32_t> limit_;
  std::atomic<double> median_s_{0};
};

}  // namespace tensormass::world
