#pragma once

#include <cstdint>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// A box of cells_x × cells_y × cells_z equal cells from `origin_m` to `origin_m + size_m`, each cut into elements of
/// one shape, conforming across cells and positively wound:
///
///   tetrahedron            6 that share the cell's diagonal (Kuhn)
///   pyramid                6 from the faces of the cell to its centre
///   wedge                  2 along z, from the triangles on either side of a diagonal
///   hexahedron             the cell itself
///   quadratic tetrahedron  the 6 of the tetrahedron
///
/// Node (i, j, k) has the index i + (cells_x + 1) (j + (cells_y + 1) k): x fastest. After these come the centres of the
/// cells (pyramid) or the middles of the edges (quadratic tetrahedron), which are all other points of the grid of half
/// the spacing; both x fastest. Cells in the same order hold the elements: the first six tetrahedra are of cell 0.
/// Errors: no cells in a direction, a size that is not positive, coordinates or counts beyond core/limits.h.
Result<Mesh> make_grid(const Eigen::Vector3d& origin_m, const Eigen::Vector3d& size_m, std::uint32_t cells_x,
                       std::uint32_t cells_y, std::uint32_t cells_z, Shape shape = Shape::kTetrahedron);

}  // namespace tensormass::mesh
