#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/layout.h"

/// Storage::kRows, kTiles: the elements that each row evaluates, and the places of their blocks within the row.
///
/// Why: a GPU thread owns a row and writes to no other, so no atomics are needed. It walks a list of the elements at
/// its row (matrix/rows.h). The lists of 32 rows are stored column by column, as the slices of the matrix are:
///
///                 list column 0         list column 1
///   row  0        element 5             element 9            places: for each node of the element the column of the
///   row  1        element 5             kNoPlace: ended               slot within the row's slice; own_place for the
///   ...                                                               row itself
namespace tensormass::matrix {

using namespace view;

/// The lists of one group; ElementView has the same members.
struct RowLists {
  /// Slices with elements of the group, the longest lists first. A device starts them in this order, so the last ones
  /// to finish are short.
  std::vector<ListedSlice> slices;
  std::vector<std::uint32_t> listed;  ///< [list column][kSliceRows] element; kNoPlace: the row's list has ended
  std::uint32_t place_bits = 8;       ///< bits of a place: 8, or 16 if slices are wide
  std::vector<std::uint32_t> places;  ///< [list column][words of places][kSliceRows]
};

/// The rows of the nodes of all elements of one shape.
struct ElementRows {
  std::uint32_t node_count = 0;         ///< nodes of an element
  std::uint32_t element_count = 0;      ///< without padding
  std::uint32_t stride = 0;             ///< with padding
  std::span<const std::uint32_t> rows;  ///< [node_count][stride]
};

struct GroupRowLists {
  std::vector<RowLists> groups;            ///< [group]
  std::vector<std::uint8_t> begun_slices;  ///< [slice] MatrixView::begun_slices; empty if groups finish all rows
};

/// Makes the lists of all groups.
///
/// groups:   those whose tensors are summed, in the order in which that is done.
/// finishes: true if no other tensors exist. The last group at a slice then forms its rows of A and b.
GroupRowLists make_row_lists(const Layout& layout, std::span<const ElementRows> groups, bool finishes);

}  // namespace tensormass::matrix
