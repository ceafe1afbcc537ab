#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/edges.h"
#include "matrix/tiles.h"
#include "mesh/adjacency.h"
#include "mesh/mesh.h"
#include "view/scene.h"

/// The host's side of view/scene.h: rows, patches and the sliced matrix structure of a mesh.
namespace tensormass::matrix {

using namespace view;

/// Where the blocks of the matrix off its diagonal are.
enum class Storage : std::uint8_t {
  kRows,   ///< in each row all of its own: what a GPU thread walks (view.h), in the order of banks.h
  kTiles,  ///< the same, with each row ordered for a warp that streams the matrix (tiles.h)
  kEdges,  ///< within a patch once for both rows: half of the memory, for one thread a patch (edges.h)
};

struct Layout {
  Storage storage = Storage::kRows;
  std::uint32_t patch_count = 0;
  std::uint32_t row_count = 0;                ///< padding included; a multiple of kSliceRows
  std::vector<std::uint32_t> row_of_node;     ///< [node_count]
  std::vector<std::uint32_t> node_of_row;     ///< [row_count]; mesh::kNone for a padding row
  std::vector<std::uint32_t> patch_rows;      ///< [patch_count + 1]
  std::vector<std::uint32_t> patch_halo;      ///< [patch_count + 1]
  std::vector<std::uint32_t> halo;            ///< rows of other patches; but for kRows ascending within a patch
  std::vector<std::uint32_t> slice_begin;     ///< [row_count / slice_rows() + 1]
  std::vector<std::uint32_t> slice_halo;      ///< [row_count / slice_rows()] of kEdges where a slice's halo begins
  std::uint32_t tile_rows = 0;                ///< of kTiles: of each tile but the last of a patch
  std::vector<std::uint32_t> slice_read;      ///< [row_count / kSliceRows] of kTiles where what a slice reads ends
  std::vector<std::uint32_t> used_twice;      ///< [column of slots] of kTiles, see order_tile
  std::vector<std::uint32_t> columns;         ///< [slot] patch-local
  std::vector<std::uint32_t> neighbour_rows;  ///< [slot] global row; mesh::kNone for a padding slot

  std::vector<std::uint32_t> patch_boundary;  ///< [patch_count + 1] of kEdges into boundary
  std::vector<std::uint32_t> boundary;        ///< patch-local rows that are in the halo of others, ascending in a patch

  std::uint32_t widest_slice() const;   ///< in columns
  std::uint32_t largest_patch() const;  ///< in rows, its halo's included
  std::uint32_t slice_rows() const { return storage == Storage::kEdges ? kEdgeSliceRows : kSliceRows; }
  std::uint32_t slot_count() const { return static_cast<std::uint32_t>(columns.size()); }
  /// Slots whose blocks a solve has to read in each iteration.
  std::uint32_t read_slot_count() const;
  std::uint32_t patch_of_row(std::uint32_t row) const;
  std::vector<std::uint32_t> patch_of_slice() const;  ///< [row_count / kSliceRows]
  bool in_one_patch(std::uint32_t row, std::uint32_t other) const;
  /// The slot of `row` that couples it to `other`, a neighbour; kNoPlace if the edge is stored with `other`.
  std::uint32_t slot(std::uint32_t row, std::uint32_t other) const;
  /// Calls visit(slot, transposed) for each slot that holds A_kl of two neighbours, or its transpose.
  template <class Visit>
  void for_each_place(std::uint32_t row_k, std::uint32_t row_l, const Visit& visit) const {
    if (const std::uint32_t place = slot(row_k, row_l); place != kNoPlace) visit(place, false);
    if (const std::uint32_t place = slot(row_l, row_k); place != kNoPlace) visit(place, true);
  }
  /// Where component `c` of a slot's block lies in an array of assembled blocks.
  std::size_t component(std::uint32_t slot, std::uint32_t c) const {
    return storage != Storage::kEdges ? block_begin(slot) + std::size_t{c} * kSliceRows : edge_begin(slot) + c;
  }
};

Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count, Storage storage = Storage::kRows);

/// For kEdges: which elements a patch computes, namely all that touch its rows. Elements on the border of patches are
/// computed by each of them, and no patch writes to another's rows.
struct PatchElements {
  std::vector<std::uint32_t> order;   ///< [place] index of the element; mesh::kNone for padding
  std::vector<std::uint32_t> ranges;  ///< [patch_count, 2] places; each begins at a multiple of kSliceRows
};
/// rows: [element][node_count]
PatchElements order_by_patch(const Layout& layout, std::span<const std::uint32_t> rows, std::size_t node_count);
/// ElementView::pair_places of elements in that order; rows: [node_count][stride].
std::vector<std::uint32_t> pair_places(const Layout& layout, const PatchElements& elements,
                                       std::span<const std::uint32_t> rows, std::size_t node_count);

}  // namespace tensormass::matrix
