#include "matrix/tiles.h"

#include <algorithm>
#include <array>
#include <numeric>
#include <vector>

#include "core/assert.h"
#include "matrix/layout.h"
#include "mesh/mesh.h"

/// Orders one tile in three steps (tiles.h says what for):
///
///   share_pairs   decides which row of each pair reads it: the row that reads less. even_out then moves pairs along
///                 paths of rows, so that no row makes its slice wider than it must be. spread_pairs limits how many
///                 rows of a slice add to one partner row.
///   EdgeColours   colours the pairs of a slice, a graph between its 32 lanes and the tile's rows: the colour of a pair
///                 is its column. Pairs of one colour share neither lane nor partner row.
///   order_row     puts pairs into the columns of their colours, outer neighbours into the gaps, mirrored ones behind.
///
/// Row numbers in this file are local to the tile, and slots to the tile's part of the layout.
namespace tensormass::matrix {

namespace {

/// Colours the edges of a bipartite graph so that edges of one colour share no node. By König's theorem the largest
/// degree is enough colours.
///
/// An edge takes a colour a that is free at its left end and a colour b that is free at its right end. If a is not b,
/// the path of alternating colours a, b, a, .. from the right end swaps its two colours. Then a is free at both ends.
class EdgeColours {
 public:
  static constexpr std::uint32_t kFree = 0xFFFFFFFFu;

  EdgeColours(std::uint32_t left_count, std::uint32_t right_count, std::uint32_t colours)
      : colours_(colours),
        right_of_(std::size_t{left_count} * colours, kFree),
        left_of_(std::size_t{right_count} * colours, kFree) {}

  void add(std::uint32_t left, std::uint32_t right) {
    const std::uint32_t a = free_at(right_of_, left), b = free_at(left_of_, right);
    TM_ASSERT(a < colours_ && b < colours_, "there are as many colours as the largest degree");
    // The path cannot reach `left`: it arrives on the left by colour a, which is free there.
    path_.clear();
    for (std::uint32_t at = right; left_of(at, a) != kFree;) {
      const std::uint32_t next = left_of(at, a), beyond = right_of(next, b);
      path_.push_back({next, at, b});
      if (beyond == kFree) break;
      path_.push_back({next, beyond, a});
      at = beyond;
    }
    for (const Edge& edge : path_) {
      const std::uint32_t old = a + b - edge.colour;
      if (left_of(edge.right, old) == edge.left) left_of(edge.right, old) = kFree;
      if (right_of(edge.left, old) == edge.right) right_of(edge.left, old) = kFree;
    }
    for (const Edge& edge : path_) set(edge);
    set({left, right, a});
  }
  /// Returns the right end of the edge of this colour at `left`; kFree if there is no such edge.
  std::uint32_t right_of(std::uint32_t left, std::uint32_t colour) const {
    return right_of_[std::size_t{left} * colours_ + colour];
  }

 private:
  struct Edge {
    std::uint32_t left, right, colour;
  };
  std::uint32_t& right_of(std::uint32_t left, std::uint32_t colour) {
    return right_of_[std::size_t{left} * colours_ + colour];
  }
  std::uint32_t& left_of(std::uint32_t right, std::uint32_t colour) {
    return left_of_[std::size_t{right} * colours_ + colour];
  }
  std::uint32_t free_at(const std::vector<std::uint32_t>& ends, std::uint32_t node) const {
    const auto first = ends.begin() + static_cast<std::ptrdiff_t>(std::size_t{node} * colours_);
    return static_cast<std::uint32_t>(std::find(first, first + colours_, kFree) - first);
  }
  void set(const Edge& edge) {
    right_of(edge.left, edge.colour) = edge.right;
    left_of(edge.right, edge.colour) = edge.left;
  }

  const std::uint32_t colours_;
  std::vector<std::uint32_t> right_of_, left_of_;
  std::vector<Edge> path_;
};

/// The order of one tile. The constructor decides who reads which pair; write() orders the slots.
class TileOrder {
 public:
  explicit TileOrder(const TileSlots& tile)
      : tile_(tile), rows_(static_cast<std::uint32_t>(tile.widths.size()) * kSliceRows), read_(rows_, 0) {
    begins_.push_back(0);
    for (const std::uint32_t width : tile.widths) begins_.push_back(begins_.back() + width);
    sort_out();
    share_pairs();
  }

  void write(std::span<std::uint32_t> read_widths, std::span<std::uint32_t> used_twice) {
    std::fill(used_twice.begin(), used_twice.end(), 0);
    for (std::uint32_t slice = 0; slice < tile_.widths.size(); ++slice) {
      read_widths[slice] = order_slice(slice, used_twice.subspan(begins_[slice], tile_.widths[slice]));
    }
    for (const auto& [row, other] : read_by_both_) {
      for (const std::uint32_t reader : {row, other}) {
        const std::uint32_t slot = slot_of(reader, reader == row ? other : row);
        used_twice[slot / kSliceRows] &= ~(1u << slot % kSliceRows);
      }
    }
  }

 private:
  enum class Kind : std::uint8_t {
    kPadding,
    kOuter,     // the neighbour is outside of the tile
    kRead,      // a pair that this row reads
    kMirrored,  // a pair that the partner row reads
  };

  std::uint32_t slot(std::uint32_t row, std::uint32_t j) const {
    return (begins_[row / kSliceRows] + j) * kSliceRows + row % kSliceRows;
  }
  std::uint32_t row_of(std::uint32_t slot) const {
    const auto slice = std::upper_bound(begins_.begin(), begins_.end(), slot / kSliceRows) - begins_.begin() - 1;
    return static_cast<std::uint32_t>(slice) * kSliceRows + slot % kSliceRows;
  }
  std::uint32_t width(std::uint32_t row) const { return tile_.widths[row / kSliceRows]; }
  /// Calls visit(row, slot) for the slots of rows [first, last), row by row.
  template <class Visit>
  void for_each_slot(std::uint32_t first, std::uint32_t last, const Visit& visit) const {
    for (std::uint32_t row = first; row < last; ++row) {
      for (std::uint32_t j = 0; j < width(row); ++j) visit(row, slot(row, j));
    }
  }
  /// Returns the neighbour of a slot as a row of the tile; rows_ or more (it wraps) if it is outside of the tile.
  std::uint32_t other(std::uint32_t slot) const { return tile_.columns[slot] - tile_.first_row; }
  /// Returns the slot of a row that names another row of the tile.
  std::uint32_t slot_of(std::uint32_t row, std::uint32_t other_row) const {
    for (std::uint32_t j = 0; j < width(row); ++j) {
      const std::uint32_t at = slot(row, j);
      if (tile_.neighbour_rows[at] != mesh::kNone && other(at) == other_row) return at;
    }
    TM_ASSERT(false, "two neighbours of a tile name each other");
    return kNoPlace;
  }

  /// Finds the kind of each slot: all pairs are mirrored at first. Counts the outer neighbours of each row.
  void sort_out() {
    kinds_.resize(tile_.columns.size(), Kind::kPadding);
    for_each_slot(0, rows_, [&](std::uint32_t row, std::uint32_t at) {
      if (tile_.neighbour_rows[at] == mesh::kNone) return;
      const bool outer = other(at) >= rows_;
      kinds_[at] = outer ? Kind::kOuter : Kind::kMirrored;
      if (outer) ++read_[row];
    });
  }

  /// Lets that row of each pair read it which reads less so far. Ties alternate.
  void share_pairs() {
    for_each_slot(0, rows_, [&](std::uint32_t row, std::uint32_t at) {
      if (kinds_[at] != Kind::kMirrored || other(at) < row) return;
      const std::uint32_t partner = other(at);
      const bool reads = read_[row] != read_[partner] ? read_[row] < read_[partner] : (row + partner) % 2 == 0;
      kinds_[reads ? at : slot_of(partner, row)] = Kind::kRead;
      ++read_[reads ? row : partner];
    });
    even_out();
    spread_pairs();
  }

  /// Returns for each slice the fewest columns that it can read. They hold the outer neighbours of each row, and in
  /// total there is room for all pairs.
  std::vector<std::uint32_t> least_columns() const {
    std::vector<std::uint32_t> outer(tile_.widths.size(), 0);
    std::vector<std::uint32_t> count(rows_, 0);
    for_each_slot(0, rows_, [&](std::uint32_t row, std::uint32_t at) {
      if (kinds_[at] == Kind::kOuter) outer[row / kSliceRows] = std::max(outer[row / kSliceRows], ++count[row]);
    });
    const std::uint32_t all = std::accumulate(read_.begin(), read_.end(), 0u);
    for (std::uint32_t least = 0;; ++least) {
      std::uint32_t room = 0;
      std::vector<std::uint32_t> columns = outer;
      for (std::size_t slice = 0; slice < columns.size(); ++slice) {
        columns[slice] = std::min(std::max(columns[slice], least), tile_.widths[slice]);
        room += columns[slice] * kSliceRows;
      }
      if (room >= all) return columns;
    }
  }

  /// Moves pairs from rows that read more than least_columns() to rows with room. A breadth-first search finds a path
  /// of rows. Each row of the path hands one pair over to the next.
  void even_out() {
    const std::vector<std::uint32_t> columns = least_columns();
    std::vector<std::uint32_t> queue, through(rows_);  // through: the slot by which the search found a row
    for (std::uint32_t row = 0; row < rows_; ++row) {
      bool found = true;
      while (read_[row] > columns[row / kSliceRows] && found) {
        found = false;
        queue.assign(1, row);
        std::fill(through.begin(), through.end(), kNoPlace);
        for (std::size_t i = 0; i < queue.size() && !found; ++i) {
          for (std::uint32_t j = 0; j < width(queue[i]) && !found; ++j) {
            const std::uint32_t at = slot(queue[i], j);
            if (kinds_[at] != Kind::kRead || other(at) == row || through[other(at)] != kNoPlace) continue;
            through[other(at)] = at;
            queue.push_back(other(at));
            found = read_[other(at)] < columns[other(at) / kSliceRows];
          }
        }
        if (!found) continue;
        for (std::uint32_t at = through[queue.back()]; at != kNoPlace;) {
          const std::uint32_t from = row_of(at);
          hand_over(from, at);
          at = from == row ? kNoPlace : through[from];
        }
      }
    }
  }

  /// Limits how many rows of a slice add to one partner row to the width of the slice: the colours need no more columns
  /// than exist. The partner row reads the remaining pairs itself. That cannot break the limit of its own slice, which
  /// is wider.
  void spread_pairs() {
    for (std::uint32_t first = 0; first < rows_; first += kSliceRows) {
      std::vector<std::uint32_t> meeting(rows_, 0);
      for_each_slot(first, first + kSliceRows, [&](std::uint32_t row, std::uint32_t at) {
        if (kinds_[at] == Kind::kRead && ++meeting[other(at)] > width(row)) hand_over(row, at);
      });
    }
  }
  /// Lets the partner row read the pair of a slot that `row` has read so far.
  void hand_over(std::uint32_t row, std::uint32_t at) {
    kinds_[slot_of(other(at), row)] = Kind::kRead;
    kinds_[at] = Kind::kMirrored;
    ++read_[other(at)];
    --read_[row];
  }

  /// Orders the rows of a slice. Returns its number of read columns.
  std::uint32_t order_slice(std::uint32_t slice, std::span<std::uint32_t> used_twice) {
    const std::uint32_t first = slice * kSliceRows, last = first + kSliceRows;
    // Enough for the row that reads most, and for the partner row in which most pairs of the slice meet.
    std::uint32_t columns = 0;
    std::vector<std::uint32_t> meeting(rows_, 0);
    for_each_slot(first, last, [&](std::uint32_t row, std::uint32_t at) {
      columns = std::max(columns, read_[row]);
      if (kinds_[at] == Kind::kRead) columns = std::max(columns, ++meeting[other(at)]);
    });
    EdgeColours colours(kSliceRows, rows_, columns);
    for_each_slot(first, last, [&](std::uint32_t row, std::uint32_t at) {
      if (kinds_[at] == Kind::kRead) colours.add(row - first, other(at));
    });
    for (std::uint32_t row = first; row < last; ++row) order_row(row, columns, colours, used_twice);
    return columns;
  }

  /// Orders the slots of one row: the first `columns` are read.
  void order_row(std::uint32_t row, std::uint32_t columns, const EdgeColours& colours,
                 std::span<std::uint32_t> used_twice) {
    struct Item {
      std::uint32_t column, neighbour_row;
    };
    const std::uint32_t lane = row % kSliceRows, wide = width(row);
    std::vector<Item> outer, mirrored, ordered(wide, Item{tile_.first_row + row, mesh::kNone});
    std::vector<Kind> kinds(wide, Kind::kPadding);
    const auto put = [&](std::uint32_t j, const Item& item, Kind kind) {
      ordered[j] = item;
      kinds[j] = kind;
    };
    for (std::uint32_t j = 0; j < wide; ++j) {
      const std::uint32_t at = slot(row, j);
      const Item item{tile_.columns[at], tile_.neighbour_rows[at]};
      if (kinds_[at] == Kind::kOuter) outer.push_back(item);
      if (kinds_[at] == Kind::kMirrored) mirrored.push_back(item);
      if (kinds_[at] != Kind::kRead) continue;
      std::uint32_t colour = 0;
      while (colour < columns && colours.right_of(lane, colour) != other(at)) ++colour;
      TM_ASSERT(colour < columns, "each pair that a row reads has a colour");
      put(colour, item, Kind::kRead);
      used_twice[colour] |= 1u << lane;
    }
    // Outer neighbours fill the gaps between the pairs. If the mirrored ones do not all fit behind, the surplus fills
    // gaps as well. Both rows then read such a pair, and neither block serves the other row.
    std::uint32_t free = columns;
    const std::uint32_t room = wide - columns;
    for (std::uint32_t j = 0; j < columns; ++j) {
      if (kinds[j] != Kind::kPadding) continue;
      if (!outer.empty()) {
        put(j, outer.back(), Kind::kOuter);
        outer.pop_back();
      } else if (mirrored.size() > room) {
        put(j, mirrored.back(), Kind::kMirrored);
        read_by_both_.push_back({row, mirrored.back().column - tile_.first_row});
        mirrored.pop_back();
      }
    }
    TM_ASSERT(outer.empty() && mirrored.size() <= room, "a row has a column for each of its neighbours");
    for (const Item& item : mirrored) put(free++, item, Kind::kMirrored);
    for (std::uint32_t j = 0; j < wide; ++j) {
      const std::uint32_t at = slot(row, j);
      tile_.columns[at] = ordered[j].column;
      tile_.neighbour_rows[at] = ordered[j].neighbour_row;
      kinds_[at] = kinds[j];
    }
  }

  const TileSlots& tile_;
  const std::uint32_t rows_;
  std::vector<std::uint32_t> begins_;  // [slice + 1] first column of each slice
  std::vector<std::uint32_t> read_;    // [row] slots that the row reads: outer neighbours and pairs
  std::vector<Kind> kinds_;            // [slot]
  std::vector<std::pair<std::uint32_t, std::uint32_t>> read_by_both_;
};

}  // namespace

std::uint32_t rows_of_tiles(std::uint32_t most_rows) {
  TM_ASSERT(most_rows > 0, "the largest patch has rows");
  const std::uint32_t rounds = (most_rows - 1) / (kTilesAtOnce * kMaxTileRows) + 1;
  const std::uint32_t tiles = rounds * kTilesAtOnce;
  return ((most_rows - 1) / tiles / kSliceRows + 1) * kSliceRows;
}

void order_tile(const TileSlots& tile, std::span<std::uint32_t> read_widths, std::span<std::uint32_t> used_twice) {
  TM_ASSERT(tile.columns.size() % kSliceRows == 0 && tile.columns.size() == tile.neighbour_rows.size(),
            "a column has a slot for each row of a slice");
  TM_ASSERT(read_widths.size() == tile.widths.size() && kSliceRows * used_twice.size() == tile.columns.size(),
            "each slice has a width to read, each column a word of bits");
  TM_ASSERT(std::accumulate(tile.widths.begin(), tile.widths.end(), std::size_t{0}) == used_twice.size(),
            "the widths of the slices add up to the columns of the tile");
  TM_ASSERT(tile.first_row % kSliceRows == 0, "tiles start at slices");
  TileOrder(tile).write(read_widths, used_twice);
}

}  // namespace tensormass::matrix
