#include "matrix/tiles.h"

#include <algorithm>
#include <array>
#include <numeric>
#include <vector>

#include "matrix/layout.h"
#include "mesh/mesh.h"

namespace tensormass::matrix {

namespace {

/// Colours the edges of a bipartite graph so that no two of a colour meet, with as many colours as the largest degree
/// (König). Each edge gets a colour that is free at both ends; where there is none, two colours are exchanged along the
/// path that is in the way.
class EdgeColours {
 public:
  static constexpr std::uint32_t kFree = 0xFFFFFFFFu;

  EdgeColours(std::uint32_t left_count, std::uint32_t right_count, std::uint32_t colours)
      : colours_(colours),
        right_of_(std::size_t{left_count} * colours, kFree),
        left_of_(std::size_t{right_count} * colours, kFree) {}

  void add(std::uint32_t left, std::uint32_t right) {
    const std::uint32_t a = free_at(right_of_, left), b = free_at(left_of_, right);
    // The path from `right` in colours a, b, a, ..; it cannot come to `left`, where a is free.
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
  /// The other end of the edge of a colour; kFree if there is none.
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
  /// What a slot is to its row: of a row outside of the tile, of a pair that the row reads, or of one that the other
  /// row reads.
  enum class Kind : std::uint8_t { kPadding, kOuter, kRead, kMirrored };

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
  /// The tile's row behind a slot that is neither padding nor outer.
  std::uint32_t other(std::uint32_t slot) const { return tile_.columns[slot] - tile_.first_row; }
  std::uint32_t slot_of(std::uint32_t row, std::uint32_t other_row) const {
    for (std::uint32_t j = 0; j < width(row); ++j) {
      const std::uint32_t at = slot(row, j);
      if (tile_.neighbour_rows[at] != mesh::kNone && other(at) == other_row) return at;
    }
    return kNoPlace;
  }

  void sort_out() {
    kinds_.resize(tile_.columns.size(), Kind::kPadding);
    for_each_slot(0, rows_, [&](std::uint32_t row, std::uint32_t at) {
      if (tile_.neighbour_rows[at] == mesh::kNone) return;
      const bool outer = other(at) >= rows_;
      kinds_[at] = outer ? Kind::kOuter : Kind::kMirrored;
      if (outer) ++read_[row];
    });
  }

  /// Decides which row of each pair reads it: the one that reads less.
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

  /// As many columns as each slice will read at least: those of the row with the most outer neighbours, or what makes
  /// room for all pairs.
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

  /// Hands pairs over along paths of rows, from rows that would make their slice wider to rows that have room.
  void even_out() {
    const std::vector<std::uint32_t> columns = least_columns();
    std::vector<std::uint32_t> queue, through(rows_);  // the slot by which a row was found
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

  /// Leaves no row to be added to by more rows of a slice than that has columns: the row reads the rest of those pairs
  /// itself. Its slice is wider than that of the others, so that the same cannot happen the other way round.
  void spread_pairs() {
    for (std::uint32_t first = 0; first < rows_; first += kSliceRows) {
      std::vector<std::uint32_t> meeting(rows_, 0);
      for_each_slot(first, first + kSliceRows, [&](std::uint32_t row, std::uint32_t at) {
        if (kinds_[at] == Kind::kRead && ++meeting[other(at)] > width(row)) hand_over(row, at);
      });
    }
  }
  /// The pair of a slot, which the row reads, to the other row.
  void hand_over(std::uint32_t row, std::uint32_t at) {
    kinds_[slot_of(other(at), row)] = Kind::kRead;
    kinds_[at] = Kind::kMirrored;
    ++read_[other(at)];
    --read_[row];
  }

  std::uint32_t order_slice(std::uint32_t slice, std::span<std::uint32_t> used_twice) {
    const std::uint32_t first = slice * kSliceRows, last = first + kSliceRows;
    // As many columns as the longest row reads, and as pairs meet in one other row.
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
      while (colours.right_of(lane, colour) != other(at)) ++colour;
      put(colour, item, Kind::kRead);
      used_twice[colour] |= 1u << lane;
    }
    // Outer rows fill gaps. Where the rest of the row has no room for all mirrored ones, those fill gaps, too, and both
    // rows read the pair.
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
  std::vector<std::uint32_t> begins_;  // [slice + 1] of the slices, in columns
  std::vector<std::uint32_t> read_;    // [row] slots that the row reads
  std::vector<Kind> kinds_;            // [slot]
  std::vector<std::pair<std::uint32_t, std::uint32_t>> read_by_both_;
};

}  // namespace

std::uint32_t rows_of_tiles(std::uint32_t most_rows) {
  const std::uint32_t rounds = (most_rows - 1) / (kTilesAtOnce * kMostTileRows) + 1;
  const std::uint32_t tiles = rounds * kTilesAtOnce;
  return ((most_rows - 1) / tiles / kSliceRows + 1) * kSliceRows;
}

void order_tile(const TileSlots& tile, std::span<std::uint32_t> read_widths, std::span<std::uint32_t> used_twice) {
  TileOrder(tile).write(read_widths, used_twice);
}

}  // namespace tensormass::matrix
