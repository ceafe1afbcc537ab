#pragma once

#include <algorithm>
#include <cstdint>
#include <set>
#include <utility>
#include <vector>

#include "model/model.h"
#include "solver/coarse_rows.h"
#include "view/coarse.h"

/// Makes the lists of solver/coarse_rows.h from the aggregates of a model.
namespace tensormass::model {

/// Allocates solver::CoarseLists from an arena (bind.h). The model must store whole rows.
template <class Arena>
solver::CoarseLists bind_coarse_lists(const Model& m, Arena& arena) {
  const matrix::Layout& layout = m.layout;
  const std::uint32_t count = m.aggregates.count();
  solver::CoarseLists out;
  if (count == 0) return out;
  const std::vector<std::uint32_t>& aggregate_of = m.aggregates.row_aggregate;
  const std::vector<std::uint32_t> slice_patch = layout.patch_of_slice();
  std::vector<std::vector<std::uint32_t>> rows(count), entries_of(count);
  std::vector<std::uint32_t> patch_entries{0}, entry_aggregate;
  std::set<std::pair<std::uint32_t, std::uint32_t>> coupled;
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    std::set<std::uint32_t> present;
    for (std::uint32_t row = layout.patch_rows[patch]; row < layout.patch_rows[patch + 1]; ++row) {
      const std::uint32_t own = aggregate_of[row];
      if (own == view::kNoAggregate) continue;
      present.insert(own);
      rows[own].push_back(row);
      coupled.insert({own, own});
      const std::uint32_t slice = row / view::kSliceRows;
      for (std::uint32_t j = layout.slice_begin[slice]; j < layout.slice_begin[slice + 1]; ++j) {
        const std::uint32_t other = layout.neighbour_rows[j * view::kSliceRows + row % view::kSliceRows];
        if (other == mesh::kNone || aggregate_of[other] == view::kNoAggregate) continue;
        if (aggregate_of[other] <= own) coupled.insert({own, aggregate_of[other]});
      }
    }
    for (const std::uint32_t aggregate : present) {
      entries_of[aggregate].push_back(static_cast<std::uint32_t>(entry_aggregate.size()));
      entry_aggregate.push_back(aggregate);
    }
    patch_entries.push_back(static_cast<std::uint32_t>(entry_aggregate.size()));
  }
  const auto flat = [&](const std::vector<std::vector<std::uint32_t>>& lists, std::vector<std::uint32_t>& begin) {
    std::vector<std::uint32_t> all;
    begin.assign(1, 0);
    for (const std::vector<std::uint32_t>& list : lists) {
      all.insert(all.end(), list.begin(), list.end());
      begin.push_back(static_cast<std::uint32_t>(all.size()));
    }
    return all;
  };
  std::vector<std::uint32_t> pairs, rows_begin, entries_begin;
  for (const auto& [own, other] : coupled) pairs.insert(pairs.end(), {own, other});
  const std::vector<std::uint32_t> all_rows = flat(rows, rows_begin), all_entries = flat(entries_of, entries_begin);
  const auto constant = [&](const char* name, const std::vector<std::uint32_t>& items) {
    return arena.template constant<std::uint32_t>(name, items);
  };
  out.pair_count = static_cast<std::uint32_t>(coupled.size());
  out.pairs = constant("coupled aggregates", pairs);
  out.aggregate_rows = constant("where the rows of aggregates begin", rows_begin);
  out.rows = constant("rows of aggregates", all_rows);
  out.slice_patch = constant("patches of slices", slice_patch);
  out.patch_entries = constant("where the aggregates of patches begin", patch_entries);
  out.entry_aggregate = constant("aggregates of patches", entry_aggregate);
  out.aggregate_entries = constant("where the patches of aggregates begin", entries_begin);
  out.entries = constant("patches of aggregates", all_entries);
  return out;
}

}  // namespace tensormass::model
