#pragma once

#include "solver/time_scheme.h"

/// The stages that only a scene with Newton iterations has. solver/newton.h decides when they run.
namespace tensormass::solver {

/// Takes a fraction of the last increment instead of all of it: v = iterate + line_share · increment, u = û + h v.
/// Reads iterate, increment, Newton's control, checkpoint; writes velocity, displacement, relative_position,
/// patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void backtrack(const Team& team, const view::PatchesView& patches, const view::StateWriter<Real>& state,
                              const view::NewtonView<Real>& newton, const view::GuardView<Real>& guard) {
  const Real share = static_cast<Real>(newton.control->line_share);
  const auto velocity = [&](std::uint32_t row) -> Vec3<Real> {
    return view::load3<Real>(newton.iterate, row) + view::load3<Real>(newton.increment, row) * share;
  };
  const auto as_read = [](std::uint32_t, const Vec3<Real>& v) { return v; };
  move_and_report(team, state, guard, [&](const auto& moved) {
    return move_rows(team, patches, state, guard, false, velocity, as_read, moved);
  });
}

/// Measures how far the step is from equilibrium (view::PatchResidual). Must run before factorize scales the right-hand
/// side.
/// Reads rhs, internal_force, external, increment, displacement; writes residuals.
template <class Team, class Real>
TM_HOST_DEVICE void measure_residual(const Team& team, const view::PatchesView& patches,
                                     const view::StateView<Real>& state, const view::MatrixView<Real>& matrix,
                                     const view::NewtonView<Real>& newton) {
  const view::Patch patch = view::patch_of(patches, team.patch());
  Real sums[3] = {0, 0, 0};
  Real moved[1] = {0};
  const Real h = view::step_size(state);
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> rhs = view::load3<Real>(matrix.rhs, row);
    const std::uint32_t bits = view::free_bits(state, row);
    const Vec3<Real> increment = view::load3<Real>(newton.increment, row);
    for (std::uint32_t c = 0; c < 3; ++c) {
      const Real r = (bits >> c & 1) != 0 ? rhs[c] : Real(0);
      sums[0] += r * r;
      sums[2] += r * increment[c];
    }
    const Vec3<Real> u = view::load3<Real>(state.displacement, row);
    moved[0] = maximum(moved[0], h * h * increment.dot(increment) / (u.dot(u) + state.size_m * state.size_m));
    Vec3<Real> force = view::load3<Real>(newton.internal_force, row);
    sums[1] += force.dot(force) * (h * h);
    if (state.external != nullptr) {
      force = view::load3<Real>(state.external, row);
      sums[1] += force.dot(force) * (h * h);
    }
  });
  team.patch_reduce(moved, sums);
  if (team.leads_patch()) newton.residuals[patch.index] = {sums[0], sums[1], sums[2], moved[0]};
}

}  // namespace tensormass::solver
