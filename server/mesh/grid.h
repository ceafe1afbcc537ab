#pragma once

#include <cstdint>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// Returns a box of cells_x × cells_y × cells_z equal cells from `origin_m` to `origin_m + size_m` [m]. Each cell is
/// cut into elements of one shape, conforming across cells and with positive volume.
///
///   tetrahedron            6 that share the cell's diagonal (Kuhn)
///   pyramid                6 from the faces of the cell to its centre
///   wedge                  2 along z, from the triangles on either side of a diagonal
///   hexahedron             the cell itself
///   quadratic tetrahedron  the 6 of the tetrahedron
///   quadratic hexahedron   the cell itself
///
/// Nodes are numbered with x fastest: corner (i, j, k) has the index i + (cells_x + 1) (j + (cells_y + 1) k). After the
/// corners come the cell centres (pyramid), or the edge middles (quadratic shapes), also with x fastest. The edge
/// middles of tetrahedra are all remaining points of the lattice with half the spacing; those of hexahedra have one odd
/// coordinate in it. Elements follow the order of cells: cell 0 holds tetrahedra 0 to 5.
///
/// Errors: no cells in a direction, a size that is not positive, coordinates or counts beyond core/limits.h.
Result<Mesh> make_grid(const Eigen::Vector3d& origin_m, const Eigen::Vector3d& size_m, std::uint32_t cells_x,
                       std::uint32_t cells_y, std::uint32_t cells_z, Shape shape = Shape::kTetrahedron);

}  // namespace tensormass::mesh
