#pragma once

#include <cmath>

#include "solver/jacobi_scaling.h"

/// The end of an implicit Euler step: v += L⁻ᵀ x, u += dt v, and what the guards need to know.
namespace tensormass::solver {

/// Reads solution, diagonal; writes velocity, displacement, patch_reports.
template <class Team, class Real>
TM_HOST_DEVICE void advance(const Team& team, const tensor::SceneView<Real>& s) {
  using std::sqrt;
  const tensor::Patch patch = tensor::patch_of(s, team.patch());
  Real max_squared = 0;
  Real not_finite = 0;
  team.for_each(patch.row_begin, patch.row_end, [&](std::uint32_t row) {
    const Vec3<Real> change = load_lower<Real>(s.diagonal, row).transpose() * tensor::load3<Real>(s.solution, row);
    const Vec3<Real> v = tensor::load3<Real>(s.velocity, row) + change;
    const Vec3<Real> u = tensor::load3<Real>(s.displacement, row) + v * s.dt_s;
    tensor::store3<Real>(s.velocity, row, v);
    tensor::store3<Real>(s.displacement, row, u);
    const Real squared = v.dot(v);
    max_squared = maximum(max_squared, squared);
    if (!(squared < Real(1e30)) || !(u.dot(u) < Real(1e30))) not_finite = 1;
  });
  max_squared = team.patch_max(max_squared);
  not_finite = team.patch_max(not_finite);
  if (team.leads_patch()) s.patch_reports[patch.index] = {sqrt(max_squared), 1 - not_finite};
}

}  // namespace tensormass::solver
