#pragma once

#include <cmath>
#include <limits>

#include "solver/jacobi_scaling.h"
#include "view/scene.h"

/// Time schemes: where a step starts from, and how its solution moves the rows.
///
///   predict ───> û, v̂ from the last two steps;  v = v̂
///   prescribe ─> v of rows whose displacement the scene prescribes
///     solve for Δv (conjugate_gradients.h), once or in Newton's iterations (newton.h)
///   advance ───> v += Δv,  u = û + h v,  and the values that guards check
///   extrapolate  from the middle of the step to its end; only for the implicit midpoint rule
///
///   u, v    displacement and velocity        û, v̂, h   base values and effective step (all: view/state.h)
///   Δv      L⁻ᵀ x / s, where x solves the scaled system (jacobi_scaling.h)
///
/// A *plain* scene (model::Model::is_plain) is linearized once by implicit Euler and prescribes no displacements. It
/// has û = u and v̂ = v, so it needs neither base fields nor `predict`. In a plain scene `advance` saves the
/// checkpoint.
namespace tensormass::solver {

enum class Integrator : std::uint8_t { kImplicitEuler, kBdf2, kQuasiStatic, kImplicitMidpoint };

/// Returns the coefficients of a step of dt_s. first: the step before it had another length, or there was none.
inline view::StepScheme<double> step_scheme(Integrator integrator, double dt_s, bool first) {
  switch (integrator) {
    case Integrator::kBdf2:  // (3 y' − 4 y + y₋₁) / (2 dt) = ẏ', solved for y'
      if (first) break;      // implicit Euler once: a single step of order one does not lower the order of the run
      return {2 * dt_s / 3, 1, {4.0 / 3, -1.0 / 3}, {4.0 / 3, -1.0 / 3}};
    case Integrator::kQuasiStatic:  // "velocity" is the change of the displacement in a step
      return {1, 1, {1, 0}, {0, 0}};
    case Integrator::kImplicitMidpoint:  // half a step of implicit Euler, continued to the end of the step
      return {dt_s / 2, 2, {1, 0}, {1, 0}};
    case Integrator::kImplicitEuler:
      break;
  }
  return {dt_s, 1, {1, 0}, {1, 0}};
}

/// Saves the state (u, v) of a row as the checkpoint, if the inputs of the step ask for it.
template <class Real>
TM_HOST_DEVICE void save_checkpoint(const view::StateView<Real>& state, const view::GuardView<Real>& guard,
                                    std::uint32_t row, const Vec3<Real>& u, const Vec3<Real>& v) {
  if (state.control->saves_checkpoint == 0) return;
  view::store3<Real>(guard.checkpoint_displacement, row, u);
  view::store3<Real>(guard.checkpoint_velocity, row, v);
  if (state.previous_displacement == nullptr) return;
  view::store3<Real>(guard.checkpoint_previous_displacement, row, view::load3<Real>(state.previous_displacement, row));
  view::store3<Real>(guard.checkpoint_previous_velocity, row, view::load3<Real>(state.previous_velocity, row));
}

/// Computes û and v̂ from the last two steps, and starts the solve at v = v̂. Only for scenes that are not plain.
/// Reads displacement, velocity, previous fields; writes base and previous fields, velocity, checkpoint.
template <class Team, class Real>
TM_HOST_DEVICE void predict(const Team& team, const view::PatchesView& patches, const view::StateWriter<Real>& state,
                            const view::GuardView<Real>& guard) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> u = view::load3<Real>(state.displacement, row), v = view::load3<Real>(state.velocity, row);
    const view::StepScheme<Real>& scheme = state.control->scheme;
    Vec3<Real> base_u = u * scheme.displacement_weights[0], base_v = v * scheme.velocity_weights[0];
    save_checkpoint(state, guard, row, u, v);
    if (state.previous_displacement != nullptr) {
      base_u += view::load3<Real>(state.previous_displacement, row) * scheme.displacement_weights[1];
      base_v += view::load3<Real>(state.previous_velocity, row) * scheme.velocity_weights[1];
      view::store3<Real>(state.previous_displacement, row, u);
      view::store3<Real>(state.previous_velocity, row, v);
    }
    view::store3<Real>(state.base_displacement, row, base_u);
    view::store3<Real>(state.base_velocity, row, base_v);
    view::store3<Real>(state.velocity, row, base_v);
  });
}

/// Sets the velocities that move prescribed rows to their displacement at the end of the step. With the midpoint rule
/// they are half-way there in the middle.
/// Reads prescribed displacement, û; writes velocity.
template <class Team, class Real>
TM_HOST_DEVICE void prescribe(const Team& team, const view::StateWriter<Real>& state,
                              const view::PrescribedView<Real>& prescribed) {
  const Real* base = state.base_displacement != nullptr ? state.base_displacement : state.displacement;
  team.for_each(prescribed.patch_begin[team.patch()], prescribed.patch_begin[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t* entry = prescribed.rows + std::size_t{3} * i;
    for (std::uint32_t c = 0; c < 3; ++c) {
      if ((entry[2] >> c & 1) == 0) continue;
      const Real target = prescribed.displacement[std::size_t{4} * entry[1] + c];
      state.velocity[std::size_t{4} * entry[0] + c] =
          (target - base[std::size_t{4} * entry[0] + c]) / (view::step_size(state) * state.control->scheme.reach);
    }
  });
}

/// Prefetches what move_rows reads of a row. A solve takes long enough for caches to lose it.
template <class Real>
TM_HOST_DEVICE void prefetch_move(const view::StateView<Real>& state, const view::GuardView<Real>& guard,
                                  std::uint32_t row) {
  const std::size_t at = std::size_t{4} * row;
  expect(state.velocity + at);
  expect((state.base_displacement != nullptr ? state.base_displacement : state.displacement) + at);
  expect(guard.checkpoint_displacement + at);
  expect(state.inertia + at);
  if (state.external != nullptr) expect(state.external + at);
}

/// Largest values and sums over the rows that one thread moved.
template <class Real>
struct Motion {
  Real maxima[3] = {0, 0, 0};  // squares of speed, move from the checkpoint, distance from rest
  Real sums[3] = {0, 0, 0};    // rows with a value that is not a number, twice the kinetic energy, work

  /// Adds a row. v, u: its new velocity and displacement. move: from the checkpoint. external: constant force on it.
  TM_HOST_DEVICE void add(const Vec3<Real>& v, const Vec3<Real>& u, const Vec3<Real>& move, Real mass,
                          const Vec3<Real>& external) {
    maxima[0] = maximum(maxima[0], v.dot(v));
    maxima[1] = maximum(maxima[1], move.dot(move));
    maxima[2] = maximum(maxima[2], u.dot(u));
    if (!(v.dot(v) < Real(1e30) && u.dot(u) < Real(1e30))) sums[0] += 1;
    sums[1] += mass * v.dot(v);
    sums[2] += external.dot(move);
  }
};

/// Reduces the motion of all threads of a patch to its report.
///
///   least_det_f() -> Real   called once by every thread; returns PatchReport::min_det_f to the thread that leads the
///                           patch. The patch's threads must synchronize within it at least once.
template <class Team, class Real, class LeastDetF>
TM_HOST_DEVICE void report(const Team& team, const view::GuardView<Real>& guard, Motion<Real> motion,
                           const LeastDetF& least_det_f) {
  using std::sqrt;
  auto& [maxima, sums] = motion;
  team.begin_reduce(maxima, sums);
  const Real min_det_f = least_det_f();
  if (!team.leads_patch()) return;
  team.end_reduce(maxima, sums);
  guard.patch_reports[team.patch()] = {
      sqrt(maxima[0]), sums[0] == 0 ? Real(1) : Real(0), sqrt(maxima[1]), sqrt(maxima[2]), sums[1] / 2, sums[2],
      min_det_f};
}

/// Reduces the motion likewise, in solves that check no volumes.
template <class Team, class Real>
TM_HOST_DEVICE void report(const Team& team, const view::GuardView<Real>& guard, const Motion<Real>& motion) {
  report(team, guard, motion, [&] {
    team.sync();
    return std::numeric_limits<Real>::infinity();
  });
}

/// Moves the rows of a patch to new velocities v and to u = û + h v.
///
///   read(row) -> T               reads what velocity_of needs; called ahead of it, so that reads overlap
///   velocity_of(row, T) -> v     returns the new velocity
///   moved.read(row) -> M         reads what moved() needs; called ahead of it, as read(row) is
///   moved(row, u, M)             called once the row has its new displacement
///
/// saves: save the row's state (û, read(row)) as the checkpoint before overwriting it. Then û must be the displacement
/// before the step and read(row) the velocity before it.
template <class Team, class Real, class Read, class Velocity, class Moved>
TM_HOST_DEVICE Motion<Real> move_rows(const Team& team, const view::PatchesView& patches,
                                      const view::StateWriter<Real>& state, const view::GuardView<Real>& guard,
                                      bool saves, const Read& read, const Velocity& velocity_of, const Moved& moved) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  const Real* base = state.base_displacement != nullptr ? state.base_displacement : state.displacement;
  const Real h = view::step_size(state);
  Motion<Real> motion;
  struct Before {
    Vec3<Real> of_velocity, base, checkpoint, external;
    Real mass;
    decltype(moved.read(0)) of_moved;
  };
  constexpr int kAtOnce = 2;
  team.template for_each<kAtOnce>(
      patch.row_begin, patch.row_end,
      [&](std::uint32_t row) -> Before {
        return {read(row),
                view::load3<Real>(base, row),
                view::load3<Real>(guard.checkpoint_displacement, row),
                state.external != nullptr ? view::load3<Real>(state.external, row) : Vec3<Real>(Vec3<Real>::Zero()),
                state.inertia[std::size_t{4} * row],
                moved.read(row)};
      },
      [&](std::uint32_t row, const Before& before) {
        const Vec3<Real> v = velocity_of(row, before.of_velocity);
        const Vec3<Real> u = before.base + v * h;
        const Vec3<Real> move = u - (saves ? before.base : before.checkpoint);
        if (saves) save_checkpoint(state, guard, row, before.base, before.of_velocity);
        view::store3<Real>(state.velocity, row, v);
        view::store3<Real>(state.displacement, row, u);
        moved(row, u, before.of_moved);
        motion.add(v, u, move, before.mass, before.external);
      });
  return motion;
}

/// Moves the rows by a change of velocity. For Newton's method it also stores the change and the velocity before it, so
/// that `backtrack` can take a fraction of the change.
///
///   change_of(row) -> Vec3   Δv of the row
///   moved                    as in move_rows
///
/// Reads velocity, displacement or û, checkpoint; writes velocity, displacement, iterate, increment, checkpoint.
template <class Team, class Real, class Change, class Moved>
TM_HOST_DEVICE Motion<Real> advance_by(const Team& team, const view::PatchesView& patches,
                                       const view::StateWriter<Real>& state, const view::NewtonView<Real>& newton,
                                       const view::GuardView<Real>& guard, const Change& change_of,
                                       const Moved& moved) {
  // In a scene with base fields `predict` has already saved the checkpoint.
  const bool saves = state.base_displacement == nullptr && state.control->saves_checkpoint != 0;
  return move_rows(
      team, patches, state, guard, saves, [&](std::uint32_t row) { return view::load3<Real>(state.velocity, row); },
      [&](std::uint32_t row, const Vec3<Real>& v) -> Vec3<Real> {
        const Vec3<Real> change = change_of(row);
        if (newton.increment != nullptr) {
          view::store3<Real>(newton.increment, row, change);
          view::store3<Real>(newton.iterate, row, v);
        }
        return v + change;
      },
      moved);
}

/// `moved` of move_rows in scenes in which no volume check reads positions.
struct DiscardPosition {
  struct Nothing {};
  TM_HOST_DEVICE Nothing read(std::uint32_t) const { return {}; }
  template <class Vector>
  TM_HOST_DEVICE void operator()(std::uint32_t, const Vector&, Nothing) const {}
};

/// `moved` of move_rows that stores each row's position relative to row 0 (view::relative_rest).
template <class Real>
struct StorePosition {
  const view::StateView<Real>& state;
  const view::GuardView<Real>& guard;
  Vec3<Real> read(std::uint32_t row) const { return view::relative_rest(state, row); }
  void operator()(std::uint32_t row, const Vec3<Real>& u, const Vec3<Real>& rest) const {
    view::store3<Real>(guard.relative_position, row, rest + u);
  }
};

/// Moves the rows and writes the patch's report.
///
///   move(moved) -> Motion   moves the rows and calls `moved` as move_rows does
template <class Team, class Real, class Move>
TM_HOST_DEVICE void move_and_report(const Team& team, const view::StateView<Real>& state,
                                    const view::GuardView<Real>& guard, const Move& move) {
  if constexpr (requires { Team::kOneThread; }) {
    if (guard.relative_position != nullptr) return report(team, guard, move(StorePosition<Real>{state, guard}));
  }
  report(team, guard, move(DiscardPosition{}));
}

/// Applies the solution: v += Δv, u = û + h v.
/// Reads solution, diagonal; writes what advance_by does, relative_position, patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void advance(const Team& team, const view::PatchesView& patches, const view::StateWriter<Real>& state,
                            const view::MatrixView<Real>& matrix, const view::SolveView<Real>& solve,
                            const view::NewtonView<Real>& newton, const view::GuardView<Real>& guard) {
  const auto change_of = [&](std::uint32_t row) -> Vec3<Real> {
    return unscaled(state, row, load_lower<Real>(matrix.diagonal, row), view::load3<Real>(solve.solution, row));
  };
  move_and_report(team, state, guard,
                  [&](const auto& moved) { return advance_by(team, patches, state, newton, guard, change_of, moved); });
}

/// Moves the rows of a patch once more after the solve, and replaces the motion in the patch's report.
///
///   change(row, u, v)   changes displacement and velocity of a row
///
/// Reads checkpoint; reads and writes displacement, velocity, patch_reports; writes relative_position.
template <class Team, class Real, class Change>
TM_HOST_DEVICE void move_again(const Team& team, const view::PatchesView& patches, const view::StateWriter<Real>& state,
                               const view::GuardView<Real>& guard, const Change& change) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  Motion<Real> motion;
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    Vec3<Real> u = view::load3<Real>(state.displacement, row), v = view::load3<Real>(state.velocity, row);
    change(row, u, v);
    view::store3<Real>(state.displacement, row, u);
    view::store3<Real>(state.velocity, row, v);
    if (guard.relative_position != nullptr) {
      view::store3<Real>(guard.relative_position, row, view::relative_rest(state, row) + u);
    }
    const Vec3<Real> external =
        state.external != nullptr ? view::load3<Real>(state.external, row) : Vec3<Real>(Vec3<Real>::Zero());
    motion.add(v, u, u - view::load3<Real>(guard.checkpoint_displacement, row), state.inertia[std::size_t{4} * row],
               external);
  });
  report(team, guard, motion, [&] {
    const Real least = guard.patch_reports[patch.index].min_det_f;
    team.sync();
    return least;
  });
}

/// Continues from the middle of the step to its end, for the implicit midpoint rule, and replaces the patch's report.
/// Reads û, v̂, checkpoint; reads and writes displacement, velocity; writes patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void extrapolate(const Team& team, const view::PatchesView& patches,
                                const view::StateWriter<Real>& state, const view::GuardView<Real>& guard) {
  const Real reach = state.control->scheme.reach;
  if (reach == 1) return;  // a step of implicit Euler, which is solved for its end
  move_again(team, patches, state, guard, [&](std::uint32_t row, Vec3<Real>& u, Vec3<Real>& v) {
    const Vec3<Real> base_u = view::load3<Real>(state.base_displacement, row);
    const Vec3<Real> base_v = view::load3<Real>(state.base_velocity, row);
    const Vec3<Real> solved = v;
    u = base_u + (u - base_u) * reach;
    v = base_v + (v - base_v) * reach;
    const std::uint32_t bits = view::free_bits(state, row);
    for (std::uint32_t c = 0; c < 3; ++c) {
      // A prescribed row has the velocity of its prescribed motion; extrapolated, it would swing about that.
      if ((bits >> c & 1) == 0) v[c] = solved[c];
    }
  });
}

}  // namespace tensormass::solver
