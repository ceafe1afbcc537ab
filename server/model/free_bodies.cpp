#include <algorithm>
#include <limits>
#include <numeric>

#include "model/compile_parts.h"
#include "view/balance.h"

namespace tensormass::model {

namespace {

/// Returns which bodies nothing holds. Forces of pressure are not among those that a balance knows, and a consistent
/// mass has moments that a lumped one has not.
std::vector<bool> find_free(const Compilation& c) {
  const Model& m = c.model;
  std::vector<bool> free(m.bodies.size(), true);
  for (std::size_t b = 0; b < free.size(); ++b) free[b] = !c.bodies[b].consistent_mass;
  const auto hold = [&](std::uint32_t row) { free[m.body_of_node(m.layout.node_of_row[row])] = false; };
  constexpr double kAllDirections = 7;  // view::StateView::rest
  for (const std::uint32_t row : m.layout.row_of_node) {
    if (m.rest[4 * std::size_t{row} + 3] != kAllDirections) hold(row);
  }
  for (std::size_t i = 0; i < m.prescribed_rows.rows.size(); i += 3) hold(m.prescribed_rows.rows[i]);
  for (const std::uint32_t row : m.pressure.rows) hold(row);
  return free;
}

/// Returns the row of the node that is nearest to the mean of a body's nodes.
std::uint32_t center_row(const Compilation& c, const BodyModel& body) {
  const auto begin = c.merged.nodes.begin() + body.node_begin, end = begin + body.node_count;
  const Eigen::Vector3d mean = std::accumulate(begin, end, Eigen::Vector3d(Eigen::Vector3d::Zero())) / body.node_count;
  const auto nearest = std::min_element(begin, end, [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    return (a - mean).squaredNorm() < (b - mean).squaredNorm();
  });
  return c.model.layout.row_of_node[static_cast<std::size_t>(nearest - c.merged.nodes.begin())];
}

}  // namespace

void find_free_bodies(Compilation& c) {
  Model& m = c.model;
  if (m.iterates() || m.quasi_static() || (m.tools.empty() && !c.has_ties())) return;
  const std::vector<bool> free = find_free(c);
  FreeBodies& out = m.free_bodies;
  std::vector<std::uint32_t> place(free.size(), view::kNoBody);
  for (std::size_t b = 0; b < free.size(); ++b) {
    if (!free[b]) continue;
    place[b] = out.count();
    out.center_rows.push_back(center_row(c, m.bodies[b]));
  }
  if (out.count() == 0) return;
  out.row_body.assign(m.layout.row_count, view::kNoBody);
  for (const std::uint32_t row : m.layout.row_of_node) {
    out.row_body[row] = place[m.body_of_node(m.layout.node_of_row[row])];
  }
  std::vector<std::vector<std::uint32_t>> entries(out.count());
  out.patch_entries.assign(1, 0);
  for (std::uint32_t patch = 0; patch < m.layout.patch_count; ++patch) {
    std::vector<bool> has(out.count(), false);
    for (std::uint32_t row = m.layout.patch_rows[patch]; row < m.layout.patch_rows[patch + 1]; ++row) {
      if (out.row_body[row] != view::kNoBody) has[out.row_body[row]] = true;
    }
    for (std::uint32_t body = 0; body < out.count(); ++body) {
      if (!has[body]) continue;
      entries[body].push_back(static_cast<std::uint32_t>(out.entry_body.size()));
      out.entry_body.push_back(body);
    }
    out.patch_entries.push_back(static_cast<std::uint32_t>(out.entry_body.size()));
  }
  out.body_begin.assign(1, 0);
  for (const std::vector<std::uint32_t>& of_body : entries) {
    out.body_entries.insert(out.body_entries.end(), of_body.begin(), of_body.end());
    out.body_begin.push_back(static_cast<std::uint32_t>(out.body_entries.size()));
  }
}

}  // namespace tensormass::model
