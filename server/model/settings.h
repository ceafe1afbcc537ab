#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "core/scalar.h"
#include "model/schedule.h"
#include "solver/time_scheme.h"

namespace tensormass::model {

using solver::Integrator;

/// Room for the surface that ablation brings to light (v1::Editing); absent: half of the surface, and more.
struct Editing {
  std::optional<std::uint32_t> max_new_triangles, max_new_vertices;
};

/// Whether linear solves have a coarse level (v1::Solver.coarse_level).
/// kAutomatic: once a solve has taken long (backend::CoarsePrice), more than kCoarseFromIterations at least.
enum class CoarseUse : std::uint8_t { kAutomatic, kNever, kAlways };

/// No solve of fewer gets a coarse level by itself: it leaves 20 to 45 of them.
inline constexpr std::uint32_t kCoarseFromIterations = 80;

/// What a scene says as a whole. Constant as long as the scene is loaded, whatever happens to its bodies.
struct Settings {
  std::string name;
  bool double_precision = false;
  bool lockstep = false;
  double dt_s = 0;
  double rate_hz = 0;
  double frame_rate_hz = 0;
  double status_rate_hz = 0;
  Integrator integrator = Integrator::kImplicitEuler;
  std::uint32_t newton_max_iterations = 1;
  double newton_tolerance = 0;
  bool allow_unconverged = false;  ///< keep a quasi-static step above newton_tolerance
  double cg_tolerance = 0;
  double budget_s = 0;                    ///< time that a step may take; 0: no limit
  std::uint32_t floor_cg_iterations = 0;  ///< the budget may lower cg_max_iterations to this
  double floor_tolerance = 0;             ///< steps with a larger residual are not published; 0: no limit
  std::uint32_t cg_max_iterations = 0;
  CoarseUse coarse_use = CoarseUse::kAutomatic;
  /// Lagged tangents (matrix/lagged_tangents.h): steps from one evaluation of an element to the next; 1: each step.
  std::uint32_t lag_steps = 1;
  double lag_strain = 0;  ///< change of F that has an element evaluated at once
  /// Bounds that the scene sets for the guard; absent: world/guard.h has defaults.
  std::optional<double> max_move_m, max_distance_m, max_energy_ratio;
  bool goes_on = false;  ///< v1::Guard::ON_FAULT_GO_ON
  Vec3<double> gravity_m_per_s2 = Vec3<double>::Zero();
  bool has_gravity = false;  ///< the scene gives it; zero too
  Schedule gravity_schedule;
  std::optional<Editing> editing;  ///< absent: the scene never changes

  /// Returns whether a step runs Newton's method: more than one linear solve.
  bool iterates() const { return newton_max_iterations > 1; }
  /// Returns whether each step is an equilibrium, without inertia.
  bool quasi_static() const { return integrator == Integrator::kQuasiStatic; }
  /// Returns whether elements follow their last tangents where their law allows it.
  bool asks_for_lag() const { return lag_steps > 1; }
  /// Returns whether a step solves for its middle and continues to its end.
  bool extrapolates() const { return integrator == Integrator::kImplicitMidpoint; }
};

}  // namespace tensormass::model
