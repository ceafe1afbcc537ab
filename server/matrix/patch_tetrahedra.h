#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/layout.h"
#include "matrix/row_lists.h"

namespace tensormass::matrix {

/// Linear tetrahedra shared out among patches, for a solve that looks at their volume where it ends: each once, and to
/// a patch that has all of its nodes among its rows and its halo.
struct PatchTetrahedra {
  /// [2 patch_count + 1] for each patch those of own rows only, then the others
  std::vector<std::uint32_t> begin;
  /// [tetrahedron, 4] patch-local: own rows, then the halo; in an order that leaves volumes their sign
  std::vector<std::uint16_t> rows;
};

/// The elements of some groups of linear tetrahedra, about equally many for each patch. No patch may have more than
/// 2^16 rows and rows of its halo.
PatchTetrahedra share_out_tetrahedra(const Layout& layout, std::span<const ElementRows> groups);

}  // namespace tensormass::matrix
