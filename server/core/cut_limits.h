#pragma once

#include <cstddef>
#include <cstdint>

/// Limits of cuts. Error messages name the limit by its identifier.
namespace tensormass::limits {

/// Points of a blade, and positions of it in one cut; a cut with more is refused.
inline constexpr std::size_t kMaxBladePoints = 32, kMaxBladePositions = 1024;
/// Cuts of a body until a reset; a further one is refused. Whoever joins a scene has all of them made again.
inline constexpr std::size_t kMaxCutsOfBody = 1024;
/// Triangles that cuts add to what tools touch; a cut that needs more is refused.
inline constexpr std::uint32_t kMaxCarriedTriangles = 1'000'000;
/// Edges of a body's mesh that one cut may cross; a cut of more is refused.
inline constexpr std::uint32_t kMaxEdgesOfCut = 1'000'000;

/// Blades of one scene (scissors are two), and tetrahedra that they may cut; a scene with more is refused. A blade
/// point remembers its tetrahedron as a number that single precision has.
inline constexpr std::size_t kMaxBlades = 4, kMaxBladeTetrahedra = (std::size_t{1} << 24) - 1;

}  // namespace tensormass::limits
