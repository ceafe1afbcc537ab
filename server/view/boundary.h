#pragma once

#include <cstdint>

#include "physics/element/face.h"

/// Boundary conditions that a step evaluates. Fixed directions and constant loads are fields of rows (state.h).
namespace tensormass::view {

/// Prescribed displacements, which may change over time.
template <class Real>
struct PrescribedView {
  const std::uint32_t* patch_begin;  // [patch_count + 1] into rows
  const std::uint32_t* rows;         // [.., 3] row, index into displacement, bits of the directions
  const Real* displacement;          // [.., 4] m, at the end of the step
};

/// A face under pressure and the rows of its nodes (physics/element/face.h).
template <class Real>
struct PressureFace {
  std::uint32_t node_count;
  std::uint32_t rows[physics::kMaxFaceNodes];
  Real pressure_pa;

  PressureFace() = default;
  template <class Other>
  explicit PressureFace(const PressureFace<Other>& f)
      : node_count(f.node_count), pressure_pa(static_cast<Real>(f.pressure_pa)) {
    for (int k = 0; k < physics::kMaxFaceNodes; ++k) rows[k] = f.rows[k];
  }
};

/// Pressed faces and the rows of their nodes. A corner is one node of one face.
template <class Real>
struct PressureView {
  const PressureFace<Real>* faces;
  const std::uint32_t* patch_begin;   // [patch_count + 1] into rows
  const std::uint32_t* rows;          // rows of pressure faces, grouped by patch
  const std::uint32_t* corner_begin;  // [pressed row + 1] into corners
  const std::uint32_t* corners;       // [.., 2] face, corner
  const std::uint32_t* slots;         // [corner, kMaxFaceNodes] slots of the edges to the nodes of the corner's face.
                                      // kNoPlace: the corner adds no stiffness to that edge, because the other row
                                      // stores it, the face has fewer nodes, or its stiffness is not symmetric
};

}  // namespace tensormass::view
