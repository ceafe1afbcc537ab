#pragma once

#include <cstddef>
#include <cstdint>

#include "mesh/mesh.h"
#include "view/scene.h"

/// What becomes of the state of a scene when its model is edited (model/edit.h). Both backends call it.
namespace tensormass::backend {

/// Stops a row that lost the last of its material. It stays where it is, and no solve starts along its last motion.
template <class Real>
TM_HOST_DEVICE void hold_row(const view::SceneView<Real>& s, std::uint32_t row) {
  const std::size_t first = std::size_t{4} * row, reals = std::size_t{4} * s.patches.row_count;
  for (std::size_t i = first; i < first + 4; ++i) {
    s.state.velocity[i] = 0;
    if (s.state.previous_displacement != nullptr) {
      s.state.previous_displacement[i] = s.state.displacement[i];
      s.state.previous_velocity[i] = 0;
    }
    if (s.solve.kept != nullptr) s.solve.kept[i] = s.solve.kept[reals + i] = 0;
  }
}

/// Number of reals that the contacts of a triangle remember.
template <class Real>
TM_HOST_DEVICE std::uint32_t slips_of_triangle(const view::ContactView<Real>& contact) {
  return 4 * contact.contact_points;
}
/// Moves the i-th real that the contacts of a triangle remember to another triangle, or clears it there.
/// from: mesh::kNone clears
template <class Real>
TM_HOST_DEVICE void move_slip(const view::ContactView<Real>& contact, std::uint32_t i, std::uint32_t from,
                              std::uint32_t to) {
  Real* const of_point = contact.slips + std::size_t{4} * contact.triangle_count * (i / 4) + i % 4;
  of_point[std::size_t{4} * to] = from == mesh::kNone ? Real(0) : of_point[std::size_t{4} * from];
}

}  // namespace tensormass::backend
