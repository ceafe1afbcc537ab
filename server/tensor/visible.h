#pragma once

#include "tensor/view.h"

namespace tensormass::tensor {

/// Where the vertices are that clients see; only when a frame is due. Shared out among the patches evenly.
/// Reads displacement; writes visible_positions.
template <class Team, class Real>
TM_HOST_DEVICE void gather_visible(const Team& team, const SceneView<Real>& s) {
  const auto share = [&](std::uint32_t patch) {
    return static_cast<std::uint32_t>(std::uint64_t{s.visible_count} * patch / s.patch_count);
  };
  team.for_each(share(team.patch()), share(team.patch() + 1), [&](std::uint32_t vertex) {
    Vec3<Real> x = Vec3<Real>::Zero();
    for (int c = 0; c < 4; ++c) {
      const std::size_t corner = std::size_t{4} * vertex + static_cast<std::size_t>(c);
      x += position(s, s.visible_rows[corner]) * s.visible_weights[corner];
    }
    for (int c = 0; c < 3; ++c)
      s.visible_positions[std::size_t{3} * vertex + static_cast<std::size_t>(c)] = static_cast<float>(x[c]);
  });
}

}  // namespace tensormass::tensor
