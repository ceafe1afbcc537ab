#include "world/iteration_budget.h"

#include <algorithm>

#include "core/assert.h"

namespace tensormass::world {

namespace {
/// Fraction of the budget. Shorter steps have room for more iterations; between it and the budget nothing changes.
constexpr double kRoom = 0.8;
/// Fraction of floor_tolerance. Above it there is no accuracy left to give up.
constexpr double kNearFloor = 0.5;
}  // namespace

IterationBudget::IterationBudget(const model::Settings& settings)
    : settings_(settings), limit_(settings.cg_max_iterations) {}

void IterationBudget::take_step(double step_s, const solver::StepResult& result, const GuardEvent* event) {
  if (settings_.budget_s == 0) return;
  if (event != nullptr) {
    // Time and result belong to the repeated step and say nothing about this limit.
    if (event->first.breach != Breach::kLinearResidual) return;
    set_limit(limit() + std::max(limit() / 2, 1u));
    start_window();
    return;
  }
  const std::uint32_t solves = std::max(result.newton_iterations, 1u);
  most_used_ = std::max(most_used_, (result.cg_iterations + solves - 1) / solves);
  worst_residual_ = std::max(worst_residual_, result.cg_relative_residual);
  TM_ASSERT(filled_ < kWindow, "a full window was evaluated");
  times_s_[filled_++] = step_s;
  if (filled_ < kWindow) return;
  std::nth_element(times_s_.begin(), times_s_.begin() + kWindow / 2, times_s_.end());
  median_s_.store(times_s_[kWindow / 2], std::memory_order_relaxed);
  adapt();
  start_window();
}

void IterationBudget::adapt() {
  const std::uint32_t now = limit();
  const bool at_limit = most_used_ >= now;
  const bool near_floor = settings_.floor_tolerance > 0 && worst_residual_ > kNearFloor * settings_.floor_tolerance;
  if (near_floor) {
    if (at_limit) set_limit(now + std::max(now / 10, 1u));
  } else if (step_s() > settings_.budget_s) {
    const std::uint32_t used = std::min(now, most_used_);
    set_limit(used - std::min(used, std::max(used / 10, 1u)));
  } else if (step_s() < kRoom * settings_.budget_s && at_limit) {
    set_limit(now + std::max(now / 20, 1u));
  }
}

void IterationBudget::set_limit(std::uint32_t limit) {
  TM_ASSERT(settings_.floor_cg_iterations <= settings_.cg_max_iterations,
            "the floor is at most the model's iterations");
  limit_.store(std::clamp(limit, settings_.floor_cg_iterations, settings_.cg_max_iterations),
               std::memory_order_relaxed);
}

void IterationBudget::start_window() {
  filled_ = 0;
  worst_residual_ = 0;
  most_used_ = 0;
}

void IterationBudget::clear() {
  set_limit(settings_.cg_max_iterations);
  median_s_.store(0, std::memory_order_relaxed);
  start_window();
}

}  // namespace tensormass::world
