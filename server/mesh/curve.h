#pragma once

#include <cstdint>
#include <span>

#include "mesh/elevate.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Smallest Jacobian of a curved element, as a share of the straight element's. Below it the element would cost the
/// solver more than the better surface gains.
inline constexpr double kMinCurvedJacobian = 0.25;

/// Farthest that an edge follows the surface, as a share of its length. An edge farther away has no surface beside it.
inline constexpr double kMaxCurvedDistance = 0.5;

/// Numbers of nodes on the boundary that `elevate` added.
struct Curved {
  std::uint32_t moved = 0;
  std::uint32_t straight = 0;  ///< stay in the middle: too far from the surface, or an element would fold
};

/// Curves the boundary of an elevated mesh to a triangle surface. Moves only nodes that `elevate` added.
///
///   d(x)   the way from x to the nearest point of the surface
///   n      the normal of the boundary at the middle x_m of an edge with the ends x_a, x_b
///   x_m moves by n n · (d(x_m) − (d(x_a) + d(x_b)) / 2)
///
/// If both ends lie on the surface, so does the new middle, up to second order in the angle between n and the surface.
/// Ends that lie beside it stay where they are, and the edge follows the surface at their distance: otherwise it would
/// bulge by that distance, not by the surface's curvature. Movement along n alone keeps the node in the middle, also
/// beyond the rim of a surface that covers only a part. Edges at a sharp rim of the body stay as they are, because the
/// surface next to it contains them.
///
/// An element needs kMinCurvedJacobian at its nodes and at its points of full quadrature. Otherwise all of its moved
/// nodes go back to the middle of their edges.
///
/// The surface must be admitted (admit_skin).
Curved curve(ElevatedMesh& elevated, std::span<const Eigen::Vector3d> vertices, std::span<const Triangle> triangles);

}  // namespace tensormass::mesh
