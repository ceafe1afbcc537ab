#pragma once

#include "contact/balance.h"
#include "solver/time_scheme.h"

namespace tensormass::solver {

/// Moves the free bodies of a patch by their corrections (contact/balance.h).
/// Reads corrections; reads and writes displacement, velocity; writes patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void apply_balance(const Team& team, const view::PatchesView& patches,
                                  const view::StateWriter<Real>& state, const view::GuardView<Real>& guard,
                                  const view::BalanceView<Real>& balance) {
  if (balance.patch_entries[team.patch()] == balance.patch_entries[team.patch() + 1]) return;
  const Real h = view::step_size(state);
  move_again(team, patches, state, guard, [&](std::uint32_t row, Vec3<Real>& u, Vec3<Real>& v) {
    const std::uint32_t body = balance.row_body[row];
    if (body == view::kNoBody) return;
    const view::BodyCorrection<Real>& correction = balance.corrections[body];
    const Vec3<Real> center(correction.center_m[0], correction.center_m[1], correction.center_m[2]);
    const Vec3<Real> change = contact::velocity_at<Real>(correction, view::position(state, row) - center);
    v += change;
    u += change * h;
  });
}

}  // namespace tensormass::solver
