#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "matrix/edges.h"
#include "matrix/tiles.h"
#include "mesh/adjacency.h"
#include "mesh/mesh.h"
#include "view/scene.h"

/// The layout of a scene: which row each node gets, which patch owns it, and where the matrix stores each block.
///
/// Why: a step reads the matrix in every iteration, so its time is the time of those reads. Nodes that are neighbours
/// get rows that are close together, rows of equal length form slices, and each thread finds its blocks side by side.
///
///   mesh nodes --partition--> patches --sort by length--> rows --cut every 32--> slices --column by column--> slots
///
///   patch 0, rows 0 .. 63                     patch 1, rows 64 .. 127
///   +-----------------------------+           +---------------------------------+
///   | slice 0 | columns 0 .. 13   |  halo:    | slice 2 | columns 27 .. 39      |   a slot of row i holds A_ij and
///   | slice 1 | columns 14 .. 26  |  70, 91   | slice 3 | columns 40 .. 51      |   names the neighbour j
///   +-----------------------------+           +---------------------------------+
///
/// Words, as in view/patches.h and view/matrix.h:
///   row     a node after renumbering; gap rows fill up the last slice of a patch
///   slice   kSliceRows = 32 rows of one patch (kEdges: kEdgeSliceRows = 8)
///   column  of the layout: one slot for each row of a slice
///   slot    column · rows of a slice + row within the slice; place of one 3×3 block A_ij. A padding slot has no block.
///   halo    rows of other patches that a patch reads
///   local   numbering within a patch: its own rows from 0, then its halo
namespace tensormass::matrix {

using namespace view;

/// How the blocks off the diagonal are stored.
enum class Storage : std::uint8_t {
  kRows,   ///< each row stores all of its blocks, ordered by bank (banks.h): for GPU threads
  kTiles,  ///< the same, ordered for a warp that streams the matrix from memory (tiles.h)
  kEdges,  ///< A_ij of two rows of a patch is stored once, half the memory: for one CPU thread a patch (edges.h)
};

struct Layout {
  Storage storage = Storage::kRows;
  std::uint32_t patch_count = 0;
  std::uint32_t row_count = 0;                ///< with gap rows; a multiple of kSliceRows
  std::vector<std::uint32_t> row_of_node;     ///< [node_count]
  std::vector<std::uint32_t> node_of_row;     ///< [row_count]; mesh::kNone: a gap row
  std::vector<std::uint32_t> patch_rows;      ///< [patch_count + 1] first row of each patch
  std::vector<std::uint32_t> patch_halo;      ///< [patch_count + 1] into halo
  std::vector<std::uint32_t> halo;            ///< rows; kTiles, kEdges: ascending within a patch; kRows: by bank
  std::vector<std::uint32_t> slice_begin;     ///< [row_count / slice_rows() + 1] first column of each slice
  std::vector<std::uint32_t> columns;         ///< [slot] local number of the neighbour; padding: of the row itself
  std::vector<std::uint32_t> neighbour_rows;  ///< [slot] row of the neighbour; mesh::kNone: padding

  // kEdges only:
  std::vector<std::uint32_t> slice_halo;      ///< [slice] first column of edges to the halo
  std::vector<std::uint32_t> patch_boundary;  ///< [patch_count + 1] into boundary
  std::vector<std::uint32_t> boundary;  ///< local rows that are in the halo of another patch; ascending in a patch

  // kTiles only:
  std::uint32_t tile_rows = 0;            ///< rows of a tile; the last tile of a patch may have fewer
  std::vector<std::uint32_t> slice_read;  ///< [slice] end of the columns that a solve must read
  std::vector<std::uint32_t> used_twice;  ///< [column] bit i: the block of row i also serves its neighbour (order_tile)

  std::uint32_t widest_slice() const;   ///< [columns]
  std::uint32_t largest_patch() const;  ///< [rows] with its halo
  std::uint32_t slice_rows() const { return storage == Storage::kEdges ? kEdgeSliceRows : kSliceRows; }
  std::uint32_t slot_count() const { return static_cast<std::uint32_t>(columns.size()); }
  /// Returns how many slots a solve reads in each iteration: with tiles fewer than there are.
  std::uint32_t read_slot_count() const;
  std::uint32_t patch_of_row(std::uint32_t row) const;
  std::vector<std::uint32_t> patch_of_slice() const;  ///< [row_count / kSliceRows] also with kEdges
  bool in_one_patch(std::uint32_t row, std::uint32_t other) const;
  /// Returns the slot of `row` that couples it to its neighbour `other`. Returns kNoPlace if only `other` stores the
  /// edge, which happens with kEdges alone. Asserts that the rows are coupled.
  std::uint32_t slot(std::uint32_t row, std::uint32_t other) const;
  /// Calls visit(slot, transposed) for each slot that stores A_kl of two neighbours (transposed false) or A_lk (true).
  template <class Visit>
  void for_each_place(std::uint32_t row_k, std::uint32_t row_l, const Visit& visit) const {
    if (const std::uint32_t place = slot(row_k, row_l); place != kNoPlace) visit(place, false);
    if (const std::uint32_t place = slot(row_l, row_k); place != kNoPlace) visit(place, true);
  }
  /// Returns the index of component `c` of a slot's block in an array of blocks, as they are assembled.
  std::size_t component(std::uint32_t slot, std::uint32_t c) const {
    return storage != Storage::kEdges ? block_begin(slot) + std::size_t{c} * kSliceRows : edge_begin(slot) + c;
  }
};

/// Makes the layout of a mesh and checks it. Needs patch_count ≥ 1. Deterministic.
Layout make_layout(const mesh::Mesh& mesh, std::uint32_t patch_count, Storage storage = Storage::kRows);
/// The same for nodes that are coupled otherwise than by elements of a mesh alone. neighbours: [node], as of
/// mesh::node_neighbours.
Layout make_layout(std::span<const Eigen::Vector3d> nodes, const mesh::Rows& neighbours, std::uint32_t patch_count,
                   Storage storage);

/// Asserts what kernels rely on without checking: sizes, ascending offsets, patches that end at slices, columns that
/// name the row which their slot says. O(slots); make_layout calls it once a scene.
void check_layout(const Layout& layout);

}  // namespace tensormass::matrix
