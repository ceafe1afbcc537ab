#include <algorithm>
#include <cstddef>
#include <limits>
#include <numeric>
#include <set>
#include <utility>

#include "mesh/components.h"
#include "mesh/shapes.h"
#include "model/compile_parts.h"
#include "view/balance.h"

namespace tensormass::model {

namespace {

/// The pieces of a scene: what shares no node with the rest. Numbered by their lowest nodes.
///
/// A body may consist of several, or come apart when it is cut, and each then moves by itself.
struct Pieces {
  std::vector<std::uint32_t> piece_of_node;
  std::vector<std::vector<std::uint32_t>> nodes;  ///< [piece] ascending

  explicit Pieces(const mesh::Mesh& mesh) : piece_of_node(mesh.nodes.size()) {
    mesh::Components components(mesh.nodes.size());
    for (const std::span<const std::uint32_t> element : mesh::element_nodes(mesh)) {
      for (const std::uint32_t node : element) components.join(element[0], node);
    }
    for (std::uint32_t node = 0; node < piece_of_node.size(); ++node) {
      const std::uint32_t root = components.root(node);  // the lowest node
      if (root == node) nodes.emplace_back();
      piece_of_node[node] = root == node ? static_cast<std::uint32_t>(nodes.size() - 1) : piece_of_node[root];
      nodes[piece_of_node[node]].push_back(node);
    }
  }
};

/// Returns which pieces nothing holds. Forces of pressure are not among those that a balance knows, and a consistent
/// mass has moments that a lumped one has not.
std::vector<bool> find_free(const FreeBodyInput& input, const Pieces& pieces) {
  const std::vector<ReadBody>& bodies = input.bodies.bodies;
  const matrix::Layout& layout = input.layout;
  std::vector<bool> free;
  for (const std::vector<std::uint32_t>& nodes : pieces.nodes) {
    free.push_back(!bodies[body_of_node(bodies, nodes.front())].consistent_mass);
  }
  const auto hold = [&](std::uint32_t row) { free[pieces.piece_of_node[layout.node_of_row[row]]] = false; };
  constexpr double kAllDirections = 7;  // view::StateView::rest
  for (const std::uint32_t row : layout.row_of_node) {
    if (input.rest[4 * std::size_t{row} + 3] != kAllDirections) hold(row);
  }
  for (std::size_t i = 0; i < input.prescribed_rows.rows.size(); i += 3) hold(input.prescribed_rows.rows[i]);
  for (const std::uint32_t row : input.pressure.rows) hold(row);
  return free;
}

/// Returns the row of the node that is nearest to the mean of some nodes.
std::uint32_t center_row(const FreeBodyInput& input, std::span<const std::uint32_t> nodes) {
  const std::vector<Eigen::Vector3d>& at = input.bodies.merged.nodes;
  Eigen::Vector3d mean = Eigen::Vector3d::Zero();
  for (const std::uint32_t node : nodes) mean += at[node];
  mean /= static_cast<double>(nodes.size());
  const auto nearest = std::min_element(nodes.begin(), nodes.end(), [&](std::uint32_t a, std::uint32_t b) {
    return (at[a] - mean).squaredNorm() < (at[b] - mean).squaredNorm();
  });
  return input.layout.row_of_node[*nearest];
}

/// Finds which free bodies links may join: those that may touch, and those that a spring joins.
void find_partners(const FreeBodyInput& input, FreeBodies& out) {
  std::vector<std::size_t> body_of(out.count());
  for (std::uint32_t free = 0; free < out.count(); ++free) {
    body_of[free] = body_of_node(input.bodies.bodies, input.layout.node_of_row[out.center_rows[free]]);
  }
  std::set<std::pair<std::uint32_t, std::uint32_t>> pairs;
  const auto join = [&](std::uint32_t a, std::uint32_t b) {
    if (a == b || a == view::kNoBody || b == view::kNoBody) return;
    pairs.emplace(a, b);
    pairs.emplace(b, a);
  };
  if (out.count() <= view::kMaxCoupledBodies) {
    for (const BodyContactModel& contact : input.contacts) {
      for (std::uint32_t a = 0; a < out.count(); ++a) {
        for (std::uint32_t b = 0; b < out.count(); ++b) {
          if (body_of[a] == contact.body && body_of[b] == contact.other) join(a, b);
        }
      }
    }
    for (std::size_t i = 0; i < input.spring_rows.size(); i += 2) {
      join(out.row_body[input.spring_rows[i]], out.row_body[input.spring_rows[i + 1]]);
    }
  }
  if (pairs.empty()) return;
  out.partner_begin.assign(out.count() + std::size_t{1}, 0);
  for (const auto& [body, partner] : pairs) {  // ascending
    out.partners.push_back(partner);
    ++out.partner_begin[body + 1];
  }
  std::partial_sum(out.partner_begin.begin(), out.partner_begin.end(), out.partner_begin.begin());
  out.entry_partners.assign(1, 0);
  for (const std::uint32_t body : out.entry_body) {
    out.entry_partners.push_back(out.entry_partners.back() + out.partner_begin[body + 1] - out.partner_begin[body]);
  }
}

}  // namespace

FreeBodies find_free_bodies(const FreeBodyInput& input) {
  const matrix::Layout& layout = input.layout;
  const Pieces pieces(input.bodies.merged);
  const std::vector<bool> free = find_free(input, pieces);
  FreeBodies out;
  std::vector<std::uint32_t> place(free.size(), view::kNoBody);
  for (std::size_t p = 0; p < free.size(); ++p) {
    if (!free[p]) continue;
    place[p] = out.count();
    out.center_rows.push_back(center_row(input, pieces.nodes[p]));
  }
  if (out.count() == 0) return out;
  out.row_body.assign(layout.row_count, view::kNoBody);
  for (const std::uint32_t row : layout.row_of_node) {
    out.row_body[row] = place[pieces.piece_of_node[layout.node_of_row[row]]];
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
  find_partners(input, out);
  return out;
}

}  // namespace tensormass::model
