#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "tensor/layout.h"

/// How a GPU's thread blocks turn elements into rows without an array of all elements' tensors.
///
/// A *tile* is one or two slices. Its block evaluates every element that touches its rows into shared memory and sums
/// up the rows' blocks from there. Elements between tiles are evaluated by each of them, about twice on average, which
/// costs less than writing and reading their records would. What does not fit at once, and what is of another group, is
/// a *part* of its own: parts of a tile add up in order.
namespace tensormass::tensor {

/// Of a group's tiles; empty where a backend gathers from `partials`.
struct GroupTiles {
  std::vector<TilePart> parts;            ///< by tile
  std::vector<std::uint32_t> tile_parts;  ///< [tiles that have parts + 1]
  std::vector<std::uint32_t> elements;    ///< of the group, part by part, ascending
  std::vector<std::uint16_t> lists;       ///< of each part: its slots, its rows, and an end; into its entries
  std::vector<std::uint16_t> entries;     ///< offsets in the tile's records, see TilePart
};

struct Tiles {
  std::vector<GroupTiles> groups;          ///< [group]
  std::vector<std::uint32_t> open_slices;  ///< twice the slice, + 1 if parts have written to its rows; see SceneView
};

/// groups: those with refreshed tensors. capacity_reals: of a tile's records, at most kMaxTileReals and at least one
/// element of any shape. finishes: no tensors but those of `groups` exist, so that a tile's last part ends its rows.
Tiles make_tiles(const Layout& layout, std::span<const ElementRows> groups, std::uint32_t capacity_reals,
                 bool finishes);

}  // namespace tensormass::tensor
