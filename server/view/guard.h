#pragma once

#include <cstdint>

#include "view/state.h"

/// Data that guards check after each step, and the checkpoint to which they take a step back (world/guard.h).
namespace tensormass::view {

/// Report of one patch. The host reduces the reports in the order of the patches.
template <class Real>
struct PatchReport {
  Real max_speed_m_per_s;
  Real finite;            // 1, or 0 if a value of the patch is not a number
  Real max_move_m;        // largest move of a row from the checkpoint
  Real max_distance_m;    // largest distance of a row from rest
  Real kinetic_energy_j;  // sum over the rows
  Real work_j;            // work of gravity and loads since the checkpoint
  Real min_det_f;         // smallest, of tetrahedra that the solve finds inverted; infinity: it finds none
};

/// Deformation of one group in one patch. It is measured now and then for the status, not in each step.
template <class Real>
struct PatchDiagnostics {
  Real min_det_f;
  Real max_strain;     // largest component of |sym F − I|
  Real max_rotation;   // |axial vector of skew F|, about the angle in radians
  Real least_stretch;  // smallest principal stretch, at most 1; 1 for laws that do not state one (kLeastStretch)
  Real elastic_energy_j;
};

template <class Real>
struct GuardView {
  // Checkpoint, [row_count, 4] each; the previous fields are nullptr where the scheme does not use them.
  Real* checkpoint_displacement;
  Real* checkpoint_velocity;
  Real* checkpoint_previous_displacement;
  Real* checkpoint_previous_velocity;

  PatchReport<Real>* patch_reports;     // [patch_count]
  PatchDiagnostics<Real>* diagnostics;  // [group, patch_count]
  Real* min_det_f;                      // [group, patch_count, parts of a patch], for groups that a stage checks

  Real* relative_position;  // [row_count, 4] position [m] relative to where row 0 rests; nullptr: no check reads it
  // Tetrahedra that the solve checks in its epilogue (matrix/patch_tetrahedra.h); nullptr: it checks none.
  const std::uint32_t* patch_tetrahedra;  // [2 patch_count + 1] into tetrahedron_rows
  const std::uint16_t* tetrahedron_rows;  // [.., 4] patch-local
};

/// Rest position of a row relative to row 0 [m]. Rounding then depends on the scene's size and not on its distance from
/// the origin.
template <class Real>
TM_HOST_DEVICE Vec3<Real> relative_rest(const StateView<Real>& state, std::size_t row) {
  return load3<Real>(state.rest, row) - load3<Real>(state.rest, 0);
}

}  // namespace tensormass::view
