#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/layout.h"
#include "matrix/row_lists.h"

/// Linear tetrahedra for the inversion check at the end of a solve.
///
/// Why: such a solve keeps the vectors of its patch in shared memory, so a check there reads no vectors from memory.
/// Each tetrahedron goes to one patch which has all four nodes among its rows and its halo.
namespace tensormass::matrix {

struct PatchTetrahedra {
  /// [2 patch_count + 1] into tetrahedra. Patch p has two ranges: 2p for those with own rows only, 2p + 1 for the
  /// others.
  std::vector<std::uint32_t> begin;
  /// [tetrahedron, 4] local numbers, own rows before the halo. The order of the nodes keeps the sign of the volume.
  std::vector<std::uint16_t> rows;
};

/// Shares the linear tetrahedra of all groups out among patches, about equally many to each. Asserts that local numbers
/// fit into 16 bits.
PatchTetrahedra share_out_tetrahedra(const Layout& layout, std::span<const ElementRows> groups);

}  // namespace tensormass::matrix
