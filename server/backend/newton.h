#pragma once

#include <cmath>

#include "backend/backend.h"

/// The outer iteration of a step that is solved to a tolerance: Newton's method with backtracking, the same for every
/// device.
///
///   evaluate forces and the consistent stiffness -> solve -> full step -> halve it while the imbalance has not fallen
///
/// The consistent stiffness may be indefinite far from the solution; conjugate gradients notice, and that solve is done
/// again with the positive one.
namespace tensormass::backend {

/// Sums over the free components of a scene.
struct Imbalance {
  double imbalance_squared = 0;
  double force_squared = 0;

  bool finite() const { return std::isfinite(imbalance_squared) && std::isfinite(force_squared); }
  double relative() const { return imbalance_squared == 0 ? 0 : std::sqrt(imbalance_squared / force_squared); }
};

template <class Real>
Imbalance read_imbalance(std::span<const tensor::PatchResidual<Real>> patches) {
  Imbalance sum;
  for (const auto& patch : patches) {
    sum.imbalance_squared += static_cast<double>(patch.imbalance_squared);
    sum.force_squared += static_cast<double>(patch.force_squared);
  }
  return sum;
}

/// A Device has
///   void run(model::Phase), in order with what was run before; waits for nothing
///   tensor::NewtonControl& control(), read by the next run
///   Imbalance imbalance() of the last evaluation, and StepResult result() of the last solve: wait for the device
template <class Device>
StepResult newton_step(Device& device, std::uint32_t max_iterations, double tolerance) {
  using model::Phase;
  constexpr int kMaxHalvings = 10;
  tensor::NewtonControl& control = device.control();
  control = {.positive_stiffness = 0, .begins_step = 1, .line_change = 0};
  const auto evaluate = [&] {
    device.run(Phase::kEvaluate);
    const Imbalance now = device.imbalance();
    control.begins_step = 0;
    return now;
  };
  const auto retreat = [&](double share) {
    control.line_change = static_cast<float>(share);
    device.run(Phase::kBacktrack);
    return evaluate();
  };

  device.run(Phase::kBegin);
  Imbalance at = evaluate();
  StepResult total;
  total.newton_iterations = 0;
  total.converged = false;
  std::uint32_t cg_iterations = 0;
  while (total.newton_iterations < max_iterations) {
    device.run(Phase::kSolve);
    StepResult solved = device.result();
    cg_iterations += solved.cg_iterations;
    if (solved.negative_curvature && solved.finite) {
      control.positive_stiffness = 1;
      retreat(-1);
      device.run(Phase::kSolve);
      solved = device.result();
      cg_iterations += solved.cg_iterations;
      control.positive_stiffness = 0;
    }
    const std::uint32_t iterations = total.newton_iterations + 1;
    total = solved;
    total.newton_iterations = iterations;
    total.converged = false;

    Imbalance next = evaluate();
    // The first solve also moves driven nodes and takes the step's inertia along: nothing to compare it with.
    double share = 1;
    const auto worse = [&] {
      return !next.finite() || (iterations > 1 && next.imbalance_squared >= at.imbalance_squared);
    };
    for (int halving = 0; halving < kMaxHalvings && worse(); ++halving) {
      next = retreat(-share / 2);
      share /= 2;
    }
    const bool stalled = worse();
    at = next;
    total.finite = at.finite();
    if (!total.finite) break;
    total.newton_residual = at.relative();
    total.converged = total.newton_residual <= tolerance;
    if (total.converged || stalled) break;
  }
  total.cg_iterations = cg_iterations;
  device.run(Phase::kEnd);
  return total;
}

}  // namespace tensormass::backend
