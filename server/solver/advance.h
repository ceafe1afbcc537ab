#pragma once

#include <cmath>

#include "solver/jacobi_scaling.h"

/// The begin and the end of a solve in time: where the step starts from, v += L⁻ᵀ x, u = û + h v, and what the guards
/// need to know. tensor/view.h says what û, v̂ and h are.
namespace tensormass::solver {

/// û and v̂ of the step, from the last two; the solve starts at v̂.
/// Reads displacement, velocity; writes base_displacement, base_velocity, previous_displacement, previous_velocity,
/// velocity. Only for scenes that are not implicit Euler linearized once.
template <class Team, class Real>
TM_HOST_DEVICE void predict(const Team& team, const tensor::SceneView<Real>& s) {
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> u = tensor::load3<Real>(s.displacement, row), v = tensor::load3<Real>(s.velocity, row);
    Vec3<Real> base_u = u * s.scheme->displacement_weights[0], base_v = v * s.scheme->velocity_weights[0];
    if (s.previous_displacement != nullptr) {
      base_u += tensor::load3<Real>(s.previous_displacement, row) * s.scheme->displacement_weights[1];
      base_v += tensor::load3<Real>(s.previous_velocity, row) * s.scheme->velocity_weights[1];
      tensor::store3<Real>(s.previous_displacement, row, u);
      tensor::store3<Real>(s.previous_velocity, row, v);
    }
    tensor::store3<Real>(s.base_displacement, row, base_u);
    tensor::store3<Real>(s.base_velocity, row, base_v);
    tensor::store3<Real>(s.velocity, row, base_v);
  });
}

/// Velocities that take driven rows where the step prescribes them.
/// Reads prescribed, displacement or base_displacement; writes velocity.
template <class Team, class Real>
TM_HOST_DEVICE void drive(const Team& team, const tensor::SceneView<Real>& s) {
  const Real* base = s.base_displacement != nullptr ? s.base_displacement : s.displacement;
  team.for_each(s.patch_driven[team.patch()], s.patch_driven[team.patch() + 1], [&](std::uint32_t i) {
    const std::uint32_t* driven = s.driven + std::size_t{3} * i;
    for (std::uint32_t c = 0; c < 3; ++c) {
      if ((driven[2] >> c & 1) == 0) continue;
      const Real target = s.prescribed[std::size_t{4} * driven[1] + c];
      s.velocity[std::size_t{4} * driven[0] + c] =
          (target - base[std::size_t{4} * driven[0] + c]) / tensor::step_size(s);
    }
  });
}

/// u = û + h v, and whether the row is still a number.
template <class Real>
TM_HOST_DEVICE bool move_row(const tensor::SceneView<Real>& s, std::uint32_t row, const Vec3<Real>& v) {
  const Real* base = s.base_displacement != nullptr ? s.base_displacement : s.displacement;
  const Vec3<Real> u = tensor::load3<Real>(base, row) + v * tensor::step_size(s);
  tensor::store3<Real>(s.velocity, row, v);
  tensor::store3<Real>(s.displacement, row, u);
  return v.dot(v) < Real(1e30) && u.dot(u) < Real(1e30);
}

/// Moves the rows of a patch to the velocities that `velocity_of(row)` says, and reports on them.
template <class Team, class Real, class Velocity>
TM_HOST_DEVICE void move_rows(const Team& team, const tensor::SceneView<Real>& s, const Velocity& velocity_of) {
  using std::sqrt;
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  Real max_squared = 0;
  Real not_finite = 0;
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> v = velocity_of(row);
    max_squared = maximum(max_squared, v.dot(v));
    if (!move_row(s, row, v)) not_finite = 1;
  });
  max_squared = team.patch_max(max_squared);
  not_finite = team.patch_max(not_finite);
  if (team.leads_patch()) s.patch_reports[patch.index] = {sqrt(max_squared), 1 - not_finite};
}

/// By the change of velocity that `change_of(row)` says.
/// Writes velocity, displacement, iterate, increment, patch_reports.
template <class Team, class Real, class Change>
TM_HOST_DEVICE void advance_by(const Team& team, const tensor::SceneView<Real>& s, const Change& change_of) {
  move_rows(team, s, [&](std::uint32_t row) -> Vec3<Real> {
    const Vec3<Real> change = change_of(row);
    const Vec3<Real> v = tensor::load3<Real>(s.velocity, row);
    if (s.increment != nullptr) {
      tensor::store3<Real>(s.increment, row, change);
      tensor::store3<Real>(s.iterate, row, v);
    }
    return v + change;
  });
}

/// Reads solution, diagonal; writes what advance_by does.
template <class Team, class Real>
TM_HOST_DEVICE void advance(const Team& team, const tensor::SceneView<Real>& s) {
  advance_by(team, s, [&](std::uint32_t row) -> Vec3<Real> {
    return load_lower<Real>(s.diagonal, row).transpose() * tensor::load3<Real>(s.solution, row);
  });
}

/// Takes a share of the last increment in place of the whole.
/// Reads iterate, increment, newton; writes velocity, displacement, patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void backtrack(const Team& team, const tensor::SceneView<Real>& s) {
  const Real share = static_cast<Real>(s.newton->line_share);
  move_rows(team, s, [&](std::uint32_t row) -> Vec3<Real> {
    return tensor::load3<Real>(s.iterate, row) + tensor::load3<Real>(s.increment, row) * share;
  });
}

/// How far the step is from balance. Reads rhs (before it is scaled), internal_force, external, increment; writes
/// residuals.
template <class Team, class Real>
TM_HOST_DEVICE void measure_residual(const Team& team, const tensor::SceneView<Real>& s) {
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  Real sums[3] = {0, 0, 0};
  const Real h = tensor::step_size(s);
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> rhs = tensor::load3<Real>(s.rhs, row);
    const std::uint32_t bits = tensor::free_bits(s, row);
    const Vec3<Real> increment = tensor::load3<Real>(s.increment, row);
    for (std::uint32_t c = 0; c < 3; ++c) {
      const Real r = (bits >> c & 1) != 0 ? rhs[c] : Real(0);
      sums[0] += r * r;
      sums[2] += r * increment[c];
    }
    Vec3<Real> force = tensor::load3<Real>(s.internal_force, row);
    sums[1] += force.dot(force) * (h * h);
    if (s.external != nullptr) {
      force = tensor::load3<Real>(s.external, row);
      sums[1] += force.dot(force) * (h * h);
    }
  });
  team.patch_sum(sums);
  if (team.leads_patch()) s.residuals[patch.index] = {sums[0], sums[1], sums[2]};
}

}  // namespace tensormass::solver
