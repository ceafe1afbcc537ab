#pragma once

#include "view/patches.h"

/// The state of the rows, and how a step moves it. Every time scheme has the form
///
///   u' = û + h v'
///   M (v' − v̂) / h = forces
///
///   u, v    displacement [m] and velocity [m/s] now
///   u', v'  the same at the end of the step
///   û, v̂    base displacement and base velocity: weighted sums of the last two steps' ends
///   h       effective step [s]; dt for implicit Euler, 2 dt / 3 for BDF2, 1 for equilibrium
///   M       mass
///
/// Implicit Euler has û = u and v̂ = v. Linearized once, and without prescribed displacements, it needs no base fields.
///
/// The implicit midpoint rule solves for the middle of the step, with h = dt / 2, and continues along the line from the
/// start through the middle to the end: u' = û + 2 (u_mid − û), v' = v̂ + 2 (v_mid − v̂). Its `reach` is 2, that of the
/// others is 1.
namespace tensormass::view {

template <class Real>
struct StepScheme {
  Real step_s;                   // h
  Real reach;                    // length of the step over the length that the system solves for
  Real displacement_weights[2];  // û = Σ weight · u of the last two steps' ends, the newer one first
  Real velocity_weights[2];      // v̂ likewise
};

/// Inputs of the coming step from the host. They may change from one step to the next.
template <class Real>
struct StepControl {
  StepScheme<Real> scheme;
  Real dt_s;           // length of the step
  Real internal_dt_s;  // time by which viscoelastic internal variables lag behind; 0: they are up to date
  std::uint32_t cg_max_iterations;
  std::uint32_t saves_checkpoint;    // 1: save the state before the step, for a guard that takes the step back
  std::uint32_t projects_stiffness;  // 1: a step that is linearized once projects the stiffness to positive definite
  std::uint32_t starts_from_last;    // 1: the solve searches along the last step's solution first
  std::uint32_t last_solution;       // index into SolveView::kept, 0 or 1: the last step's solution
  std::uint32_t next_solution;       // the same: this step writes its solution there; may equal last_solution
  std::uint32_t refresh_turn;        // turn of the step among those of lagged tangents (matrix/lagged_tangents.h)
  std::uint32_t refreshes_all;       // 1: every element is evaluated, because nothing that is kept fits
};

/// Fields of rows, [row_count, 4] each, for stages that read them.
template <class Real>
struct StateView {
  const StepControl<Real>* control;  // [1]
  Real size_m;                       // diagonal of the box around the scene at rest
  std::uint32_t iterates;            // 1: forces are evaluated again after each solve (solver/newton.h)

  const Real* rest;  // X [m]; 4th: bits of the free directions, 7 for a free row, 0 for a fixed or padding row
  const Real* displacement;
  const Real* velocity;
  const Real* inertia;   // mass [kg], Rayleigh α [1/s], Rayleigh β [s], body weight s of solver/jacobi_scaling.h
  const Real* external;  // constant force [N]; nullptr: the scene has neither gravity nor loads

  const Real* base_displacement;      // û; nullptr: the displacement itself
  const Real* base_velocity;          // v̂; nullptr: the velocity itself
  const Real* previous_displacement;  // at the end of the step before the last; nullptr: the scheme does not use it
  const Real* previous_velocity;
};

/// The same fields for stages that move them. A stage that takes a StateView cannot write.
template <class Real>
struct StateWriter : StateView<Real> {
  Real* displacement;
  Real* velocity;
  Real* base_displacement;
  Real* base_velocity;
  Real* previous_displacement;
  Real* previous_velocity;

  /// Lets readers see the fields that this writes. Call it once the pointers are set.
  void show_to_readers() {
    StateView<Real>& shown = *this;
    shown.displacement = displacement;
    shown.velocity = velocity;
    shown.base_displacement = base_displacement;
    shown.base_velocity = base_velocity;
    shown.previous_displacement = previous_displacement;
    shown.previous_velocity = previous_velocity;
  }
};

/// h of the step [s].
template <class Real>
TM_HOST_DEVICE Real step_size(const StateView<Real>& state) {
  return state.control->scheme.step_s;
}

/// d = û + h v − u of a row [m], where v is `velocity` as it is stored: how far the row moves from `displacement`, at
/// which forces are evaluated.
template <class Real>
TM_HOST_DEVICE Vec3<Real> change_ahead(const StateView<Real>& state, std::size_t row) {
  const Vec3<Real> ahead = load3<Real>(state.velocity, row) * step_size(state);
  if (state.base_displacement == nullptr) return ahead;
  return load3<Real>(state.base_displacement, row) + ahead - load3<Real>(state.displacement, row);
}

/// How far a row moves in the step [m]: û + h v − u₀ with u₀ at its start, where v is `velocity` as it is stored.
template <class Real>
TM_HOST_DEVICE Vec3<Real> motion_in_step(const StateView<Real>& state, std::size_t row) {
  const Vec3<Real> motion = load3<Real>(state.velocity, row) * step_size(state);
  if (state.previous_displacement == nullptr) return motion;  // û = u₀
  // solver::predict has put u₀ there.
  return motion + load3<Real>(state.base_displacement, row) - load3<Real>(state.previous_displacement, row);
}

/// How far a row has moved by the end of the solve since forces were evaluated [m]. Newton's method evaluates them once
/// more after its last solve, other schemes at the start of the step only.
template <class Real>
TM_HOST_DEVICE Vec3<Real> change_made(const StateView<Real>& state, std::size_t row) {
  return state.iterates != 0 ? Vec3<Real>(Vec3<Real>::Zero()) : motion_in_step(state, row);
}

/// How far a row moves from the time for which the system solves to the end of the step [m]: not at all, but for the
/// midpoint rule. Contact is that of the end of the step in every scheme, as in implicit Euler: it takes out energy and
/// never adds any.
template <class Real>
TM_HOST_DEVICE Vec3<Real> beyond(const StateView<Real>& state, std::size_t row) {
  const Real reach = state.control->scheme.reach;
  return reach == 1 ? Vec3<Real>(Vec3<Real>::Zero()) : Vec3<Real>(motion_in_step(state, row) * (reach - 1));
}

/// change_ahead, change_made and motion_in_step up to the end of the step.
template <class Real>
TM_HOST_DEVICE Vec3<Real> change_ahead_to_end(const StateView<Real>& state, std::size_t row) {
  return change_ahead(state, row) + beyond(state, row);
}
template <class Real>
TM_HOST_DEVICE Vec3<Real> change_made_to_end(const StateView<Real>& state, std::size_t row) {
  return change_made(state, row) + beyond(state, row);
}
template <class Real>
TM_HOST_DEVICE Vec3<Real> motion_to_end(const StateView<Real>& state, std::size_t row) {
  return motion_in_step(state, row) + beyond(state, row);
}

/// Derivative of a motion up to the end of the step by `velocity` [s], times h: a contact of stiffness k adds k times
/// it to the system.
template <class Real>
TM_HOST_DEVICE Real contact_factor(const StateView<Real>& state) {
  return step_size(state) * step_size(state) * state.control->scheme.reach;
}

/// Bits of the directions in which a row is free.
template <class Real>
TM_HOST_DEVICE std::uint32_t free_bits(const StateView<Real>& state, std::size_t row) {
  return static_cast<std::uint32_t>(state.rest[4 * row + 3]);
}

/// Current position of a row [m].
template <class Real>
TM_HOST_DEVICE Vec3<Real> position(const StateView<Real>& state, std::size_t row) {
  return load3<Real>(state.rest, row) + load3<Real>(state.displacement, row);
}

}  // namespace tensormass::view
