#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>

#include "solver/missing_energy.h"
#include "view/balance.h"
#include "view/guard.h"
#include "view/links.h"
#include "view/newton.h"
#include "view/solve.h"

/// The host's result of a step, reduced from the reports of the patches. This last, short reduction runs in the order
/// of the patches, so that it repeats bitwise.
namespace tensormass::solver {

/// Change of contact forces in a step, as a share of them, after which BDF2 starts anew.
inline constexpr double kContactJump = 0.1;

struct StepResult {
  std::uint32_t cg_iterations = 0;  ///< sum over all solves of the step
  double cg_relative_residual = 0;  ///< after the last solve
  double missing_energy_j = 0;      ///< missing_energy.h, of the last solve
  bool negative_curvature = false;
  bool finite = true;
  bool bodies_jumped = false;  ///< forces between bodies changed by more than kContactJump of them
  double max_speed_m_per_s = 0;
  double max_move_m = 0;        ///< largest move of a node from the checkpoint
  double max_distance_m = 0;    ///< largest distance of a node from rest
  double kinetic_energy_j = 0;  ///< sum over the nodes
  double work_j = 0;            ///< work of gravity and loads since the checkpoint
  /// Smallest det F of the inverted elements, among those that each step checks. 1 if the scene checks none; infinity
  /// if it does and no element is inverted.
  double min_det_f = 1;
  std::uint32_t newton_iterations = 1;
  double newton_residual = 0;        ///< relative to the acting forces; 0 in a step that is linearized once
  std::uint32_t touching_nodes = 0;  ///< nodes that touch a body
  double deepest_contact_m = 0;      ///< largest penetration of one body into another
  std::uint32_t broken_springs = 0;  ///< springs of attachments that have broken since the start
  /// Largest share of its impulses by which the momentum of a free body was off before its last correction
  /// (contact/balance.h).
  double momentum_error = 0;
  /// False: Newton's method ended above its tolerance, and its last increment would still have moved a node.
  bool converged = true;

  /// Replaces what was measured of the nodes' motion by that of a later report.
  void take_motion(const StepResult& later) {
    finite = finite && later.finite;
    max_speed_m_per_s = later.max_speed_m_per_s;
    max_move_m = later.max_move_m;
    max_distance_m = later.max_distance_m;
    kinetic_energy_j = later.kinetic_energy_j;
    work_j = later.work_j;
  }
};

/// Adds what the links of all patches did.
template <class Real>
void read_links(std::span<const view::LinkReport<Real>> patches, StepResult& result) {
  double pressed_n = 0, changed_n = 0;
  for (const auto& patch : patches) {
    result.touching_nodes += static_cast<std::uint32_t>(patch.contacts);
    result.deepest_contact_m = std::max(result.deepest_contact_m, static_cast<double>(patch.deepest_m));
    result.broken_springs += static_cast<std::uint32_t>(patch.broken);
    pressed_n += static_cast<double>(patch.pressed_n);
    changed_n += static_cast<double>(patch.changed_n);
  }
  result.bodies_jumped = changed_n > kContactJump * pressed_n;
}

/// Takes the largest error of the free bodies. A body on which nothing acts has none.
template <class Real>
void read_balance(std::span<const view::BalanceReport<Real>> bodies, StepResult& result) {
  for (const auto& body : bodies) {
    if (!(body.impulse_n_s > 0)) continue;
    result.momentum_error =
        std::max(result.momentum_error, static_cast<double>(body.defect_n_s) / static_cast<double>(body.impulse_n_s));
  }
}

/// view::PatchResidual, summed over the patches.
struct NewtonResidual {
  double residual_squared = 0;  ///< [N² s²]
  double force_squared = 0;     ///< [N² s²]
  double slope = 0;             ///< [J] residual · increment; positive: the increment leads downhill
  double moved = 0;             ///< largest motion of a node by the increment, relative to its own coordinates

  bool finite() const { return std::isfinite(residual_squared) && std::isfinite(force_squared); }
};

template <class Real>
NewtonResidual read_residual(std::span<const view::PatchResidual<Real>> patches) {
  NewtonResidual sum;
  for (const auto& patch : patches) {
    sum.residual_squared += static_cast<double>(patch.residual_squared);
    sum.force_squared += static_cast<double>(patch.force_squared);
    sum.slope += static_cast<double>(patch.slope);
    sum.moved = std::max(sum.moved, std::sqrt(static_cast<double>(patch.moved_squared)));
  }
  return sum;
}

/// The result of one solve and of the motion that follows it. min_det_f: only of elements that the solve checks.
/// cg_max_iterations: of the solve.
template <class Real>
StepResult read_step(const view::SolveReport<Real>& solve, std::uint32_t cg_max_iterations,
                     std::span<const view::PatchReport<Real>> patches) {
  StepResult result;
  result.missing_energy_j = missing_energy_j(solve, cg_max_iterations);
  result.cg_iterations = solve.iterations;
  result.cg_relative_residual = static_cast<double>(solve.relative_residual);
  result.negative_curvature = solve.negative_curvature != 0;
  result.finite = std::isfinite(solve.relative_residual);
  result.min_det_f = std::numeric_limits<double>::infinity();
  for (const auto& patch : patches) {
    result.finite = result.finite && patch.finite == 1;
    result.max_speed_m_per_s = std::max(result.max_speed_m_per_s, static_cast<double>(patch.max_speed_m_per_s));
    result.max_move_m = std::max(result.max_move_m, static_cast<double>(patch.max_move_m));
    result.max_distance_m = std::max(result.max_distance_m, static_cast<double>(patch.max_distance_m));
    result.kinetic_energy_j += static_cast<double>(patch.kinetic_energy_j);
    result.work_j += static_cast<double>(patch.work_j);
    result.min_det_f = std::min(result.min_det_f, static_cast<double>(patch.min_det_f));
  }
  return result;
}

}  // namespace tensormass::solver
