#pragma once

#include <cstdint>

/// Data that Newton's method (solver/newton.h) and the stages exchange. All pointers are nullptr in a scene that is
/// linearized once a step.
namespace tensormass::view {

/// Inputs of the next phase from the host.
struct NewtonControl {
  std::uint32_t projects_stiffness;  // 1: project the stiffness to positive definite; 0: the consistent one
  std::uint32_t begins_step;         // 1: displacement is that of the last step's end, so internal variables advance
  float line_share;                  // fraction of the last increment to take
};

/// How far a patch is from equilibrium. Only free directions count for the residual and the slope. Forces count in all
/// directions.
template <class Real>
struct PatchResidual {
  Real residual_squared;  // |rhs|² [N² s²]
  Real force_squared;     // internal and external forces times the step, fixed directions included [N² s²]
  Real slope;             // rhs · increment [J]
  Real moved_squared;     // largest node motion of the increment relative to |(u, size_m)|, squared
};

template <class Real>
struct NewtonView {
  const NewtonControl* control;    // [1]
  Real* increment;                 // [row_count, 4] L⁻ᵀ x of the last solve [m/s]
  Real* iterate;                   // [row_count, 4] velocity before that increment [m/s]
  Real* internal_force;            // [row_count, 4] forces of the elements [N]
  PatchResidual<Real>* residuals;  // [patch_count]
};

}  // namespace tensormass::view
