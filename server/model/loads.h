#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/assert.h"
#include "model/model.h"
#include "view/boundary.h"

/// Gravity, forces, tractions and pressures as they are at some factors.
///
///     force on a row    load_factor · Model::external + Σ factor[schedule] · force of the entry
///     pressure          pressure_pa · (the face has a schedule ? factor[schedule] : load_factor)
///
///   load_factor   share of the loads without a schedule: below 1 while they grow from part to part of a first step.
///                 A scheduled load is not multiplied by it, because its schedule already says how it grows.
///   factors       [ScheduledLoads::schedules] Schedule::at the time in question
namespace tensormass::model {

/// Writes the external forces of all rows. to: [row_count, 4], or untouched if Model::external is empty.
template <class Real>
void write_external(const Model& m, double load_factor, std::span<const double> factors, Real* to) {
  const ScheduledLoads& scheduled = m.scheduled;
  std::size_t entry = 0;
  for (std::size_t i = 0; i < m.external.size(); i += 4) {
    double force[3];
    for (std::size_t c = 0; c < 3; ++c) force[c] = m.external[i + c] * load_factor;
    for (; entry < scheduled.rows.size() && scheduled.rows[entry] == i / 4; ++entry) {
      const double factor = factors[scheduled.of_entry[entry]];
      for (std::size_t c = 0; c < 3; ++c) force[c] += scheduled.forces[3 * entry + c] * factor;
    }
    for (std::size_t c = 0; c < 3; ++c) to[i + c] = static_cast<Real>(force[c]);
    to[i + 3] = Real(0);
  }
  TM_ASSERT(entry == scheduled.rows.size(), "each scheduled force acts on a row, and rows ascend");
}

/// Writes the faces under pressure. to: [PressureSurface::faces].
template <class Real>
void write_pressure(const Model& m, double load_factor, std::span<const double> factors, view::PressureFace<Real>* to) {
  for (std::size_t f = 0; f < m.pressure.faces.size(); ++f) {
    view::PressureFace<double> face = m.pressure.faces[f];
    const std::uint32_t schedule = m.scheduled.of_face.empty() ? mesh::kNone : m.scheduled.of_face[f];
    face.pressure_pa *= schedule == mesh::kNone ? load_factor : factors[schedule];
    to[f] = static_cast<view::PressureFace<Real>>(face);
  }
}

}  // namespace tensormass::model
