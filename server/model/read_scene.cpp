#include <algorithm>
#include <limits>
#include <optional>

#include <fmt/format.h>

#include "core/limits.h"
#include "model/compile_parts.h"
#include "model/scene_input.h"
#include "tensormass/v1/scene.pb.h"

/// Reads what a scene says as a whole: its name, stepping, solver, streams and gravity. Defaults are those of the
/// protocol.
namespace tensormass::model {

namespace {

/// Newton iterations of a quasi-static step, unless the scene says how many. A press by a box takes 11 to 106.
constexpr std::uint32_t kEquilibriumIterations = 200;

Result<void> read_integrator(const v1::Solver& solver, Model& model) {
  switch (solver.integrator()) {
    case v1::Solver::INTEGRATOR_UNSPECIFIED:
    case v1::Solver::INTEGRATOR_IMPLICIT_EULER:
      model.integrator = Integrator::kImplicitEuler;
      break;
    case v1::Solver::INTEGRATOR_BDF2:
      model.integrator = Integrator::kBdf2;
      break;
    case v1::Solver::INTEGRATOR_QUASI_STATIC:
      model.integrator = Integrator::kQuasiStatic;
      break;
    case v1::Solver::INTEGRATOR_IMPLICIT_MIDPOINT:
      model.integrator = Integrator::kImplicitMidpoint;
      break;
    default:
      return invalid(fmt::format("scene.solver.integrator: {} is unknown", static_cast<int>(solver.integrator())));
  }
  const std::uint32_t otherwise = model.quasi_static() ? kEquilibriumIterations : 1;
  TM_ASSIGN_OR_RETURN(iterations,
                      read_number(solver.has_newton_max_iterations() ? solver.newton_max_iterations() : otherwise, 1,
                                  limits::kMaxNewtonIterations, "scene.solver.newton_max_iterations"));
  model.newton_max_iterations = static_cast<std::uint32_t>(iterations);
  TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_newton_tolerance() ? solver.newton_tolerance()
                                             : model.double_precision      ? 1e-6
                                                                           : 1e-3,
                                             0, 0.5, "scene.solver.newton_tolerance"));
  model.newton_tolerance = tolerance;
  model.allow_unconverged = solver.allow_unconverged();
  if (model.allow_unconverged && !model.quasi_static()) {
    return invalid("scene.solver.allow_unconverged: only a quasi-static step must converge; leave it out");
  }
  return {};
}

/// Reads the time that a step may take, and how far its accuracy may fall for that. Accuracy is given up only down to a
/// floor that the scene states.
Result<void> read_budget(const v1::Solver& solver, Model& model) {
  if (solver.has_floor_tolerance()) {
    TM_ASSIGN_OR_RETURN(floor, read_number(solver.floor_tolerance(), 1e-12, 0.5, "scene.solver.floor_tolerance"));
    if (floor < model.cg_tolerance) {
      return invalid(
          fmt::format("scene.solver.floor_tolerance: {} is below cg_tolerance = {}, at which the solve "
                      "stops; lower cg_tolerance",
                      floor, model.cg_tolerance));
    }
    model.floor_tolerance = floor;
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
  TM_ASSIGN_OR_RETURN(floor, read_number(fewest, 1, model.cg_max_iterations, "scene.solver.floor_cg_iterations"));
  model.budget_s = budget;
  model.floor_cg_iterations = static_cast<std::uint32_t>(floor);
  return {};
}

/// Reads the bounds that the scene sets for the guard (world/guard.h).
Result<void> read_guard(const v1::Guard& guard, Model& model) {
  const auto read = [](bool has, double value, std::optional<double>& to, const char* name) -> Result<void> {
    if (!has) return {};
    TM_ASSIGN_OR_RETURN(bound, read_number(value, 0, std::numeric_limits<double>::max(), name));
    to = bound;
    return {};
  };
  TM_RETURN_IF_ERROR(read(guard.has_max_move_m(), guard.max_move_m(), model.max_move_m, "scene.guard.max_move_m"));
  TM_RETURN_IF_ERROR(
      read(guard.has_max_distance_m(), guard.max_distance_m(), model.max_distance_m, "scene.guard.max_distance_m"));
  return read(guard.has_max_energy_ratio(), guard.max_energy_ratio(), model.max_energy_ratio,
              "scene.guard.max_energy_ratio");
}

/// Reads what the scene does after a fault. Call it after the integrator is known.
Result<void> read_on_fault(const v1::Scene& scene, Model& model) {
  const auto& tools = scene.tools();
  switch (scene.guard().on_fault()) {
    case v1::Guard::ON_FAULT_UNSPECIFIED:
      model.goes_on = !model.quasi_static() &&
                      std::any_of(tools.begin(), tools.end(), [](const v1::Tool& tool) { return !tool.fixed(); });
      return {};
    case v1::Guard::ON_FAULT_GO_ON:
      if (model.quasi_static()) {
        return invalid("scene.guard.on_fault: an equilibrium always stops; leave it out, or take ON_FAULT_STOP");
      }
      model.goes_on = true;
      return {};
    case v1::Guard::ON_FAULT_STOP:
      return {};
    default:
      return invalid(fmt::format("scene.guard.on_fault: {} is unknown", static_cast<int>(scene.guard().on_fault())));
  }
}

Result<void> read_solver(const v1::Solver& solver, Model& model) {
  switch (solver.precision()) {
    case v1::Solver::PRECISION_UNSPECIFIED:
    case v1::Solver::PRECISION_FLOAT:
      break;
    case v1::Solver::PRECISION_DOUBLE:
      model.double_precision = true;
      break;
    default:
      return invalid(fmt::format("scene.solver.precision: {} is unknown", static_cast<int>(solver.precision())));
  }
  TM_RETURN_IF_ERROR(read_integrator(solver, model));
  // Without inertia the matrix is far worse conditioned: more iterations are needed, and a residual leaves a larger
  // error. Such scenes do not run in real time.
  const bool quasi_static = model.quasi_static();
  TM_ASSIGN_OR_RETURN(iterations, read_number(solver.has_cg_max_iterations() ? solver.cg_max_iterations()
                                              : quasi_static                 ? 10'000
                                                                             : 100,
                                              1, limits::kMaxCgIterations, "scene.solver.cg_max_iterations"));
  model.cg_max_iterations = static_cast<std::uint32_t>(iterations);
  TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_cg_tolerance() ? solver.cg_tolerance()
                                             : quasi_static            ? 1e-5
                                                                       : 1e-3,
                                             0, 0.5, "scene.solver.cg_tolerance"));
  model.cg_tolerance = tolerance;
  TM_RETURN_IF_ERROR(read_budget(solver, model));
  if (solver.has_cpu_threads()) {
    TM_RETURN_IF_ERROR(read_number(solver.cpu_threads(), 1, limits::kMaxCpuThreads, "scene.solver.cpu_threads"));
  }
  return {};
}

}  // namespace

Result<void> read_header(Compilation& c) {
  Model& model = c.model;
  TM_RETURN_IF_ERROR(check_name(c.scene.name(), "scene.name"));
  model.name = c.scene.name();
  const v1::Stepping& stepping = c.scene.stepping();
  TM_ASSIGN_OR_RETURN(dt, read_number(stepping.has_dt_s() ? stepping.dt_s() : 1.0 / 60, limits::kMinTimeStepS,
                                      limits::kMaxTimeStepS, "scene.stepping.dt_s"));
  model.dt_s = dt;
  TM_ASSIGN_OR_RETURN(rate,
                      read_number(stepping.has_rate_hz() ? stepping.rate_hz() : std::min(1 / dt, limits::kMaxRateHz),
                                  limits::kMinRateHz, limits::kMaxRateHz, "scene.stepping.rate_hz"));
  model.rate_hz = rate;
  model.lockstep = stepping.lockstep();

  TM_RETURN_IF_ERROR(read_solver(c.scene.solver(), model));
  TM_RETURN_IF_ERROR(read_guard(c.scene.guard(), model));
  TM_RETURN_IF_ERROR(read_on_fault(c.scene, model));

  const v1::Streams& streams = c.scene.streams();
  TM_ASSIGN_OR_RETURN(
      frames, read_rate(streams.has_frame_rate_hz() ? streams.frame_rate_hz() : 60, "scene.streams.frame_rate_hz"));
  model.frame_rate_hz = frames;
  TM_ASSIGN_OR_RETURN(
      status, read_rate(streams.has_status_rate_hz() ? streams.status_rate_hz() : 4, "scene.streams.status_rate_hz"));
  model.status_rate_hz = status;

  TM_ASSIGN_OR_RETURN(gravity, read_vector(c.scene.gravity_m_per_s2(), "scene.gravity_m_per_s2"));
  model.gravity_m_per_s2 = gravity;
  model.has_gravity = gravity.squaredNorm() > 0;
  if (c.scene.has_gravity_schedule() && !c.scene.has_gravity_m_per_s2()) {
    return invalid(
        "scene.gravity_schedule: the scene has no gravity; give gravity_m_per_s2, or leave the schedule out");
  }
  TM_ASSIGN_OR_RETURN(schedule, read_schedule(c.scene.gravity_schedule(), "scene.gravity_schedule"));
  model.gravity_schedule = std::move(schedule);
  return {};
}

}  // namespace tensormass::model
