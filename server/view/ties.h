#pragma once

#include <cstdint>

#include "core/scalar.h"

/// Ties: springs between a node and a point of a triangle, or another node. Contact between bodies and attachments are
/// made of ties (contact/ties.h). In a scene without them all pointers are nullptr and all counts zero.
namespace tensormass::view {

inline constexpr std::uint32_t kNoEntry = 0xFFFFFFFFu;

/// Triangles of a leaf, and leaves of a group: the two levels of boxes around a body's surface.
inline constexpr std::uint32_t kLeafTriangles = 16;
inline constexpr std::uint32_t kGroupLeaves = 16;

/// One tie in this step. The force on its node, after a motion d of the four rows until the end of the step, is
/// force − S Σ weight · d with S = stiffness n nᵀ + across (I − n nᵀ). The corners receive it in proportion to their
/// weights.
template <class Real>
struct Tie {
  std::uint32_t rows[4];  // the node, then the corners of the triangle; without a triangle the other node comes second
  Real weight[4];         // 1, then minus the barycentric coordinates: they add up to zero. Zero: no such corner
  Real normal[3];         // n
  Real force[3];          // [N]
  Real stiffness;         // [N/m]; zero: the tie does nothing in this step
  Real across;            // [N/m]; of a contact without stiffness: contact::NodeSide
};

/// A box along the axes. Empty: least > most.
template <class Real>
struct AxisBox {
  Real least[3], most[3];
};

/// What the ties of a patch did in the last step.
template <class Real>
struct TieReport {
  Real contacts;   // nodes that touch a surface
  Real deepest_m;  // largest penetration
  Real broken;     // springs that have broken so far
};

/// Numbers of a side in TiesView::side_numbers.
/// kSidePenalty: as the scene gives it; else kSidePenaltyPerM times the smaller of two moduli. The other of them is 0.
enum SideNumber : std::uint32_t {
  kSidePenalty,
  kSidePenaltyPerM,
  kSideDistance,
  kSideReach,
  kSideFriction,
  kSideNumbers
};

template <class Real>
struct TiesView {
  std::uint32_t candidate_count;  // nodes that may touch a surface
  std::uint32_t spring_count;

  // Rows that a tie may have, grouped by patch.
  const std::uint32_t* patch_rows;  // [patch_count + 1] into rows
  const std::uint32_t* rows;
  const std::uint32_t* row_place;  // [row_count] place of a row's own vector among those stored patch by patch

  // Boxes around the triangles of ContactView that bodies can touch. Leaves and groups of a body follow each other.
  std::uint32_t leaf_count;             // a multiple of kGroupLeaves
  const std::uint32_t* leaf_triangles;  // [leaf_count, kLeafTriangles]; kNoTriangle: the leaf has fewer
  AxisBox<Real>* boxes;                 // [leaf_count], then [leaf_count / kGroupLeaves]

  // Candidates, grouped by the patch of their row. A side is the surface that some nodes may touch.
  const std::uint32_t* patch_candidates;  // [patch_count + 1]
  const std::uint32_t* candidates;        // [candidate_count, 2] surface vertex, side
  const Real* candidate_area;             // [candidate_count] m²: the node's part of its surface, halved
  const Real* candidate_modulus;          // [candidate_count] E of the elements behind the node's part [Pa], their mean
  const std::uint32_t* side_groups;       // [side, 3] first group of boxes, last + 1, 1 if the nodes are of that body
  const Real* side_numbers;               // [side, kSideNumbers]
  Real* slips;  // [candidate_count, 4] stretch of the spring of friction [m]; 4th: normal force [N], or where the node
                // was (contact::NodeSide). At the end of the last step; nullptr: nothing is remembered
  Real* checkpoint_slips;

  // Springs, grouped by the patch of their first row.
  const std::uint32_t* patch_springs;  // [patch_count + 1]
  const std::uint32_t* spring_rows;    // [spring_count, 2]
  const Real* spring_numbers;          // [spring_count, 3] stiffness [N/m], length at rest [m], breaking force [N]
  Real* broken;                        // [spring_count] 1: the spring is broken
  Real* checkpoint_broken;

  // The ties of this step: those of the candidates, then the springs.
  Tie<Real>* ties;      // [candidate_count + spring_count]
  std::uint32_t* head;  // [row_count] first entry of a row, or kNoEntry. Entry 4 t + r is row r of tie t
  std::uint32_t* next;  // [4 (candidate_count + spring_count)] next entry of the same row, or kNoEntry

  TieReport<Real>* reports;  // [patch_count]

  TM_HOST_DEVICE std::uint32_t count() const { return candidate_count + spring_count; }
};

}  // namespace tensormass::view
