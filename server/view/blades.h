#pragma once

#include <cstdint>

#include "core/scalar.h"

/// Blades that cut tissue by points of their edge (contact/blades.h). In a scene without blades all pointers are
/// nullptr and all counts zero.
namespace tensormass::view {

inline constexpr std::uint32_t kNoTetrahedron = 0xFFFFFFFFu;

/// What a blade point remembers from step to step, in BladesView::memory. A tetrahedron is stored as its number plus 1;
/// 0: none.
enum BladeMemory : std::uint32_t {
  kBladeTetrahedron,  // the one that its anchor is in; 0: the point is free
  kBladeWeights,      // four barycentric coordinates of the anchor
  kBladeRetreat = 5,  // how far the point has gone back through tissue that it had cut [m]
  kBladeOutside,      // 1: no tissue was around it when it was last looked for
  kBladeSearches,     // 1: tissue around it is looked for at the end of the step
  kBladeEvent,        // BladeEvent in this step
  kBladeLast,         // the tetrahedron by which it has left, in the step of kBladeLeft
  kBladeMemory
};
enum BladeEvent : std::uint32_t { kBladeNothing, kBladeEntered, kBladeLeft };

/// The front of a blade point: the place up to which it has cut at the end of a step.
template <class Real>
struct BladeReport {
  Real rest_m[3];             // in the bodies at rest; beside tissue it goes on as the tetrahedron next to it does
  std::uint32_t tetrahedron;  // the one that it goes by; kNoTetrahedron: it cuts nothing
  Real dissipated_j;          // work of fracture in this step
  Real cut_m2;                // area that the point cut in this step
  Real holds_n;               // force at which it goes on cutting; 0: it holds nothing, or not before it is back
};

template <class Real>
struct BladesView {
  std::uint32_t blade_count;
  std::uint32_t point_count;  // points of all blades
  std::uint32_t patch_count;

  const std::uint32_t* tools;         // [blade_count] places in ContactView::tools; a tool comes once for each edge
  const std::uint32_t* first_points;  // [blade_count + 1]

  // Tetrahedra of all bodies, numbered as the elements of the scene.
  const std::uint32_t* rows;              // [tetrahedron, 4]
  const std::uint32_t* neighbours;        // [tetrahedron, 4] across the face opposite to each corner; kNoTetrahedron
  const Real* toughness;                  // [tetrahedron] J/m²
  const std::uint32_t* patch_tetrahedra;  // [patch_count + 1] into tetrahedra
  const std::uint32_t* tetrahedra;        // each once

  Real* memory;  // [point_count, kBladeMemory], then [point_count, patch_count]: the tetrahedron of each patch that was
                 // found around a point. A part of LinksView::slips
  Real* checkpoint_memory;
  BladeReport<Real>* reports;  // [point_count]

  TM_HOST_DEVICE std::uint32_t reals() const { return point_count * (kBladeMemory + patch_count); }
  TM_HOST_DEVICE Real* memory_of(std::uint32_t point) const { return memory + std::size_t{kBladeMemory} * point; }
  TM_HOST_DEVICE std::size_t found_place(std::uint32_t point, std::uint32_t patch) const {
    return std::size_t{kBladeMemory} * point_count + std::size_t{patch_count} * point + patch;
  }
};

}  // namespace tensormass::view
