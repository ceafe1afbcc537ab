#pragma once

#include <cstdint>

#include "core/limits.h"
#include "physics/tool/tool.h"

/// The tissue's surface and the tools that touch it (contact/). In a scene without tools all pointers are nullptr and
/// all counts zero.
namespace tensormass::view {

inline constexpr std::uint32_t kNoTriangle = 0xFFFFFFFFu;

/// Contact of one tool with one triangle in this step, at one point of it.
template <class Real>
struct TriangleContact {
  Real weight[3];  // barycentric coordinates of the contact point
  Real normal[3];  // direction in which the tissue is pushed
  Real depth_m;    // penetration; not positive only in a contact that acts across a gap (contact/touch.h)
  Real loaded_m;   // depth that carries its load when it tilts: depth_m, or across a gap that of the last step
  Real stiffness;  // [N/m]; zero: no contact
  Real lever_m;    // distance from the tool's core to the contact point; zero if the core is behind the surface
  // The core lies along the triangle, and the contact point moves along it when the triangle tilts (contact/line.h):
  Real line[3];         // weights of the motion that moves it, at the corners
  Real line_stiffness;  // [N/m] against that motion along the normal; zero: the point stays
};

/// Friction at a TriangleContact in this step (contact/friction.h).
template <class Real>
struct TriangleFriction {
  Real ahead_m[3];  // stretch of the spring at the end of the step if the tissue stood still
  Real stiffness;   // [N/m] of the spring, or less where it slips
};

/// Distance from a core point of a tool to a patch's closest triangle, and where the patch's triangles cross the core
/// between this point and the next.
template <class Real>
struct ClosestTriangle {
  Real distance_squared;
  Real side;                           // +1: the point is outside the tissue, −1: inside
  Real first_crossing, last_crossing;  // 0 at this core point, 1 at the next; first > last: the patch has no crossing
  std::uint32_t triangle;              // kNoTriangle: the patch has none
};

/// Force and torque of a patch's tissue on a tool.
template <class Real>
struct ToolLoad {
  Real force_n[3];
  Real torque_n_m[3];                   // about PlacedTool::position_m
  Real friction_n[3];                   // the part of the force that is friction
  Real joints[limits::kMaxToolJoints];  // [N m or N] force along each joint
  Real pressed_n;                       // Σ N over the contacts that push
  Real pressed_moduli[2];               // Σ N E and Σ N E / (1 − ν²) over them [N Pa]
  ClosestTriangle<Real> tip;            // that of core point 0 in the patch; a solid has none
};

/// Triangles that elements carry: faces of cuts, and what cuts leave of outer triangles (contact/carried.h). Their
/// corners are points of one linear tetrahedron, sums of its rows by weights. In a scene without cuts all pointers but
/// `weights` are nullptr.
template <class Real>
struct CarriedView {
  std::uint32_t first;  // the first of them: they come after the other triangles. ContactView::triangle_count: none
  const std::uint32_t* rows;             // [carried, 4] of the element
  const Real* weights;                   // [carried, 3, 4] of each corner; they sum to 1
  const std::uint32_t* twins;            // [carried] its triangle on the other face of the cut; kNoTriangle: outer skin
  const std::uint32_t* patch_triangles;  // [patch_count + 1] numbers of triangles
  // Rows gather what the triangles of their elements feel. Those of surface vertices come first, the others after them:
  const std::uint32_t* patch_rows;   // [patch_count + 1] rows without a surface vertex
  const std::uint32_t* entry_begin;  // [surface vertex, then such a row + 1] into entries
  const std::uint32_t* entries;      // [.., 5]: triangle, place k of the row in `rows`, slots of k + 1, k + 2, k + 3
  // Carried triangles around vertices:
  const std::uint32_t* around_begin;  // [surface vertex, then vertex that only they have + 1] into around
  const std::uint32_t* around;        // [.., 2]: triangle, corner
};

template <class Real>
struct ContactView {
  std::uint32_t tool_count;
  std::uint32_t triangle_count;  // with carried ones
  std::uint32_t contact_points;  // contacts that a triangle can have, with all tools

  const std::uint32_t* triangle_rows;        // [triangle_count, 3], without carried ones
  const std::uint32_t* triangle_neighbours;  // [triangle_count, 3] across the edges 01, 12, 20; kNoTriangle at a rim
  const std::uint32_t* patch_triangles;      // [patch_count] first triangle
  const std::uint32_t* triangles_end;        // [patch_count] last triangle + 1; behind it a scene with editing has room
  const Real* triangle_area;                 // [triangle_count] m², at rest
  const Real* triangle_moduli;               // [triangle_count, 2] of the element behind it: E, E / (1 − ν²) [Pa]
  const std::uint32_t* surface_rows;         // [surface vertex], grouped by patch
  const std::uint32_t* patch_surface;        // [patch_count] into surface_rows
  const std::uint32_t* surface_end;          // [patch_count]
  const std::uint32_t* incidence_begin;      // [surface vertex]
  const std::uint32_t* incidence_end;        // [surface vertex]
  const std::uint32_t* incidence;  // [.., 4]: triangle, corner, slots of the two following corners, or kNoPlace
  // [triangle_count, 3] surface vertex; numbers of vertices that only carried triangles have follow those
  const std::uint32_t* vertex_of_corner;
  std::uint32_t vertex_count;  // surface vertices
  CarriedView<Real> carried;

  const physics::PlacedTool<Real>* tools;  // [tool_count]
  ClosestTriangle<Real>* closest;          // [core points of all tools, patch_count]
  TriangleContact<Real>* contacts;         // [contact_points, triangle_count]
  ToolLoad<Real>* tool_loads;              // [tool_count, patch_count]

  const float* samples;  // signed distances of all sampled tools (physics/tool/mesh_solid.h)

  TriangleFriction<Real>* frictions;  // [contact_points, triangle_count]; nullptr: no tool has friction
  // What contacts remember; nullptr: all tools are obstacles without friction that keep no force.
  Real* slips;             // [contact_points, triangle_count, 4] stretch of the spring of friction in the frame of the
                           // tool's shape [m]; 4th: normal force [N]. Both at the end of the last step
  Real* checkpoint_slips;  // the same before the step that saved the checkpoint
};

}  // namespace tensormass::view
