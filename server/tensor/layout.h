#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/adjacency.h"
#include "mesh/mesh.h"
#include "tensor/view.h"

/// The host's side of tensor/view.h: rows, patches, the sliced matrix structure and the gather maps of a mesh.
namespace tensormass::tensor {

struct Layout {
  std::uint32_t patch_count = 0;
  std::uint32_t row_count = 0;                ///< padding included; a multiple of kSliceRows
  std::vector<std::uint32_t> row_of_node;     ///< [node_count]
  std::vector<std::uint32_t> node_of_row;     ///< [row_count]; mesh::kNone for a padding row
  std::vector<std::uint32_t> patch_rows;      ///< [patch_count + 1]
  std::vector<std::uint32_t> patch_halo;      ///< [patch_count + 1]
  std::vector<std::uint32_t> halo;            ///< rows of other patches, ascending within a patch
  std::vector<std::uint32_t> slice_begin;     ///< [row_count / kSliceRows + 1]
  std::vector<std::uint32_t> columns;         ///< [slot] patch-local
  std::vector<std::uint32_t> neighbour_rows;  ///< [slot] global row; mesh::kNone for a padding slot

  std::uint32_t slot_count() const { return static_cast<std::uint32_t>(columns.size()); }
  std::uint32_t patch_of_row(std::uint32_t row) const;
  std::vector<std::uint32_t> patch_of_slice() const;  ///< [row_count / kSliceRows]
  /// The slot that couples `row` to `other`; both must be neighbours.
  std::uint32_t slot(std::uint32_t row, std::uint32_t other) const;
};

Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count);

/// Where each row and slot finds its share of the records in `partials`.
struct GatherMap {
  std::vector<std::uint32_t> force_begin{0}, force;  ///< [row_count + 1] and offsets
  /// [2 slot_count + 1] and offsets: of each slot first the blocks as they are, then those to be transposed.
  std::vector<std::uint32_t> edge_begin{0}, edge;
};

/// Rows of the elements of one shape: rows[k][e] as in ElementView, of which the first `element_count` are real.
struct ElementRows {
  std::uint32_t node_count = 0;  ///< of the shape
  std::uint32_t element_count = 0;
  std::uint32_t stride = 0;
  std::span<const std::uint32_t> rows;
  std::uint32_t partial_begin = 0;
};

GatherMap make_gather_map(const Layout& layout, std::span<const ElementRows> groups);

}  // namespace tensormass::tensor
