#include "matrix/banks.h"

#include <algorithm>
#include <array>
#include <numeric>

#include "core/assert.h"
#include "view/scene.h"

namespace tensormass::matrix {

namespace {

constexpr std::uint32_t kBanks = 8;
static_assert(kSliceRows % kBanks == 0);  // a slice consists of whole groups

/// How often the eight rows of a group read each bank.
using Load = std::array<std::int32_t, kBanks>;

/// Moves `count` reads from one bank to another. Returns the change of Σ load².
std::int32_t move(Load& load, std::uint32_t from, std::uint32_t to, std::int32_t count) {
  const std::int32_t change = 2 * count * (load[to] - load[from] + count);
  load[from] -= count;
  load[to] += count;
  return change;
}

}  // namespace

std::vector<std::uint32_t> places_by_bank(const mesh::Rows& rows, std::uint32_t column_count) {
  struct Reads {
    std::uint32_t group;
    std::int32_t count;
  };
  std::vector<std::vector<Reads>> reads(column_count);
  std::vector<Load> loads(rows.size() / kBanks + 1, Load{});
  for (std::uint32_t row = 0; row < rows.size(); ++row) {
    for (const std::uint32_t column : rows[row]) {
      TM_ASSERT(column < column_count, "rows read columns of their patch");
      if (reads[column].empty() || reads[column].back().group != row / kBanks)
        reads[column].push_back({row / kBanks, 0});
      ++reads[column].back().count;
      ++loads[row / kBanks][column % kBanks];
    }
  }
  std::vector<std::uint32_t> places(column_count);
  std::iota(places.begin(), places.end(), 0);
  const auto move_all = [&](std::uint32_t column, std::uint32_t from, std::uint32_t to) {
    std::int32_t change = 0;
    for (const Reads& read : reads[column]) change += move(loads[read.group], from, to, read.count);
    return change;
  };
  // Swaps pairs while that lowers Σ load², which is least when loads are even. Four rounds reach 99 % of what many do.
  constexpr int kRounds = 4;
  bool found = true;
  for (int round = 0; round < kRounds && found; ++round) {
    found = false;
    for (std::uint32_t a = 0; a < column_count; ++a) {
      const std::uint32_t end = std::min(column_count, (a / kBanks + 1) * kBanks);
      for (std::uint32_t b = a + 1; b < end; ++b) {
        if (reads[a].empty() || reads[b].empty()) continue;
        const std::uint32_t bank_a = places[a] % kBanks, bank_b = places[b] % kBanks;
        if (move_all(a, bank_a, bank_b) + move_all(b, bank_b, bank_a) < 0) {
          std::swap(places[a], places[b]);
          found = true;
        } else {
          move_all(a, bank_b, bank_a);
          move_all(b, bank_a, bank_b);
        }
      }
    }
  }
  return places;
}

void order_by_bank(std::span<std::uint32_t> columns, std::span<std::uint32_t> neighbour_rows,
                   std::span<const std::uint32_t> ends) {
  TM_ASSERT(columns.size() % kSliceRows == 0 && columns.size() == neighbour_rows.size() && ends.size() == kSliceRows,
            "a column has a slot for each row of a slice");
  const auto width = static_cast<std::uint32_t>(columns.size()) / kSliceRows;
  TM_ASSERT(*std::max_element(ends.begin(), ends.end()) <= width, "a row has no more neighbours than columns");
  for (std::uint32_t first = 0; first < kSliceRows; first += kBanks) {
    for (std::uint32_t j = 0; j < width; ++j) {
      // load: neighbours that are not placed yet, by bank. The fullest bank is served first, or its reads would all
      // meet in the last columns.
      std::array<std::uint32_t, kBanks> load{}, order{};
      std::iota(order.begin(), order.end(), 0);
      const auto column = [&](std::uint32_t i, std::uint32_t k) { return columns[k * kSliceRows + first + i]; };
      const auto exchange = [&](std::uint32_t i, std::uint32_t k, std::uint32_t l) {
        const std::uint32_t a = k * kSliceRows + first + i, b = l * kSliceRows + first + i;
        std::swap(columns[a], columns[b]);
        std::swap(neighbour_rows[a], neighbour_rows[b]);
      };
      for (std::uint32_t i = 0; i < kBanks; ++i) {
        for (std::uint32_t k = j; k < ends[first + i]; ++k) ++load[column(i, k) % kBanks];
      }
      std::stable_sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) { return load[a] > load[b]; });
      const auto find = [&](std::uint32_t i, std::uint32_t bank) {
        for (std::uint32_t k = j; k < ends[first + i]; ++k) {
          if (column(i, k) % kBanks == bank) return k;
        }
        return width;
      };
      // Matches banks to rows by augmenting paths: each row reads another bank in column j.
      constexpr std::uint32_t kFree = kBanks;
      std::array<std::uint32_t, kBanks> bank_of_row{};
      bank_of_row.fill(kFree);
      std::array<bool, kBanks> seen{};
      const auto match = [&](const auto& self, std::uint32_t bank) -> bool {
        for (std::uint32_t i = 0; i < kBanks; ++i) {
          if (seen[i] || find(i, bank) == width) continue;
          seen[i] = true;
          if (bank_of_row[i] != kFree && !self(self, bank_of_row[i])) continue;
          bank_of_row[i] = bank;
          return true;
        }
        return false;
      };
      for (const std::uint32_t bank : order) {
        seen.fill(false);
        match(match, bank);
      }
      for (std::uint32_t i = 0; i < kBanks; ++i) {
        if (bank_of_row[i] != kFree) exchange(i, j, find(i, bank_of_row[i]));
      }
    }
  }
}

}  // namespace tensormass::matrix
