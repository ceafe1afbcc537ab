#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "solver/step_result.h"

/// Newton's method with backtracking, for scenes that solve a step to a tolerance. It runs on the host and is the same
/// for every device:
///
///        ┌──────────────────────────────────────────────────────────────┐
///        v                                                              │ residual above the tolerance
///   evaluate ──> solve ──> full increment ──> evaluate ──> too long? ───┤
///   forces, K     CG                             ^            │ yes     │ no
///                                                └─ half of the         └──> end
///                                                   increment
///
/// 1. The stiffness is the consistent one. Far from the solution it may be indefinite; conjugate gradients notice
///    negative curvature, and that solve is repeated with the stiffness projected to positive definite.
/// 2. An increment is too long if the residual grew. Two exceptions: the first increment also moves prescribed nodes
///    and carries the step's inertia, so there is nothing to compare it with; and large bends pass through residuals
///    above the one they start from, so growth is accepted while the increment leads downhill and the residual stays
///    below kMaxDetour of the forces.
/// 3. The step has converged if the residual is small against the forces, or if an increment no longer moves a node by
///    more than its coordinates can resolve. Without the second test a body without any load would never converge: the
///    forces of its elements are rounding errors, and so is every fraction of them.
namespace tensormass::solver {

/// The residual is compared with the acting forces, but at least with this fraction of the largest forces that the
/// scene has seen: rounding leaves something of those, and a scene that was released would never come to rest.
template <class Real>
inline constexpr double kRoundingShare = sizeof(Real) == 4 ? 0.1 : 1e-6;

/// Runs one step. Device has
///   begin(), evaluate(), solve(), backtrack(), end()   enqueue the stages of a phase after what was enqueued before
///   view::NewtonControl& control()                     what the next phase reads; waits until the last one has read it
///   NewtonResidual residual()                          of the last evaluation; waits for it
///   StepResult result()                                of the last solve or backtrack; waits for it
/// project_to_psd: use the projected stiffness in every iteration.
/// largest_force_squared [N² s²]: read and updated; of the ends of all steps since the scene's start. Forces within a
/// step do not count: an increment that rotates a nearly incompressible body passes through forces far above those at
/// its end, and any residual would be small against them.
template <class Real, class Device>
StepResult newton_step(Device& device, std::uint32_t max_iterations, double tolerance, bool project_to_psd,
                       double& largest_force_squared) {
  constexpr int kMaxHalvings = 10;
  constexpr double kMaxDetour = 0.25;
  constexpr int kMaxDetourIterations = 6;   // rounding errors would go up and down for ever
  constexpr double kTrustedResidual = 0.5;  // relative CG residual below which an increment says how far there is to go
  view::NewtonControl& control = device.control();
  const std::uint32_t usual_stiffness = project_to_psd ? 1 : 0;
  control = {.positive_stiffness = usual_stiffness, .begins_step = 1, .line_share = 1};
  const auto evaluate = [&] {
    device.evaluate();
    const NewtonResidual now = device.residual();
    control.begins_step = 0;
    return now;
  };
  const auto take_share = [&](double share) {
    control.line_share = static_cast<float>(share);
    device.backtrack();
    return evaluate();
  };
  const auto relative = [&](const NewtonResidual& now) {
    constexpr double kShare = kRoundingShare<Real>;
    const double scale = std::max(now.force_squared, kShare * kShare * largest_force_squared);
    return now.residual_squared == 0 ? 0 : std::sqrt(now.residual_squared / scale);
  };

  device.begin();
  NewtonResidual at = evaluate();
  StepResult total;
  total.newton_iterations = 0;
  std::uint32_t cg_iterations = 0;
  double best = std::numeric_limits<double>::infinity();
  int since_best = 0;
  while (total.newton_iterations < max_iterations) {
    device.solve();
    StepResult solved = device.result();
    cg_iterations += solved.cg_iterations;
    if (solved.negative_curvature && solved.finite) {
      control.positive_stiffness = 1;
      take_share(0);
      device.solve();
      solved = device.result();
      cg_iterations += solved.cg_iterations;
      control.positive_stiffness = usual_stiffness;
    }
    const std::uint32_t iterations = total.newton_iterations + 1;
    NewtonResidual next = evaluate();
    const auto too_long = [&] {
      if (!next.finite() || !device.result().finite) return true;
      if (iterations == 1 || next.residual_squared < at.residual_squared) return false;
      return !(next.slope > 0 && next.residual_squared < kMaxDetour * kMaxDetour * next.force_squared);
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
    since_best = at.residual_squared < best ? 0 : since_best + 1;
    best = std::min(best, at.residual_squared);
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
  device.end();
  return total;
}

}  // namespace tensormass::solver
