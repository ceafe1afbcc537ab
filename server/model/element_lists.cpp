#include <fmt/format.h>

#include "matrix/row_elements.h"
#include "model/compile_parts.h"

/// Lists elements for those that visit them otherwise than group by group: rows, and the solve that checks volumes.
///
/// A file of its own: with it, gcc inlines other functions of elements.cpp, and constant tensors round otherwise.
namespace tensormass::model {

namespace {

matrix::ElementRows rows_of(const ElementGroup& group) {
  return {static_cast<std::uint32_t>(group.rows.size() / group.stride), group.element_count, group.stride, group.rows};
}

}  // namespace

Result<matrix::GroupRowLists> list_elements_of_rows(const Settings& settings, const matrix::Layout& layout,
                                                    const GroupedElements& elements) {
  if (layout.storage == matrix::Storage::kEdges) return matrix::GroupRowLists{};  // elements add to the matrix directly
  if (const std::uint32_t widest = layout.widest_slice(); widest >= matrix::own_place(16)) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("a node has {} neighbours, and rows of the matrix hold fewer than {}; "
                            "split the elements around it",
                            widest, matrix::own_place(16)));
  }
  // Groups that are not constant are the first ones.
  std::vector<matrix::ElementRows> rows, lagged;
  std::vector<bool> lags;  // [group]
  for (const ElementGroup& group : elements.groups) {
    if (group.is_constant) continue;
    lags.push_back(lags_of(settings, group));
    (lags.back() ? lagged : rows).push_back(rows_of(group));
  }
  matrix::GroupRowLists out = matrix::make_row_lists(layout, rows, elements.constant_edges.empty() && lagged.empty());
  if (lagged.empty()) return out;
  // Lists of their own: what is summed over them is kept, and no part of the other groups' sums.
  matrix::GroupRowLists kept = matrix::make_row_lists(layout, lagged, false);
  std::vector<matrix::RowLists> all;
  std::size_t next = 0, next_kept = 0;
  for (const bool of_kept : lags) all.push_back(std::move(of_kept ? kept.groups[next_kept++] : out.groups[next++]));
  out.groups = std::move(all);
  return out;
}

SolveChoice choose_solve(const Settings& settings, const ReadLinks& links, const matrix::Layout& layout,
                         std::span<const ElementGroup> groups, const PatchPolicy& policy) {
  SolveChoice out;
  if (layout.storage == matrix::Storage::kEdges || settings.double_precision) return out;
  const std::uint32_t rows = layout.largest_patch();
  if (policy.solve_of) out.kind = policy.solve_of(layout);
  // The streamed solve knows only neighbours in the mesh.
  if (!links.empty() && out.kind != SolveKind::kResident) return {};
  out.keeps_vectors = rows <= policy.solve_keeps_rows;
  // The solve checks volumes only if it is the last of its step, which Newton iterations do not know in advance.
  // PatchTetrahedra stores local numbers in 16 bits.
  if (settings.iterates() || !out.keeps_vectors || rows > 0xFFFF) return out;
  std::vector<matrix::ElementRows> tetrahedra;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const ElementGroup& group = groups[g];
    if (!group.checks_volume || group.shape != physics::index_of<physics::LinearTetrahedron>(physics::Shapes{}))
      continue;
    out.checked_groups.push_back(g);
    tetrahedra.push_back(rows_of(group));
  }
  if (!tetrahedra.empty()) out.checked = matrix::share_out_tetrahedra(layout, tetrahedra);
  return out;
}

}  // namespace tensormass::model
