#pragma once

#include <cstdint>

#include "core/result.h"
#include "mesh/mesh.h"

namespace tensormass::mesh {

/// A box of cells_x × cells_y × cells_z equal cells from `origin_m` to `origin_m + size_m`, each cell cut into six
/// tetrahedra that share its diagonal (Kuhn), conforming across cells and positively wound.
///
/// Node (i, j, k) has the index i + (cells_x + 1) (j + (cells_y + 1) k): x fastest. Cell (i, j, k) in the same order
/// holds the elements 6 c to 6 c + 5.
/// Errors: no cells in a direction, a size that is not positive, coordinates or counts beyond core/limits.h.
Result<Mesh> make_grid(const Eigen::Vector3d& origin_m, const Eigen::Vector3d& size_m, std::uint32_t cells_x,
                       std::uint32_t cells_y, std::uint32_t cells_z);

}  // namespace tensormass::mesh
