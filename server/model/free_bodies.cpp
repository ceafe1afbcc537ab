#include <algorithm>
#include <limits>
#include <numeric>

#include "model/compile_parts.h"
#include "view/balance.h"

namespace tensormass::model {

namespace {

/// Returns which bodies nothing holds. Forces of pressure are not among those that a balance knows, and a consistent
/// mass has moments that a lumped one has not.
std::vector<bool> find_free(const FreeBodyInput& input) {
  const std::vector<ReadBody>& bodies = input.bodies.bodies;
  const matrix::Layout& layout = input.layout;
  std::vector<bool> free(bodies.size(), true);
  for (std::size_t b = 0; b < free.size(); ++b) free[b] = !bodies[b].consistent_mass;
  const auto hold = [&](std::uint32_t row) { free[body_of_node(bodies, layout.node_of_row[row])] = false; };
  constexpr double kAllDirections = 7;  // view::StateView::rest
  for (const std::uint32_t row : layout.row_of_node) {
    if (input.rest[4 * std::size_t{row} + 3] != kAllDirections) hold(row);
  }
  for (std::size_t i = 0; i < input.prescribed_rows.rows.size(); i += 3) hold(input.prescribed_rows.rows[i]);
  for (const std::uint32_t row : input.pressure.rows) hold(row);
  return free;
}

/// Returns the row of the node that is nearest to the mean of a body's nodes.
std::uint32_t center_row(const FreeBodyInput& input, const ReadBody& body) {
  const std::vector<Eigen::Vector3d>& nodes = input.bodies.merged.nodes;
  const auto begin = nodes.begin() + body.node_begin, end = begin + body.node_count;
  const Eigen::Vector3d mean = std::accumulate(begin, end, Eigen::Vector3d(Eigen::Vector3d::Zero())) / body.node_count;
  const auto nearest = std::min_element(begin, end, [&](const Eigen::Vector3d& a, const Eigen::Vector3d& b) {
    return (a - mean).squaredNorm() < (b - mean).squaredNorm();
  });
  return input.layout.row_of_node[static_cast<std::size_t>(nearest - nodes.begin())];
}

}  // namespace

FreeBodies find_free_bodies(const FreeBodyInput& input) {
  const std::vector<ReadBody>& bodies = input.bodies.bodies;
  const matrix::Layout& layout = input.layout;
  const std::vector<bool> free = find_free(input);
  FreeBodies out;
  std::vector<std::uint32_t> place(free.size(), view::kNoBody);
  for (std::size_t b = 0; b < free.size(); ++b) {
    if (!free[b]) continue;
    place[b] = out.count();
    out.center_rows.push_back(center_row(input, bodies[b]));
  }
  if (out.count() == 0) return out;
  out.row_body.assign(layout.row_count, view::kNoBody);
  for (const std::uint32_t row : layout.row_of_node) {
    out.row_body[row] = place[body_of_node(bodies, layout.node_of_row[row])];
  }
  std::vector<std::vector<std::uint32_t>> entries(out.count());
  out.patch_entries.assign(1, 0);
  for (std::uint32_t patch = 0; patch < layout.patch_count; ++patch) {
    std::vector<bool> has(out.count(), false);
    for (std::uint32_t row = layout.patch_rows[patch]; row < layout.patch_rows[patch + 1]; ++row) {
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
  return out;
}

}  // namespace tensormass::model
