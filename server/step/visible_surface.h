#pragma once

#include "view/state.h"
#include "view/surface.h"

namespace tensormass::step {

/// Computes the positions of visible vertices. Runs when a frame is due. Patches take even shares of the vertices.
/// Reads displacement; writes the surface's positions.
template <class Team, class Real>
TM_HOST_DEVICE void gather_surface(const Team& team, const view::PatchesView& patches,
                                   const view::StateView<Real>& state, const view::SurfaceView<Real>& surface) {
  const auto share = [&](std::uint32_t patch) {
    return static_cast<std::uint32_t>(std::uint64_t{surface.vertex_count} * patch / patches.patch_count);
  };
  team.for_each(share(team.patch()), share(team.patch() + 1), [&](std::uint32_t vertex) {
    Vec3<Real> x = Vec3<Real>::Zero();
    for (int c = 0; c < 4; ++c) {
      const std::size_t corner = std::size_t{4} * vertex + static_cast<std::size_t>(c);
      x += view::position(state, surface.rows[corner]) * surface.weights[corner];
    }
    for (int c = 0; c < 3; ++c)
      surface.positions[std::size_t{3} * vertex + static_cast<std::size_t>(c)] = static_cast<float>(x[c]);
  });
}

}  // namespace tensormass::step
