#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "backend/backend.h"

/// The outer iteration of a step that is solved to a tolerance: Newton's method with backtracking, the same for every
/// device.
///
///   evaluate forces and the consistent stiffness -> solve -> full step -> halve it while it is too long
///
/// The consistent stiffness may be indefinite far from the solution; conjugate gradients notice, and that solve is done
/// again with the positive one.
namespace tensormass::backend {

/// tensor::PatchResidual of the whole scene.
struct Imbalance {
  double imbalance_squared = 0;  ///< [N² s²]
  double force_squared = 0;      ///< [N² s²]
  double slope = 0;              ///< [J] imbalance · increment: above zero the increment still leads downhill
  double moved = 0;              ///< by the increment: the most that a node moved, relative to its own coordinates

  bool finite() const { return std::isfinite(imbalance_squared) && std::isfinite(force_squared); }
};

/// An imbalance is not measured against less than this share of the largest forces that a scene has seen, of which
/// rounding leaves something: a scene that was let go would never come to rest.
template <class Real>
inline constexpr double kRoundingShare = sizeof(Real) == 4 ? 0.1 : 1e-6;

template <class Real>
Imbalance read_imbalance(std::span<const tensor::PatchResidual<Real>> patches) {
  Imbalance sum;
  for (const auto& patch : patches) {
    sum.imbalance_squared += static_cast<double>(patch.imbalance_squared);
    sum.force_squared += static_cast<double>(patch.force_squared);
    sum.slope += static_cast<double>(patch.slope);
    sum.moved = std::max(sum.moved, std::sqrt(static_cast<double>(patch.moved_squared)));
  }
  return sum;
}

/// A Device has
///   void run(model::Phase), in order with what was run before; waits for nothing
///   tensor::NewtonControl& control(), read by the next run
///   Imbalance imbalance() of the last evaluation, StepResult result() of the last solve or backtracking: wait for it
/// positive: take the positive stiffness throughout. largest_force_squared: of the ends of all steps since the scene's
/// start, updated. Not of what a step passes through: an increment that turns a nearly incompressible body passes
/// through forces far above those that it ends with, and any imbalance would be small beside them.
///
/// It ends where the imbalance is small, or where the increment of a solve no longer moves a node by more than its
/// coordinates can tell: where nothing acts on a body, the forces of its elements are rounding, and so is any share of
/// them. Not where it begins: the first solve also takes the step's inertia along, by which a body turns or meets a
/// tool without any increment.
template <class Real, class Device>
StepResult newton_step(Device& device, std::uint32_t max_iterations, double tolerance, bool positive,
                       double& largest_force_squared) {
  using model::Phase;
  constexpr int kMaxHalvings = 10;
  constexpr double kMaxDetour = 0.25;
  constexpr int kMaxDetourIterations = 6;   // and what rounding leaves goes up and down for ever
  constexpr double kTrustedResidual = 0.5;  // of a solve whose increment tells how far there is to go
  tensor::NewtonControl& control = device.control();
  const std::uint32_t usual_stiffness = positive ? 1 : 0;
  control = {.positive_stiffness = usual_stiffness, .begins_step = 1, .line_share = 1};
  const auto evaluate = [&] {
    device.run(Phase::kEvaluate);
    const Imbalance now = device.imbalance();
    control.begins_step = 0;
    return now;
  };
  const auto take_share = [&](double share) {
    control.line_share = static_cast<float>(share);
    device.run(Phase::kBacktrack);
    return evaluate();
  };
  const auto relative = [&](const Imbalance& now) {
    constexpr double kShare = kRoundingShare<Real>;
    const double scale = std::max(now.force_squared, kShare * kShare * largest_force_squared);
    return now.imbalance_squared == 0 ? 0 : std::sqrt(now.imbalance_squared / scale);
  };

  device.run(Phase::kBegin);
  Imbalance at = evaluate();
  StepResult total;
  total.newton_iterations = 0;
  std::uint32_t cg_iterations = 0;
  double best = std::numeric_limits<double>::infinity();
  int since_best = 0;
  while (total.newton_iterations < max_iterations) {
    device.run(Phase::kSolve);
    StepResult solved = device.result();
    cg_iterations += solved.cg_iterations;
    if (solved.negative_curvature && solved.finite) {
      control.positive_stiffness = 1;
      take_share(0);
      device.run(Phase::kSolve);
      solved = device.result();
      cg_iterations += solved.cg_iterations;
      control.positive_stiffness = usual_stiffness;
    }
    const std::uint32_t iterations = total.newton_iterations + 1;
    Imbalance next = evaluate();
    // The first solve also moves driven nodes and takes the step's inertia along: nothing to compare it with. Later, an
    // increment is too long where the imbalance grew, unless it still leads downhill and the imbalance stays well below
    // the forces: large bends pass through imbalances above the one that they began with.
    const auto too_long = [&] {
      if (!next.finite() || !device.result().finite) return true;
      if (iterations == 1 || next.imbalance_squared < at.imbalance_squared) return false;
      return !(next.slope > 0 && next.imbalance_squared < kMaxDetour * kMaxDetour * next.force_squared);
    };
    const bool settled = iterations > 1 && next.finite() && device.result().finite && !solved.negative_curvature &&
                         solved.cg_relative_residual < kTrustedResidual &&
                         next.moved <= std::numeric_limits<Real>::epsilon();
    double share = 1;
    for (int halving = 0; halving < kMaxHalvings && !settled && too_long(); ++halving) {
      share /= 2;
      next = take_share(share);
    }
    const bool stalled = !settled && too_long();
    at = next;
    since_best = at.imbalance_squared < best ? 0 : since_best + 1;
    best = std::min(best, at.imbalance_squared);
    total = device.result();
    total.cg_relative_residual = solved.cg_relative_residual;
    total.negative_curvature = solved.negative_curvature;
    total.newton_iterations = iterations;
    total.finite = total.finite && at.finite();
    total.converged = false;
    if (!total.finite) break;
    total.newton_residual = relative(at);
    total.converged = total.newton_residual <= tolerance || settled;
    if (total.converged || stalled || since_best > kMaxDetourIterations) break;
  }
  total.cg_iterations = cg_iterations;
  if (total.converged) largest_force_squared = std::max(largest_force_squared, at.force_squared);
  device.run(Phase::kEnd);
  return total;
}

}  // namespace tensormass::backend
