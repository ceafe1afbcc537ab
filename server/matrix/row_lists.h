#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/layout.h"

/// Which elements each row evaluates, and where their blocks belong in the row: the host's side of matrix/rows.h.
namespace tensormass::matrix {

using namespace view;

/// Of a group, as ElementView has them.
struct RowLists {
  /// The longest lists first: a device begins them in this order, and what it begins last should not keep it waiting.
  std::vector<ListedSlice> slices;
  std::vector<std::uint32_t> listed;
  std::uint32_t place_bits = 8;
  std::vector<std::uint32_t> places;
};

/// Rows of the elements of one shape: rows[k][e] as in ElementView, of which the first `element_count` are real.
struct ElementRows {
  std::uint32_t node_count = 0;  ///< of the shape
  std::uint32_t element_count = 0;
  std::uint32_t stride = 0;
  std::span<const std::uint32_t> rows;
};

struct GroupRowLists {
  std::vector<RowLists> groups;            ///< [group]
  std::vector<std::uint8_t> begun_slices;  ///< see SceneView; empty if groups finish all rows
};

/// groups: those with refreshed tensors, in the order in which they are evaluated. finishes: no tensors but theirs
/// exist, so that the last group at a slice ends its rows.
GroupRowLists make_row_lists(const Layout& layout, std::span<const ElementRows> groups, bool finishes);

}  // namespace tensormass::matrix
