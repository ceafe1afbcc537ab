#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <span>

#include "backend/backend.h"
#include "core/assert.h"
#include "view/scene.h"

/// Results of a step from the reports of its patches, on the host. Reductions run in the order of the patches, so that
/// they repeat bitwise.
namespace tensormass::backend {

/// Returns StepResult::min_det_f.
/// of_solve: smallest det F that the solve has found (read_step).
/// min_det_f: [group_count, ..] the same from the stages; infinity for groups that the solve checks.
template <class Real>
double read_volume(const model::Model& m, double of_solve, std::span<const Real> min_det_f) {
  if (!m.checks_volume()) return 1;
  double least = of_solve;
  const std::size_t of_group = min_det_f.size() / m.groups.size();
  for (std::size_t group = 0; group < m.groups.size(); ++group) {
    if (!m.groups[group].checks_volume) continue;
    for (const Real one : min_det_f.subspan(group * of_group, of_group))
      least = std::min(least, static_cast<double>(one));
  }
  return least;
}

/// diagnostics: [group_count, patch_count]
template <class Real>
void read_diagnostics(std::span<const view::PatchDiagnostics<Real>> diagnostics, std::span<GroupDiagnostics> groups) {
  const std::size_t patches = groups.empty() ? 0 : diagnostics.size() / groups.size();
  for (std::size_t group = 0; group < groups.size(); ++group) {
    constexpr double kNone = std::numeric_limits<double>::infinity();
    GroupDiagnostics all{.min_det_f = kNone, .least_stretch = kNone};
    for (const auto& patch : diagnostics.subspan(group * patches, patches)) {
      all.min_det_f = std::min(all.min_det_f, static_cast<double>(patch.min_det_f));
      all.max_strain = std::max(all.max_strain, static_cast<double>(patch.max_strain));
      all.max_rotation_rad = std::max(all.max_rotation_rad, static_cast<double>(patch.max_rotation));
      all.least_stretch = std::min(all.least_stretch, static_cast<double>(patch.least_stretch));
      all.elastic_energy_j += static_cast<double>(patch.elastic_energy_j);
    }
    groups[group] = all;
  }
}

/// loads: [tool_count, patch_count]
template <class Real>
void read_forces(std::span<const view::ToolLoad<Real>> loads, std::span<ToolForce> forces) {
  const std::size_t patches = forces.empty() ? 0 : loads.size() / forces.size();
  for (std::size_t tool = 0; tool < forces.size(); ++tool) {
    ToolForce sum;
    double pressed_n = 0, moduli[2] = {0, 0}, tip_squared = std::numeric_limits<double>::infinity();
    for (std::size_t patch = 0; patch < patches; ++patch) {
      const auto& load = loads[tool * patches + patch];
      for (int c = 0; c < 3; ++c) {
        sum.force_n[c] += static_cast<double>(load.force_n[c]);
        sum.torque_n_m[c] += static_cast<double>(load.torque_n_m[c]);
        sum.friction_n[c] += static_cast<double>(load.friction_n[c]);
      }
      for (std::size_t j = 0; j < sum.joints.size(); ++j) sum.joints[j] += static_cast<double>(load.joints[j]);
      pressed_n += static_cast<double>(load.pressed_n);
      for (std::size_t i = 0; i < 2; ++i) moduli[i] += static_cast<double>(load.pressed_moduli[i]);
      const double squared = static_cast<double>(load.tip.distance_squared);
      if (load.tip.triangle != view::kNoTriangle && squared < tip_squared) {
        tip_squared = squared;
        sum.tip_triangle = load.tip.triangle;
      }
    }
    if (pressed_n > 0) {
      sum.young_modulus_pa = moduli[0] / pressed_n;
      sum.plane_strain_modulus_pa = moduli[1] / pressed_n;
    }
    sum.tip_distance_m = std::sqrt(tip_squared);
    forces[tool] = sum;
  }
}

/// Implements SceneState::read_blades.
template <class Real>
void copy_blades(std::span<const view::BladeReport<Real>> from, std::span<BladeFront> to) {
  TM_ASSERT(from.size() == to.size(), "a front for each blade point");
  for (std::size_t i = 0; i < to.size(); ++i) {
    for (std::size_t c = 0; c < 3; ++c) {
      to[i].rest_m[static_cast<Eigen::Index>(c)] = static_cast<double>(from[i].rest_m[c]);
    }
    to[i].element = from[i].tetrahedron;
    to[i].dissipated_j = static_cast<double>(from[i].dissipated_j);
    to[i].cut_m2 = static_cast<double>(from[i].cut_m2);
    to[i].holds_n = static_cast<double>(from[i].holds_n);
  }
}

/// Implements SceneState::read_broken. from: LinksView::broken, on the host
template <class Real>
void copy_broken(std::span<const Real> from, std::span<std::uint8_t> to) {
  TM_ASSERT(from.size() == to.size(), "a flag for each spring");
  for (std::size_t i = 0; i < from.size(); ++i) to[i] = static_cast<std::uint8_t>(from[i]);
}

}  // namespace tensormass::backend
