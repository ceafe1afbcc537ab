#include "world/cut_state.h"

#include <algorithm>
#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include "core/assert.h"

namespace tensormass::world {

namespace {

using model::BodyModel;
using model::Model;

/// Finds what nodes and elements of a scene were before it was cut further. Numbers are those of the scenes.
class Ancestors {
 public:
  Ancestors(const Model& before, const Model& after) {
    TM_ASSERT(before.bodies.size() == after.bodies.size(), "two generations of a scene have the same bodies");
    for (std::size_t b = 0; b < after.bodies.size(); ++b) {
      const BodyModel &old = before.bodies[b], &now = after.bodies[b];
      TM_ASSERT(old.loaded_node_count == now.loaded_node_count && old.node_count <= now.node_count &&
                    old.loaded_element_count == now.loaded_element_count && old.element_count <= now.element_count,
                "cuts only add");
      append(old.node_begin, old.node_count, now.node_count, now.loaded_node_count, now.node_copies, nodes);
      append(old.element_begin, old.element_count, now.element_count, now.loaded_element_count, now.element_copies,
             elements);
    }
  }

  std::vector<std::uint32_t> nodes, elements;  // [of the scene after] the one before

 private:
  /// Appends those of a body. A copy comes after its parent.
  static void append(std::uint32_t old_begin, std::uint32_t old_count, std::uint32_t count, std::uint32_t loaded,
                     const std::vector<model::CutCopy>& copies, std::vector<std::uint32_t>& out) {
    const std::size_t first = out.size();
    for (std::uint32_t i = 0; i < count; ++i) {
      out.push_back(i < old_count ? old_begin + i : out[first + copies[i - loaded].parent]);
    }
  }
};

std::vector<double> of_nodes(const std::vector<double>& values, const std::vector<std::uint32_t>& before) {
  if (values.empty()) return {};
  std::vector<double> out;
  out.reserve(3 * before.size());
  for (const std::uint32_t node : before) {
    const auto at = values.begin() + 3 * std::ptrdiff_t{node};
    out.insert(out.end(), at, at + 3);
  }
  return out;
}

/// Returns where the internal variables of each element begin: [element] mesh::kNone: it has none.
/// reals: [element] how many it has
std::vector<std::size_t> begins_of_variables(const Model& m, std::vector<std::size_t>& reals) {
  const BodyModel& last = m.bodies.back();
  std::vector<std::size_t> out(last.element_begin + last.element_count, mesh::kNone);
  reals.assign(out.size(), 0);
  std::size_t next = 0;
  for (const model::ElementGroup& group : m.groups) {
    const std::size_t count = std::size_t{group.point_count} * group.prony.size() * physics::kSymmetricReals;
    if (count == 0) continue;
    for (const std::uint32_t element : elements_of(group)) {
      out[element] = next;
      reals[element] = count;
      next += count;
    }
  }
  return out;
}

std::vector<double> of_elements(const Model& before, const NodeState& state, const Model& after,
                                const std::vector<std::uint32_t>& ancestors) {
  if (state.internal_variables.empty()) return {};
  std::vector<std::size_t> reals, reals_before;
  const std::vector<std::size_t> begins = begins_of_variables(after, reals),
                                 begins_before = begins_of_variables(before, reals_before);
  std::vector<double> out(sizes_of(after).internal_variables);
  for (std::size_t element = 0; element < begins.size(); ++element) {
    const std::uint32_t from = ancestors[element];
    TM_ASSERT(reals[element] == reals_before[from], "a copy has the material of its element");
    if (reals[element] == 0) continue;
    std::copy_n(state.internal_variables.begin() + std::ptrdiff_t(begins_before[from]), reals[element],
                out.begin() + std::ptrdiff_t(begins[element]));
  }
  return out;
}

/// A triangle by what no cut changes: its body, and its corners numbered there. One that an element carries has the
/// nodes of the element, and their weights in its corners.
struct TriangleKey {
  std::uint32_t body = 0;
  std::array<std::uint32_t, 4> nodes{};
  std::array<double, 12> weights{};
  auto operator<=>(const TriangleKey&) const = default;
};

/// Calls visit(key, place) for each triangle of the contact surface in the order of a NodeState.
template <class Visit>
void for_each_triangle(const Model& m, const Visit& visit) {
  std::size_t place = 0;
  for (const std::uint32_t triangle : order_of_triangles(m)) {
    TriangleKey key;
    const std::uint32_t outer = m.contact.outer_count();
    key.body = static_cast<std::uint32_t>(m.body_of_node(m.layout.node_of_row[m.contact.row_of(triangle)]));
    const bool is_carried = triangle >= outer;
    const std::uint32_t* rows = is_carried ? &m.contact.carried.rows[4 * std::size_t{triangle - outer}]
                                           : &m.contact.triangle_rows[3 * std::size_t{triangle}];
    for (std::size_t k = 0; k < (is_carried ? 4u : 3u); ++k) {
      key.nodes[k] = m.layout.node_of_row[rows[k]] - m.bodies[key.body].node_begin;
    }
    if (is_carried) {
      std::copy_n(m.contact.carried.weights.begin() + 12 * std::ptrdiff_t{triangle - outer}, 12, key.weights.begin());
    }
    visit(key, place++);
  }
}

std::vector<double> of_triangles(const Model& before, const NodeState& state, const Model& after) {
  if (state.slips.empty()) return {};
  const std::size_t reals = state.slips.size() / before.contact.triangle_count();
  std::map<TriangleKey, std::size_t> places;
  for_each_triangle(before, [&](const TriangleKey& key, std::size_t place) { places.emplace(key, place); });
  std::vector<double> out(reals * after.contact.triangle_count(), 0.0);
  for_each_triangle(after, [&](const TriangleKey& key, std::size_t place) {
    const auto found = places.find(key);
    if (found == places.end()) return;
    std::copy_n(state.slips.begin() + std::ptrdiff_t(reals * found->second), reals,
                out.begin() + std::ptrdiff_t(reals * place));
  });
  return out;
}

/// Finds for an anchor the part of its element that has the corner next to it. weights: in the element
std::uint32_t part_with(const Model& before, const Model& after, const Ancestors& ancestors, std::uint32_t element,
                        const double* weights) {
  const auto corner = static_cast<std::size_t>(std::max_element(weights, weights + 4) - weights);
  const std::uint32_t node = before.layout.node_of_row[before.links.blades.rows[4 * std::size_t{element} + corner]];
  std::uint32_t out = mesh::kNone;
  for (std::uint32_t e = 0; e < ancestors.elements.size(); ++e) {
    if (ancestors.elements[e] != element) continue;
    if (out == mesh::kNone) out = e;  // it comes before its copies
    const std::uint32_t own = after.layout.node_of_row[after.links.blades.rows[4 * std::size_t{e} + corner]];
    const std::size_t body = after.body_of_node(own);
    const bool is_new = own - after.bodies[body].node_begin >= before.bodies[body].node_count;
    if (!is_new && ancestors.nodes[own] == node) return e;
  }
  return out;
}

std::vector<double> of_blade_points(const Model& before, const NodeState& state, const Model& after,
                                    const Ancestors& ancestors) {
  std::vector<double> out = state.blade_points;
  for (std::size_t point = 0; point < out.size(); point += kBladeReals) {
    double* const memory = out.data() + point;
    for (const std::size_t which : {std::size_t{view::kBladeTetrahedron}, std::size_t{view::kBladeMemory}}) {
      if (!(memory[which] > 0)) continue;
      const auto element = static_cast<std::uint32_t>(memory[which]) - 1;
      memory[which] = part_with(before, after, ancestors, element, memory + view::kBladeWeights) + 1;
    }
  }
  return out;
}

}  // namespace

Result<NodeState> cut_state(const Model& before, const NodeState& state, const Model& after) {
  if (before.links.contacts_remember()) {
    return invalid("a scene with body_contacts cannot be cut yet; leave them out");
  }
  const auto is_memory_of_clusters = [](const model::ElementGroup& group) {
    return group.has_clusters() && !group.prony.empty();
  };
  if (std::any_of(before.groups.begin(), before.groups.end(), is_memory_of_clusters)) {
    return invalid(
        "a viscoelastic body of tetrahedra with selective quadrature cannot be cut yet; leave prony or quadrature out");
  }
  const Ancestors ancestors(before, after);
  NodeState out = state;
  for (std::vector<double> NodeState::*const values :
       {&NodeState::displacement, &NodeState::velocity, &NodeState::previous_displacement,
        &NodeState::previous_velocity, &NodeState::solution}) {
    out.*values = of_nodes(state.*values, ancestors.nodes);
  }
  out.internal_variables = of_elements(before, state, after, ancestors.elements);
  out.slips = of_triangles(before, state, after);
  out.blade_points = of_blade_points(before, state, after, ancestors);
  return out;
}

}  // namespace tensormass::world
