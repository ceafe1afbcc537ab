#pragma once

#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "core/assert.h"
#include "model/loads.h"
#include "solver/time_scheme.h"
#include "view/scene.h"

/// What a step reads of its inputs: tools, prescribed displacements, loads and the length of the step, as stages see
/// them.
namespace tensormass::backend {

/// samples: ContactView::samples
/// tools: [tool_count]
template <class Real>
void write_tools(const model::Model& m, const StepInput& input, const float* samples,
                 physics::PlacedTool<Real>* tools) {
  for (std::size_t i = 0; i < input.tools.size(); ++i) {
    const ToolInput& one = input.tools[i];
    tools[i] = m.tools[i].placed<Real>(one.shape, one.start, one.presence);
    tools[i].samples = samples + m.tools[i].first_sample;
  }
}

/// prescribed: [Model::prescribed, 4]
template <class Real>
void write_prescribed(const model::Model& m, const StepInput& input, Real* prescribed) {
  for (std::size_t i = 0; i < m.prescribed.size(); ++i) {
    const model::Prescribed& one = m.prescribed[i];
    const Vec3<double> now = one.at(input.end_time_s) * (one.schedule.empty() ? input.load_factor : 1);
    for (std::size_t c = 0; c < 3; ++c) prescribed[4 * i + c] = static_cast<Real>(now[static_cast<Eigen::Index>(c)]);
  }
}

/// Says whether gravity, loads or pressure of a scene ever change: they have schedules, or grow in the first step.
inline bool loads_change(const model::Model& m) { return m.quasi_static() || !m.scheduled.schedules.empty(); }

/// Follows the factors of gravity, loads and pressure from step to step.
class LoadFactors {
 public:
  /// No step has taken the factors of schedules yet, so the first step writes them.
  explicit LoadFactors(const model::Model& m)
      : factors_(m.scheduled.schedules.size(), std::numeric_limits<double>::quiet_NaN()) {}

  /// Takes the factors of a step. If one has changed, writes gravity, loads and pressure, and returns true.
  ///
  ///   external, faces   host memory of [row_count, 4] and [PressureSurface::faces]
  template <class Real>
  bool write(const model::Model& m, const StepInput& input, Real* external, view::PressureFace<Real>* faces) {
    bool changed = stale_ || input.load_factor != load_factor_;
    stale_ = false;
    load_factor_ = input.load_factor;
    for (std::size_t i = 0; i < factors_.size(); ++i) {
      const double now = m.scheduled.schedules[i].at(input.loads_time_s);
      changed = changed || now != factors_[i];
      factors_[i] = now;
    }
    if (!changed) return false;
    TM_ASSERT(loads_change(m), "only loads of such a scene change, and only it has memory to write them");
    model::write_external(m, load_factor_, factors_, external);
    model::write_pressure(m, load_factor_, factors_, faces);
    return true;
  }

  /// Call after an edit of gravity or pressure: the next step writes them again, if they change with time.
  void forget(const model::Model& m) { stale_ = loads_change(m); }

 private:
  bool stale_ = false;
  double load_factor_ = 1;
  std::vector<double> factors_;  // [schedule] of the last step
};

/// State of the step sequence, besides the fields of the rows.
struct StepRecord {
  double dt_s = 0;                   ///< length of the last step; 0: there was none
  double internal_dt_s = 0;          ///< RowState::internal_dt_s
  double largest_force_squared = 0;  ///< see solver::newton_step
  std::uint32_t solution = 0;        ///< index of the last step's solution in SolveView::kept
};

/// Returns the inputs of a step for the device, without next_solution. BDF2 starts anew where the last two steps differ
/// in length.
template <class Real>
view::StepControl<Real> control_of(const model::Model& m, const StepInput& input, const StepRecord& past) {
  const bool starts = input.first_order || past.dt_s != input.dt_s;
  const solver::Integrator integrator = input.by_euler ? solver::Integrator::kImplicitEuler : m.integrator;
  const view::StepScheme<double> scheme = solver::step_scheme(integrator, input.dt_s, starts);
  view::StepControl<Real> out;
  out.scheme.step_s = static_cast<Real>(scheme.step_s);
  out.scheme.reach = static_cast<Real>(scheme.reach);
  for (int i = 0; i < 2; ++i) {
    out.scheme.displacement_weights[i] = static_cast<Real>(scheme.displacement_weights[i]);
    out.scheme.velocity_weights[i] = static_cast<Real>(scheme.velocity_weights[i]);
  }
  out.dt_s = static_cast<Real>(input.dt_s);
  out.internal_dt_s = static_cast<Real>(past.internal_dt_s);
  out.cg_max_iterations = input.cg_max_iterations;
  out.saves_checkpoint = input.saves_checkpoint ? 1 : 0;
  out.projects_stiffness = input.projects_stiffness ? 1 : 0;
  out.starts_from_last = !starts && !m.iterates() ? 1 : 0;
  out.last_solution = past.solution;
  return out;
}

}  // namespace tensormass::backend
