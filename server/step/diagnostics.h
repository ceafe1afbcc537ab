#pragma once

#include <cmath>
#include <limits>

#include "matrix/element_points.h"
#include "view/guard.h"

namespace tensormass::step {

/// Measures the deformation and elastic energy of a group's elements (view::PatchDiagnostics). Runs now and then, for
/// the status.
/// Reads displacement; writes diagnostics.
template <class Shape, class Law, class Team, class Real>
TM_HOST_DEVICE void diagnose_elements(const Team& team, const view::PatchesView& patches,
                                      const view::StateView<Real>& state, const view::GuardView<Real>& guard,
                                      const view::ElementView<Real>& e) {
  using std::sqrt;
  using Lanes = typename Team::template Lanes<Real>;
  using T = typename Lanes::Scalar;
  const matrix::ElementRange range = matrix::element_range(patches, e, team.patch());
  T compression = T(-std::numeric_limits<Real>::max()), flattening = T(-1);  // −det F, −least stretch
  T strain = T(0), rotation = T(0), energy = T(0);                           // strain and rotation are squares
  const view::Patch patch = view::patch_of(patches, team.patch());
  team.template for_lanes<Lanes::kWidth>(range.begin, range.end, [&](std::uint32_t first) {
    // If several patches evaluate an element, only the owner of its first node counts its energy.
    T counted = T(1);
    if (e.patch_elements != nullptr) {
      Real counts[Lanes::kWidth];
      for (std::uint32_t i = 0; i < Lanes::kWidth; ++i) {
        const std::uint32_t row = e.rows[first + i];
        counts[i] = row >= patch.row_begin && row < patch.row_end ? Real(1) : Real(0);
      }
      counted = Lanes::load(counts);
    }
    Vec3<T> u[Shape::kNodes];
    matrix::load_displacement<Lanes, Shape>(state, e, first, u);
    matrix::for_each_point<Lanes, Shape, Law>(
        e, first, u, [&](const auto& gradients, const auto& f, const auto& point, auto) {
          // Padding has zero parameters, for which a law's energy may be NaN; its weight is zero and its F the
          // identity.
          const T own = Law::energy(point) * gradients.weight;
          energy += counted * select_greater(gradients.weight, T(0), own, T(0));
          compression = maximum(compression, T(-f.determinant()));
          if constexpr (requires { Law::kLeastStretch; }) {
            flattening = maximum(flattening, T(-physics::signed_singular_values(f).sigma[2]));
          }
          for (int c = 0; c < 3; ++c) {
            const int d = (c + 1) % 3;
            const T stretch = f(c, c) - T(1), shear = (f(c, d) + f(d, c)) * T(0.5);
            strain = maximum(strain, maximum(T(stretch * stretch), T(shear * shear)));
          }
          const T x = f(2, 1) - f(1, 2), y = f(0, 2) - f(2, 0), z = f(1, 0) - f(0, 1);
          rotation = maximum(rotation, T((x * x + y * y + z * z) * T(0.25)));
        });
  });
  Real most[4] = {Lanes::largest(compression), Lanes::largest(flattening), Lanes::largest(strain),
                  Lanes::largest(rotation)};
  Real sum[1] = {Lanes::sum(energy)};
  team.patch_reduce(most, sum);
  if (team.leads_patch()) {
    guard.diagnostics[e.report_begin + team.patch()] = {-most[0], sqrt(most[2]), sqrt(most[3]), -most[1], sum[0]};
  }
}

}  // namespace tensormass::step
