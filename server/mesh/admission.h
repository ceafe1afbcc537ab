#pragma once

#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "core/findings.h"
#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Smallest accepted ratio of an element's least Jacobian (as a tetrahedron's volume, geometry.h) to its longest edge
/// cubed. Below it, the element is refused as flat: its rest shape cannot be inverted in single precision. A regular
/// tetrahedron has 0.118.
inline constexpr double kMinRelativeVolume = 1e-9;

/// Facts about an admitted mesh.
struct MeshReport {
  std::uint32_t node_count = 0;
  std::uint32_t element_count = 0;
  std::uint32_t component_count = 0;  ///< parts that share no node
  double volume_m3 = 0.0;
  double min_dihedral_angle_deg = 0.0;
  std::uint32_t min_dihedral_element = 0;
  std::vector<Finding> findings;
};

/// Checks a mesh from outside the server. `body` names the mesh in messages.
///
/// Why here: everything behind this function assumes a sound mesh and does not check again. The checks build on each
/// other, so a group runs only if what it relies on has passed:
///
///   sizes, coordinates, indices         the first failure is returned alone
///   each element by itself              repeated node, flat, inverted, folded (geometry.h)
///   elements against each other         duplicates; then, if there is no error so far, overlapping and nonconforming
///                                       faces (conformity.h)
///   nodes                               without an element
///   slivers, separate components        findings, not errors
///
/// The error has one line for each kind of problem. Each line says the first element or node concerned, how many there
/// are, and what to do.
///
/// Cost: O(n log n), about 0.4 s for a million tetrahedra and 0.7 s for a million hexahedra.
Result<MeshReport> admit(const Mesh& mesh, std::string_view body);

/// Facts about an admitted skin.
struct SkinReport {
  std::uint32_t vertex_count = 0;
  std::uint32_t triangle_count = 0;
  std::vector<Finding> findings;  ///< without the name of the owner: `body` and `tool` are empty
};

/// Checks a triangle surface from outside the server. `owner` names whose it is in messages: "body 'liver'".
///
///   errors     no vertices or triangles, counts beyond core/limits.h, an index out of range, a coordinate that is not
///              finite or too large, a triangle that repeats a vertex
///   findings   triangles without area and vertices without triangle, because they only look bad
Result<SkinReport> admit_skin(std::span<const Eigen::Vector3d> vertices, std::span<const Triangle> triangles,
                              std::string_view owner);

}  // namespace tensormass::mesh
