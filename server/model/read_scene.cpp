#include <algorithm>
#include <limits>
#include <optional>

#include <fmt/format.h>

#include "core/limits.h"
#include "model/read_parts.h"
#include "model/scene_input.h"
#include "tensormass/v1/scene.pb.h"

/// Reads what a scene says as a whole: its name, stepping, solver, streams and gravity. Defaults are those of the
/// protocol.
namespace tensormass::model {

namespace {

/// Newton iterations of a quasi-static step, unless the scene says how many. A press by a box takes 11 to 106.
constexpr std::uint32_t kEquilibriumIterations = 200;

/// Change of F that ends a lagged tangent, unless the scene gives it.
constexpr double kLagStrain = 0.02;

Result<void> read_integrator(const v1::Solver& solver, Settings& out) {
  switch (solver.integrator()) {
    case v1::Solver::INTEGRATOR_UNSPECIFIED:
    case v1::Solver::INTEGRATOR_IMPLICIT_EULER:
      out.integrator = Integrator::kImplicitEuler;
      break;
    case v1::Solver::INTEGRATOR_BDF2:
      out.integrator = Integrator::kBdf2;
      break;
    case v1::Solver::INTEGRATOR_QUASI_STATIC:
      out.integrator = Integrator::kQuasiStatic;
      break;
    case v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT:
      out.integrator = Integrator::kImplicitMidpoint;
      break;
    default:
      return invalid(fmt::format("scene.solver.integrator: {} is unknown", static_cast<int>(solver.integrator())));
  }
  const std::uint32_t otherwise = out.quasi_static() ? kEquilibriumIterations : 1;
  TM_ASSIGN_OR_RETURN(iterations,
                      read_number(solver.has_newton_max_iterations() ? solver.newton_max_iterations() : otherwise, 1,
                                  limits::kMaxNewtonIterations, "scene.solver.newton_max_iterations"));
  out.newton_max_iterations = static_cast<std::uint32_t>(iterations);
  TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_newton_tolerance() ? solver.newton_tolerance()
                                             : out.double_precision        ? 1e-6
                                                                           : 1e-3,
                                             0, 0.5, "scene.solver.newton_tolerance"));
  out.newton_tolerance = tolerance;
  out.allow_unconverged = solver.allow_unconverged();
  if (out.allow_unconverged && !out.quasi_static()) {
    return invalid("scene.solver.allow_unconverged: only a quasi-static step must converge; leave it out");
  }
  return {};
}

/// Reads the time that a step may take, and how far its accuracy may fall for that. Accuracy is given up only down to a
/// floor that the scene states.
Result<void> read_budget(const v1::Solver& solver, Settings& out) {
  if (solver.has_floor_tolerance()) {
    TM_ASSIGN_OR_RETURN(floor, read_number(solver.floor_tolerance(), 1e-12, 0.5, "scene.solver.floor_tolerance"));
    if (floor < out.cg_tolerance) {
      return invalid(
          fmt::format("scene.solver.floor_tolerance: {} is below cg_tolerance = {}, at which the solve "
                      "stops; lower cg_tolerance",
                      floor, out.cg_tolerance));
    }
    out.floor_tolerance = floor;
  }
  if (!solver.has_budget_s()) {
    if (!solver.has_floor_cg_iterations()) return {};
    return invalid("scene.solver.floor_cg_iterations: nothing lowers the iterations; give budget_s too");
  }
  TM_ASSIGN_OR_RETURN(
      budget, read_number(solver.budget_s(), limits::kMinBudgetS, limits::kMaxBudgetS, "scene.solver.budget_s"));
  if (!solver.has_floor_cg_iterations() && !solver.has_floor_tolerance()) {
    return invalid(
        "scene.solver.budget_s: say how far accuracy may go down for it: give floor_cg_iterations, floor_tolerance "
        "or both");
  }
  const double fewest = solver.has_floor_cg_iterations() ? solver.floor_cg_iterations() : 1;
  TM_ASSIGN_OR_RETURN(floor, read_number(fewest, 1, out.cg_max_iterations, "scene.solver.floor_cg_iterations"));
  out.budget_s = budget;
  out.floor_cg_iterations = static_cast<std::uint32_t>(floor);
  return {};
}

/// Reads the bounds that the scene sets for the guard (world/guard.h).
Result<void> read_guard(const v1::Guard& guard, Settings& out) {
  const auto read = [](bool has, double value, std::optional<double>& to, const char* name) -> Result<void> {
    if (!has) return {};
    TM_ASSIGN_OR_RETURN(bound, read_number(value, 0, std::numeric_limits<double>::max(), name));
    to = bound;
    return {};
  };
  TM_RETURN_IF_ERROR(read(guard.has_max_move_m(), guard.max_move_m(), out.max_move_m, "scene.guard.max_move_m"));
  TM_RETURN_IF_ERROR(
      read(guard.has_max_distance_m(), guard.max_distance_m(), out.max_distance_m, "scene.guard.max_distance_m"));
  return read(guard.has_max_energy_ratio(), guard.max_energy_ratio(), out.max_energy_ratio,
              "scene.guard.max_energy_ratio");
}

/// Reads what the scene does after a fault. Call it after the integrator is known.
Result<void> read_on_fault(const v1::Scene& scene, Settings& out) {
  const auto& tools = scene.tools();
  switch (scene.guard().on_fault()) {
    case v1::Guard::ON_FAULT_UNSPECIFIED:
      out.goes_on = !out.quasi_static() &&
                    std::any_of(tools.begin(), tools.end(), [](const v1::Tool& tool) { return !tool.fixed(); });
      return {};
    case v1::Guard::ON_FAULT_GO_ON:
      if (out.quasi_static()) {
        return invalid("scene.guard.on_fault: an equilibrium always stops; leave it out, or take ON_FAULT_STOP");
      }
      out.goes_on = true;
      return {};
    case v1::Guard::ON_FAULT_STOP:
      return {};
    default:
      return invalid(fmt::format("scene.guard.on_fault: {} is unknown", static_cast<int>(scene.guard().on_fault())));
  }
}

/// Reads lagged tangents. Needs the integrator and Newton's method.
Result<void> read_lag(const v1::Solver& solver, Settings& out) {
  if (!solver.has_tangent_lag_steps()) {
    if (!solver.has_tangent_lag_strain()) return {};
    return invalid("scene.solver.tangent_lag_strain: it says when a lagged tangent ends; give tangent_lag_steps too");
  }
  TM_ASSIGN_OR_RETURN(
      steps, read_number(solver.tangent_lag_steps(), 1, limits::kMaxTangentLagSteps, "scene.solver.tangent_lag_steps"));
  if (steps > 1 && out.iterates()) {
    return invalid(
        "scene.solver.tangent_lag_steps: Newton's method needs the forces of each iterate; leave it out, or "
        "take newton_max_iterations: 1");
  }
  TM_ASSIGN_OR_RETURN(strain, read_number(solver.has_tangent_lag_strain() ? solver.tangent_lag_strain() : kLagStrain,
                                          1e-6, 1, "scene.solver.tangent_lag_strain"));
  out.lag_steps = static_cast<std::uint32_t>(steps);
  out.lag_strain = strain;
  return {};
}

Result<void> read_solver(const v1::Solver& solver, Settings& out) {
  switch (solver.precision()) {
    case v1::Solver::PRECISION_UNSPECIFIED:
    case v1::Solver::PRECISION_FLOAT:
      break;
    case v1::Solver::PRECISION_DOUBLE:
      out.double_precision = true;
      break;
    default:
      return invalid(fmt::format("scene.solver.precision: {} is unknown", static_cast<int>(solver.precision())));
  }
  TM_RETURN_IF_ERROR(read_integrator(solver, out));
  // Without inertia the matrix is far worse conditioned: more iterations are needed, and a residual leaves a larger
  // error. Such scenes do not run in real time.
  const bool quasi_static = out.quasi_static();
  TM_ASSIGN_OR_RETURN(iterations, read_number(solver.has_cg_max_iterations() ? solver.cg_max_iterations()
                                              : quasi_static                 ? 10'000
                                                                             : 100,
                                              1, limits::kMaxCgIterations, "scene.solver.cg_max_iterations"));
  out.cg_max_iterations = static_cast<std::uint32_t>(iterations);
  TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_cg_tolerance() ? solver.cg_tolerance()
                                             : quasi_static            ? 1e-5
                                                                       : 1e-3,
                                             0, 0.5, "scene.solver.cg_tolerance"));
  out.cg_tolerance = tolerance;
  if (solver.has_coarse_level()) out.coarse_use = solver.coarse_level() ? CoarseUse::kAlways : CoarseUse::kNever;
  TM_RETURN_IF_ERROR(read_lag(solver, out));
  TM_RETURN_IF_ERROR(read_budget(solver, out));
  if (solver.has_cpu_threads()) {
    TM_RETURN_IF_ERROR(read_number(solver.cpu_threads(), 1, limits::kMaxCpuThreads, "scene.solver.cpu_threads"));
  }
  return {};
}

Result<void> read_editing(const v1::Editing& editing, Settings& out) {
  Editing& room = out.editing.emplace();
  const auto read = [&](bool has, std::uint32_t value, const char* name,
                        std::optional<std::uint32_t>& to) -> Result<void> {
    if (!has) return {};
    TM_RETURN_IF_ERROR(read_number(value, 0, limits::kMaxNewSurface, std::string("scene.editing.") + name));
    to = value;
    return {};
  };
  TM_RETURN_IF_ERROR(
      read(editing.has_max_new_triangles(), editing.max_new_triangles(), "max_new_triangles", room.max_new_triangles));
  return read(editing.has_max_new_vertices(), editing.max_new_vertices(), "max_new_vertices", room.max_new_vertices);
}

}  // namespace

Result<Settings> read_settings(const v1::Scene& scene) {
  Settings out;
  TM_RETURN_IF_ERROR(check_name(scene.name(), "scene.name"));
  out.name = scene.name();
  const v1::Stepping& stepping = scene.stepping();
  TM_ASSIGN_OR_RETURN(dt, read_number(stepping.has_dt_s() ? stepping.dt_s() : 1.0 / 60, limits::kMinTimeStepS,
                                      limits::kMaxTimeStepS, "scene.stepping.dt_s"));
  out.dt_s = dt;
  TM_ASSIGN_OR_RETURN(rate,
                      read_number(stepping.has_rate_hz() ? stepping.rate_hz() : std::min(1 / dt, limits::kMaxRateHz),
                                  limits::kMinRateHz, limits::kMaxRateHz, "scene.stepping.rate_hz"));
  out.rate_hz = rate;
  out.lockstep = stepping.lockstep();

  TM_RETURN_IF_ERROR(read_solver(scene.solver(), out));
  TM_RETURN_IF_ERROR(read_guard(scene.guard(), out));
  TM_RETURN_IF_ERROR(read_on_fault(scene, out));

  const v1::Streams& streams = scene.streams();
  TM_ASSIGN_OR_RETURN(
      frames, read_rate(streams.has_frame_rate_hz() ? streams.frame_rate_hz() : 60, "scene.streams.frame_rate_hz"));
  out.frame_rate_hz = frames;
  TM_ASSIGN_OR_RETURN(
      status, read_rate(streams.has_status_rate_hz() ? streams.status_rate_hz() : 4, "scene.streams.status_rate_hz"));
  out.status_rate_hz = status;

  TM_ASSIGN_OR_RETURN(gravity, read_vector(scene.gravity_m_per_s2(), "scene.gravity_m_per_s2"));
  out.gravity_m_per_s2 = gravity;
  out.has_gravity = scene.has_gravity_m_per_s2();
  if (scene.has_gravity_schedule() && !scene.has_gravity_m_per_s2()) {
    return invalid(
        "scene.gravity_schedule: the scene has no gravity; give gravity_m_per_s2, or leave the schedule out");
  }
  TM_ASSIGN_OR_RETURN(schedule, read_schedule(scene.gravity_schedule(), "scene.gravity_schedule"));
  out.gravity_schedule = std::move(schedule);
  if (scene.has_editing()) TM_RETURN_IF_ERROR(read_editing(scene.editing(), out));
  for (const v1::Tool& tool : scene.tools()) {
    if (tool.has_cautery() && scene.editing().has_cutting()) {
      return invalid(fmt::format(
          "tool '{}'.cautery: a scene with editing.cutting cannot burn yet; leave one of the two out", tool.name()));
    }
    if (!tool.has_cautery() || scene.has_editing()) continue;
    return invalid(
        fmt::format("tool '{}'.cautery: the scene has no room for what it burns away; give it scene.editing, "
                    "an empty message is enough",
                    tool.name()));
  }
  return out;
}

}  // namespace tensormass::model
