#pragma once

#include <cmath>
#include <limits>

#include "solver/jacobi_scaling.h"

/// The begin and the end of a solve in time: where the step starts from, v += L⁻ᵀ x, u = û + h v, and what the guards
/// need to know. tensor/view.h says what û, v̂ and h are.
namespace tensormass::solver {

/// Puts the state of a row at the begin of the step aside, for a guard that takes the step back.
template <class Real>
TM_HOST_DEVICE void keep(const tensor::SceneView<Real>& s, std::uint32_t row, const Vec3<Real>& u,
                         const Vec3<Real>& v) {
  if (s.control->keeps == 0) return;
  tensor::store3<Real>(s.kept_displacement, row, u);
  tensor::store3<Real>(s.kept_velocity, row, v);
  if (s.previous_displacement == nullptr) return;
  tensor::store3<Real>(s.kept_previous_displacement, row, tensor::load3<Real>(s.previous_displacement, row));
  tensor::store3<Real>(s.kept_previous_velocity, row, tensor::load3<Real>(s.previous_velocity, row));
}

/// û and v̂ of the step, from the last two; the solve starts at v̂.
/// Reads displacement, velocity; writes base_displacement, base_velocity, previous_displacement, previous_velocity,
/// velocity, kept fields. Only for scenes that are not plain (Model::is_plain).
template <class Team, class Real>
TM_HOST_DEVICE void predict(const Team& team, const tensor::SceneView<Real>& s) {
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> u = tensor::load3<Real>(s.displacement, row), v = tensor::load3<Real>(s.velocity, row);
    const tensor::StepScheme<Real>& scheme = s.control->scheme;
    Vec3<Real> base_u = u * scheme.displacement_weights[0], base_v = v * scheme.velocity_weights[0];
    keep(s, row, u, v);
    if (s.previous_displacement != nullptr) {
      base_u += tensor::load3<Real>(s.previous_displacement, row) * scheme.displacement_weights[1];
      base_v += tensor::load3<Real>(s.previous_velocity, row) * scheme.velocity_weights[1];
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

/// Has what move_rows reads of a row brought near. A solve takes long enough for caches to lose it.
template <class Real>
TM_HOST_DEVICE void expect_move(const tensor::SceneView<Real>& s, std::uint32_t row) {
  const std::size_t at = std::size_t{4} * row;
  expect(s.velocity + at);
  expect((s.base_displacement != nullptr ? s.base_displacement : s.displacement) + at);
  expect(s.kept_displacement + at);
  expect(s.inertia + at);
  if (s.external != nullptr) expect(s.external + at);
}

/// What a thread has seen of the rows that it moved.
template <class Real>
struct Motion {
  Real maxima[3] = {0, 0, 0};  // squares of speed, move and distance
  Real sums[3] = {0, 0, 0};    // rows that are no numbers, twice the kinetic energy, work
};

/// Of all threads of a patch. least_det_f(): PatchReport::min_det_f, which who leads the patch has to know; the
/// patch's threads meet there at least once.
template <class Team, class Real, class LeastDetF>
TM_HOST_DEVICE void report(const Team& team, const tensor::SceneView<Real>& s, Motion<Real> motion,
                           const LeastDetF& least_det_f) {
  using std::sqrt;
  auto& [maxima, sums] = motion;
  team.begin_reduce(maxima, sums);
  const Real min_det_f = least_det_f();
  if (!team.leads_patch()) return;
  team.end_reduce(maxima, sums);
  s.patch_reports[team.patch()] = {
      sqrt(maxima[0]), sums[0] == 0 ? Real(1) : Real(0), sqrt(maxima[1]), sqrt(maxima[2]), sums[1] / 2, sums[2],
      min_det_f};
}

/// Where nobody looks at volumes, or a stage of their own does.
template <class Team, class Real>
TM_HOST_DEVICE void report(const Team& team, const tensor::SceneView<Real>& s, const Motion<Real>& motion) {
  report(team, s, motion, [&] {
    team.sync();
    return std::numeric_limits<Real>::infinity();
  });
}

/// Moves the rows of a patch to velocities v, u = û + h v. read(row): what v is made of; velocity_of(row, that): v.
/// keeps: this puts aside where a row is before, which is then û, and read(row) its velocity. moved(row, u,
/// moved.read(row)) is called for each.
template <class Team, class Real, class Read, class Velocity, class Moved>
TM_HOST_DEVICE Motion<Real> move_rows(const Team& team, const tensor::SceneView<Real>& s, bool keeps, const Read& read,
                                      const Velocity& velocity_of, const Moved& moved) {
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  const Real* base = s.base_displacement != nullptr ? s.base_displacement : s.displacement;
  const Real h = tensor::step_size(s);
  Motion<Real> motion;
  auto& [maxima, sums] = motion;
  struct Before {
    Vec3<Real> of_velocity, base, kept, external;
    Real mass;
    decltype(moved.read(0)) of_moved;
  };
  constexpr int kAtOnce = 2;
  team.template for_each<kAtOnce>(
      patch.row_begin, patch.row_end,
      [&](std::uint32_t row) -> Before {
        return {read(row),
                tensor::load3<Real>(base, row),
                tensor::load3<Real>(s.kept_displacement, row),
                s.external != nullptr ? tensor::load3<Real>(s.external, row) : Vec3<Real>(Vec3<Real>::Zero()),
                s.inertia[std::size_t{4} * row],
                moved.read(row)};
      },
      [&](std::uint32_t row, const Before& before) {
        const Vec3<Real> v = velocity_of(row, before.of_velocity);
        const Vec3<Real> u = before.base + v * h;
        const Vec3<Real> move = u - (keeps ? before.base : before.kept);
        if (keeps) keep(s, row, before.base, before.of_velocity);
        tensor::store3<Real>(s.velocity, row, v);
        tensor::store3<Real>(s.displacement, row, u);
        moved(row, u, before.of_moved);
        maxima[0] = maximum(maxima[0], v.dot(v));
        maxima[1] = maximum(maxima[1], move.dot(move));
        maxima[2] = maximum(maxima[2], u.dot(u));
        if (!(v.dot(v) < Real(1e30) && u.dot(u) < Real(1e30))) sums[0] += 1;
        sums[1] += before.mass * v.dot(v);
        sums[2] += before.external.dot(move);
      });
  return motion;
}

/// By the change of velocity that `change_of(row)` says; moved as above.
/// Writes velocity, displacement, iterate, increment, kept fields.
template <class Team, class Real, class Change, class Moved>
TM_HOST_DEVICE Motion<Real> advance_by(const Team& team, const tensor::SceneView<Real>& s, const Change& change_of,
                                       const Moved& moved) {
  const bool keeps = s.base_displacement == nullptr && s.control->keeps != 0;  // else: predict has
  return move_rows(
      team, s, keeps, [&](std::uint32_t row) { return tensor::load3<Real>(s.velocity, row); },
      [&](std::uint32_t row, const Vec3<Real>& v) -> Vec3<Real> {
        const Vec3<Real> change = change_of(row);
        if (s.increment != nullptr) {
          tensor::store3<Real>(s.increment, row, change);
          tensor::store3<Real>(s.iterate, row, v);
        }
        return v + change;
      },
      moved);
}

/// Nobody asks where rows have moved to.
struct Unasked {
  struct Nothing {};
  TM_HOST_DEVICE Nothing read(std::uint32_t) const { return {}; }
  template <class Vector>
  TM_HOST_DEVICE void operator()(std::uint32_t, const Vector&, Nothing) const {}
};

/// Keeps it.
template <class Real>
struct KeepsPosition {
  const tensor::SceneView<Real>& s;
  Vec3<Real> read(std::uint32_t row) const { return tensor::relative_rest(s, row); }
  void operator()(std::uint32_t row, const Vec3<Real>& u, const Vec3<Real>& rest) const {
    tensor::store3<Real>(s.relative_position, row, rest + u);
  }
};

/// move(moved) with what the scene asks of rows that move, and reports.
template <class Team, class Real, class Move>
TM_HOST_DEVICE void move_and_report(const Team& team, const tensor::SceneView<Real>& s, const Move& move) {
  if constexpr (requires { Team::kOneThread; }) {
    if (s.relative_position != nullptr) return report(team, s, move(KeepsPosition<Real>{s}));
  }
  report(team, s, move(Unasked{}));
}

/// Reads solution, diagonal; writes what advance_by does, relative_position and patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void advance(const Team& team, const tensor::SceneView<Real>& s) {
  const auto change_of = [&](std::uint32_t row) -> Vec3<Real> {
    return unscaled(s, row, load_lower<Real>(s.diagonal, row), tensor::load3<Real>(s.solution, row));
  };
  move_and_report(team, s, [&](const auto& moved) { return advance_by(team, s, change_of, moved); });
}

/// Takes a share of the last increment in place of the whole.
/// Reads iterate, increment, newton, kept displacement; writes velocity, displacement, relative_position,
/// patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void backtrack(const Team& team, const tensor::SceneView<Real>& s) {
  const Real share = static_cast<Real>(s.newton->line_share);
  const auto velocity = [&](std::uint32_t row) -> Vec3<Real> {
    return tensor::load3<Real>(s.iterate, row) + tensor::load3<Real>(s.increment, row) * share;
  };
  const auto as_read = [](std::uint32_t, const Vec3<Real>& v) { return v; };
  move_and_report(team, s, [&](const auto& moved) { return move_rows(team, s, false, velocity, as_read, moved); });
}

/// How far the step is from balance. Reads rhs (before it is scaled), internal_force, external, increment,
/// displacement; writes residuals.
template <class Team, class Real>
TM_HOST_DEVICE void measure_residual(const Team& team, const tensor::SceneView<Real>& s) {
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  Real sums[3] = {0, 0, 0};
  Real moved[1] = {0};
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
    const Vec3<Real> u = tensor::load3<Real>(s.displacement, row);
    moved[0] = maximum(moved[0], h * h * increment.dot(increment) / (u.dot(u) + s.size_m * s.size_m));
    Vec3<Real> force = tensor::load3<Real>(s.internal_force, row);
    sums[1] += force.dot(force) * (h * h);
    if (s.external != nullptr) {
      force = tensor::load3<Real>(s.external, row);
      sums[1] += force.dot(force) * (h * h);
    }
  });
  team.patch_reduce(moved, sums);
  if (team.leads_patch()) s.residuals[patch.index] = {sums[0], sums[1], sums[2], moved[0]};
}

}  // namespace tensormass::solver
