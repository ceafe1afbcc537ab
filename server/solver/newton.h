#pragma once

#include <algorithm>
#include <cmath>
#include <limits>

#include "solver/step_result.h"

/// Newton's method with backtracking, for scenes that solve a step to a tolerance. It runs on the host and is the same
/// for every device.
///
///                       ┌────────────────────────────────────────────────────────────┐
///                       v                                                            │ no
///   begin ─> evaluate ─> solve ─────────> evaluate ─> too long? ─ no ─> converged? ──┤
///            forces, K   CG, then the        ^           │ yes                       │ yes
///                        full increment      └─ half of ─┘                           └────> end
///                                               the increment
///
///   residual    right-hand side of the linearized step, over the free directions (view::PatchResidual)
///   increment   change of the velocities that a linear solve finds
///   slope       residual · increment; positive: the increment still leads downhill
///
/// 1. The stiffness is the consistent one. Far from the solution it may be indefinite. If conjugate gradients find
///    negative curvature, that solve is repeated with the stiffness projected to positive definite.
/// 2. An increment is too long if the residual grew. The first increment is an exception: it also moves prescribed
///    nodes and carries the step's inertia, so there is nothing to compare it with.
/// 3. Large bends pass through residuals above the one they start from. Growth is therefore accepted while the slope is
///    positive and the residual stays below kMaxDetour of the forces.
/// 4. The step has converged if the residual is small against the forces. It has also converged if an increment no
///    longer moves a node by more than its coordinates can resolve. Without that second test a body without any load
///    would never converge: the forces of its elements are rounding errors, and so is every fraction of them.
/// 5. The step ends unconverged at the largest number of iterations, if no halving makes the increment short enough, or
///    after kMaxDetourIterations without a new smallest residual.
namespace tensormass::solver {

/// The residual is compared with the acting forces, but at least with this fraction of the largest forces that the
/// scene has seen. Rounding errors of that size remain, so a scene whose loads are released would otherwise never
/// converge.
template <class Real>
inline constexpr double kRoundingShare = sizeof(Real) == 4 ? 0.1 : 1e-6;

/// Runs one step. Device has
///
///   begin(), evaluate(), solve(), backtrack(), end()   enqueue the stages of a phase after those enqueued before
///   view::NewtonControl& control()                     for the next phase; waits until the last one has read it
///   NewtonResidual residual()                          of the last evaluation; waits for it
///   StepResult result()                                of the last solve or backtrack; waits for it
///   bool stopped()                                     the step must end soon, whatever its result
///
/// project_to_psd: use the projected stiffness in every iteration.
/// largest_force_squared: the largest forces at the end of any converged step since the scene's start [N² s²]; read and
/// updated. Forces within a step do not count. An increment that rotates a nearly incompressible body passes through
/// forces far above those at its end, and any residual would be small against them.
template <class Real, class Device>
StepResult newton_step(Device& device, std::uint32_t max_iterations, double tolerance, bool project_to_psd,
                       double& largest_force_squared) {
  constexpr int kMaxHalvings = 10;
  constexpr double kMaxDetour = 0.25;
  constexpr int kMaxDetourIterations = 6;   // rounding errors would oscillate for ever
  constexpr double kTrustedResidual = 0.5;  // relative CG residual above which an increment may be far too short
  view::NewtonControl& control = device.control();
  const std::uint32_t usual_stiffness = project_to_psd ? 1 : 0;
  control = {.projects_stiffness = usual_stiffness, .begins_step = 1, .line_share = 1};
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
  while (total.newton_iterations < max_iterations && !device.stopped()) {
    device.solve();
    StepResult solved = device.result();
    cg_iterations += solved.cg_iterations;
    if (solved.negative_curvature && solved.finite) {
      control.projects_stiffness = 1;
      take_share(0);
      device.solve();
      solved = device.result();
      cg_iterations += solved.cg_iterations;
      control.projects_stiffness = usual_stiffness;
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
    for (int halving = 0; halving < kMaxHalvings && !settled && !device.stopped() && too_long(); ++halving) {
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
