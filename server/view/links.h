#pragma once

#include <cstdint>

#include "core/scalar.h"
#include "view/blades.h"

/// Links: springs between a node and a point of a triangle, or another node, or between points of two edges. Contact
/// between bodies and attachments are made of links (contact/links.h), and so are the pins by which blade points hold
/// tissue (contact/blades.h). In a scene without them all pointers are nullptr and all counts zero.
namespace tensormass::view {

inline constexpr std::uint32_t kNoEntry = 0xFFFFFFFFu;

/// Triangles of a leaf, and leaves of a group: the two levels of boxes around a body's surface.
inline constexpr std::uint32_t kLeafTriangles = 16;
inline constexpr std::uint32_t kGroupLeaves = 16;

/// One link in this step. The force on its node, after a motion d of the four rows until the end of the step, is
/// force − S Σ weight · d with S = stiffness n nᵀ + across (I − n nᵀ). The corners receive it in proportion to their
/// weights.
template <class Real>
struct Link {
  // The node, then the corners of the triangle, or the other node. Of two edges: the ends of each.
  std::uint32_t rows[4];
  Real weight[4];  // 1, then minus the barycentric coordinates: they add up to zero. Zero: no such corner. Of a pin:
                   // barycentric coordinates in a tetrahedron, which add up to 1
  Real normal[3];  // n
  Real force[3];   // [N]
  Real stiffness;  // [N/m]; zero: the link does nothing in this step
  Real across;     // [N/m]; of a contact without stiffness: contact::NodeSide
};

/// What became of a spring, in LinksView::broken. Whole and broken count in snapshots, the cause only in events.
enum SpringState : std::uint32_t {
  kSpringWhole,
  kSpringBroken,   // pulled too hard, or severed by an edit
  kSpringSevered,  // by tool 0; one more by tool 1, and so on
};

/// A box along the axes. Empty: least > most.
template <class Real>
struct AxisBox {
  Real least[3], most[3];
};

/// What the links of a patch did in the last step.
template <class Real>
struct LinkReport {
  Real contacts;   // nodes that touch a surface, and pairs of edges that touch
  Real deepest_m;  // largest penetration
  Real broken;     // springs that have broken so far
  Real pressed_n;  // sum of normal forces of contacts, each the larger of before and after the step
  Real changed_n;  // sum of what they changed by
};

/// Numbers of a side in LinksView::side_numbers.
/// kSidePenalty: as the scene gives it; else kSidePenaltyPerM times the smaller of two moduli. The other of them is 0.
enum SideNumber : std::uint32_t {
  kSidePenalty,
  kSidePenaltyPerM,
  kSideDistance,
  kSideReach,
  kSideFriction,
  kSideNumbers
};

/// Links of a pin: along the cutting direction, and across the blade's flat.
inline constexpr std::uint32_t kPinLinks = 2;

/// Pairs that a sharp edge can touch at once.
inline constexpr std::uint32_t kEdgeSlots = 4;

/// Numbers of a sharp edge in EdgesView::numbers.
enum EdgeNumber : std::uint32_t {
  kEdgeArea,       // a third of the two triangles at the edge [m²]
  kEdgeModulus,    // E of the elements behind them, their mean [Pa]
  kEdgeWidth,      // the smaller of the distances from the edge to the third corners [m]
  kEdgeFirstEnds,  // 1: the ridge ends at the edge's first end; 0: another sharp edge continues it there
  kEdgeLastEnds,
  kEdgeNumbers
};

/// What a pair of edges remembers from step to step, in EdgesView::memory.
enum EdgeMemory : std::uint32_t {
  kEdgeStretch,      // three: stretch of the spring of friction [m]
  kEdgeForce = 3,    // normal force [N], both at the end of the last step
  kEdgePartner = 4,  // the other edge + 1; 0: the slot is free
  kEdgeMemory
};

/// Sharp convex edges of bodies, which can touch those of another body (contact/edge_contact.h).
template <class Real>
struct EdgesView {
  std::uint32_t candidate_count;  // edges that may touch those of another body

  const std::uint32_t* rows;            // [edge, 4] first end, last end, third corner to the left and to the right
  const Real* numbers;                  // [edge, kEdgeNumbers]
  const std::uint32_t* triangle_edges;  // [triangle_count, 3] edges that a triangle shows to a search, or kNoEntry

  // Candidates, grouped by the patch of their first row.
  const std::uint32_t* patch_candidates;  // [patch_count + 1]
  const std::uint32_t* candidates;        // [candidate_count, 2] edge, side

  std::uint32_t* partners;  // [candidate_count, kEdgeSlots] other edge of each link of this step
  Real* memory;             // [candidate_count, kEdgeSlots, kEdgeMemory] a part of LinksView::slips
  Real* checkpoint_memory;

  TM_HOST_DEVICE std::uint32_t slot_count() const { return candidate_count * kEdgeSlots; }
};

template <class Real>
struct LinksView {
  std::uint32_t candidate_count;  // nodes that may touch a surface
  std::uint32_t spring_count;

  // Rows that a link may have, grouped by patch.
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
                // was (contact::NodeSide). At the end of the last step. Then what pairs of edges remember
                // (EdgesView::memory), and what blade points do (BladesView::memory)
  Real* checkpoint_slips;

  // Springs, grouped by the patch of their first row.
  const std::uint32_t* patch_springs;  // [patch_count + 1]
  const std::uint32_t* spring_rows;    // [spring_count, 2]
  const Real* spring_numbers;          // [spring_count, 3] stiffness [N/m], length at rest [m], breaking force [N]
  Real* broken;                        // [spring_count] SpringState, for a severed one plus the place of the tool
  Real* checkpoint_broken;

  EdgesView<Real> edges;

  // The links of this step: those of the candidates, the springs, the slots of edges, and the pins of blade points.
  Link<Real>* links;    // [count()]
  std::uint32_t* head;  // [row_count] first entry of a row, or kNoEntry. Entry 4 t + r is row r of link t
  std::uint32_t* next;  // [4 count()] next entry of the same row, or kNoEntry

  LinkReport<Real>* reports;  // [patch_count]
  BladesView<Real> blades;

  TM_HOST_DEVICE std::uint32_t first_edge_link() const { return candidate_count + spring_count; }
  TM_HOST_DEVICE std::uint32_t first_pin() const { return first_edge_link() + edges.slot_count(); }
  TM_HOST_DEVICE std::uint32_t count() const { return first_pin() + kPinLinks * blades.point_count; }
};

}  // namespace tensormass::view
