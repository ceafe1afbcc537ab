#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>

#include "backend/backend.h"
#include "model/model.h"
#include "world/guard.h"

namespace tensormass::world {

/// Limits the conjugate-gradient iterations of a solve, so that steps keep to the scene's time budget.
///
///     limit:  floor_cg_iterations <= limit() <= cg_max_iterations
///
///     median step time above budget_s           lower the limit
///     below 80 % of it, and the limit is used   raise the limit
///     residual near floor_tolerance             do not lower; raise if the limit is used
///     guard repeated a step for its residual    raise at once
///
/// A change waits for the median of kWindow steps, because a single step may be late for other reasons. A repeated step
/// does not wait: it costs more than the iterations that were saved. Written by the loop, read by any thread.
class IterationBudget {
 public:
  explicit IterationBudget(const model::Settings& settings);

  /// Takes a step's duration and result. event: World::guard_event.
  void take_step(double step_s, const solver::StepResult& result, const GuardEvent* event = nullptr);
  /// Starts again with cg_max_iterations, because the scene was reset.
  void clear();

  /// Iterations that a solve may take.
  std::uint32_t limit() const { return limit_.load(std::memory_order_relaxed); }
  /// Median time of the steps in the last full window [s]; 0 before the first.
  double step_s() const { return median_s_.load(std::memory_order_relaxed); }

 private:
  static constexpr std::size_t kWindow = 8;  // steps

  void adapt();
  void set_limit(std::uint32_t limit);
  void start_window();

  const model::Settings settings_;
  std::array<double, kWindow> times_s_{};
  std::size_t filled_ = 0;
  double worst_residual_ = 0;
  std::uint32_t most_used_ = 0;
  std::atomic<std::uint32_t> limit_;
  std::atomic<double> median_s_{0};
};

}  // namespace tensormass::world
