#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// An element is refused if its least Jacobian, as the volume of a tetrahedron (geometry.h), is below this fraction of
/// its longest edge cubed: its rest shape cannot be inverted in single precision. (A regular tetrahedron has 0.118.)
inline constexpr double kMinRelativeVolume = 1e-9;
/// Elements with a smaller dihedral angle [deg] are reported: they make the system stiff and the answer poor.
inline constexpr double kSliverDihedralDeg = 5.0;

/// What was admitted.
struct MeshReport {
  std::uint32_t node_count = 0;
  std::uint32_t element_count = 0;
  std::uint32_t component_count = 0;  ///< parts that share no node
  double volume_m3 = 0.0;
  double min_dihedral_angle_deg = 0.0;
  std::uint32_t min_dihedral_element = 0;
  std::vector<std::string> warnings;
};

/// Checks a mesh from outside: sizes, indices, finite coordinates, winding, the Jacobian at the nodes (geometry.h),
/// nodes without element, repeated nodes and elements, overlaps and faces that do not conform (conformity.h).
/// O(n log n), about 0.4 s for a million tetrahedra and 0.7 s for a million hexahedra.
///
/// The error has one line for each kind of problem; each names `body`, the first element or node concerned, how many
/// there are, and what to do. Slivers and separate components are warnings.
Result<MeshReport> admit(const Mesh& mesh, std::string_view body);

/// What was admitted of a skin.
struct SkinReport {
  std::uint32_t vertex_count = 0;
  std::uint32_t triangle_count = 0;
  std::vector<std::string> warnings;
};

/// Checks a triangle surface from outside: indices, finite coordinates, triangles that repeat a vertex. Triangles
/// without area and vertices without triangle are warnings: they are ugly, not wrong.
Result<SkinReport> admit_skin(std::span<const Eigen::Vector3d> vertices, std::span<const Triangle> triangles,
                              std::string_view body);

}  // namespace tensormass::mesh
