#include "world/node_state.h"

#include <algorithm>
#include <array>
#include <map>
#include <numeric>
#include <optional>
#include <unordered_map>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "world/hashes.h"

namespace tensormass::world {

namespace {

using model::ElementGroup;
using model::Model;

constexpr std::size_t kSlipReals = 4;  // a stretch and a normal force

// -- nodes ------------------------------------------------------------------------------------------------------------

/// rows: [row_count, 4], or empty
std::vector<double> nodes_of(const matrix::Layout& layout, const std::vector<double>& rows) {
  if (rows.empty()) return {};
  TM_ASSERT(rows.size() == 4 * std::size_t{layout.row_count}, "each row has four reals");
  std::vector<double> out;
  out.reserve(3 * layout.row_of_node.size());
  for (const std::uint32_t row : layout.row_of_node) {
    const auto* at = rows.data() + 4 * std::size_t{row};
    out.insert(out.end(), at, at + 3);
  }
  return out;
}

/// Gap rows, and the fourth real of each row, are zero.
std::vector<double> rows_of(const matrix::Layout& layout, const std::vector<double>& nodes) {
  if (nodes.empty()) return {};
  TM_ASSERT(nodes.size() == 3 * layout.row_of_node.size(), "each node has three reals");
  std::vector<double> out(4 * std::size_t{layout.row_count}, 0.0);
  for (std::size_t node = 0; node < layout.row_of_node.size(); ++node) {
    std::copy_n(nodes.data() + 3 * node, 3, out.data() + 4 * std::size_t{layout.row_of_node[node]});
  }
  return out;
}

// -- elements ---------------------------------------------------------------------------------------------------------

/// The internal variables of one group: [point][term][6][stride] in a layout, [element][point][term][6] in a NodeState.
class GroupVariables {
 public:
  explicit GroupVariables(const ElementGroup& group)
      : group_(group),
        reals_(std::size_t{group.point_count} * group.prony.size() * physics::kSymmetricReals),
        elements_(elements_of(group)) {
    TM_ASSERT(elements_.size() == group.element_count, "a group has each of its elements once");
  }

  /// Skips places of elements that an earlier place has: theirs are the same.
  void to_elements(const double* layout, double* out) const {
    for_each_variable(group_.elements,
                      [&](std::size_t in_layout, std::size_t by_element) { out[by_element] = layout[in_layout]; });
  }
  void to_layout(const double* elements, double* out) const {
    for_each_variable(computed(),
                      [&](std::size_t in_layout, std::size_t by_element) { out[in_layout] = elements[by_element]; });
  }

 private:
  /// Returns the element of each place, also where an earlier place has computed it for another patch: such places have
  /// the same rows and the same shape at rest.
  std::vector<std::uint32_t> computed() const {
    std::vector<std::uint32_t> out = group_.elements;
    if (out.size() == group_.element_count) return out;
    std::unordered_multimap<std::uint64_t, std::uint32_t> met;
    for (std::uint32_t place = 0; place < out.size(); ++place) {
      if (group_.elements[place] != mesh::kNone) {
        met.emplace(hash_of_rows(place), place);
        continue;
      }
      const auto [first, last] = met.equal_range(hash_of_rows(place));
      const auto same = std::find_if(first, last, [&](const auto& other) { return is_same(other.second, place); });
      if (same != last) out[place] = group_.elements[same->second];
    }
    return out;
  }
  std::uint64_t hash_of_rows(std::size_t place) const {
    Hash hash;
    for (std::size_t at = place; at < group_.rows.size(); at += group_.stride) hash.add(std::uint64_t{group_.rows[at]});
    return hash.value();
  }
  bool is_same(std::size_t place, std::size_t other) const {
    const auto equal = [&](const auto& columns) {
      for (std::size_t at = 0; at < columns.size(); at += group_.stride) {
        if (columns[at + place] != columns[at + other]) return false;
      }
      return true;
    };
    return equal(group_.rows) && equal(group_.rest) && equal(group_.members);
  }

  /// copy(in the layout, by element) is called for each variable of each element. elements: [place]
  ///
  /// Takes some places at once: variables of one place are far from each other in the layout, and those of neighbours
  /// share a cache line.
  template <class Copy>
  void for_each_variable(const std::vector<std::uint32_t>& elements, const Copy& copy) const {
    constexpr std::size_t kPlaces = 32;
    std::array<std::size_t, kPlaces> places, begins;
    for (std::size_t first = 0; first < elements.size(); first += kPlaces) {
      std::size_t count = 0;
      for (std::size_t place = first; place < std::min(first + kPlaces, elements.size()); ++place) {
        if (elements[place] == mesh::kNone) continue;
        const auto found = std::lower_bound(elements_.begin(), elements_.end(), elements[place]);
        places[count] = place;
        begins[count++] = reals_ * static_cast<std::size_t>(found - elements_.begin());
      }
      for (std::size_t i = 0; i < reals_; ++i) {
        for (std::size_t k = 0; k < count; ++k) copy(i * group_.stride + places[k], begins[k] + i);
      }
    }
  }

  const ElementGroup& group_;
  std::size_t reals_;  // variables of an element
  std::vector<std::uint32_t> elements_;
};

std::size_t variables_of_elements(const ElementGroup& group) {
  return std::size_t{group.element_count} * group.point_count * group.prony.size() * physics::kSymmetricReals;
}

std::size_t variables_in_layout(const Model& m) {
  return std::accumulate(
      m.groups.begin(), m.groups.end(), std::size_t{0},
      [](std::size_t sum, const ElementGroup& group) { return sum + group.internal_variable_reals(); });
}
std::size_t variables_by_element(const Model& m) {
  return std::accumulate(m.groups.begin(), m.groups.end(), std::size_t{0},
                         [](std::size_t sum, const ElementGroup& group) { return sum + variables_of_elements(group); });
}

/// convert(group, in the layout, by element) is called for each viscoelastic group, with the offsets of its variables.
template <class Convert>
void for_each_viscoelastic(const Model& m, const Convert& convert) {
  std::size_t in_layout = 0, by_element = 0;
  for (const ElementGroup& group : m.groups) {
    if (!group.prony.empty()) convert(GroupVariables(group), in_layout, by_element);
    in_layout += group.internal_variable_reals();
    by_element += variables_of_elements(group);
  }
}

// -- contacts ---------------------------------------------------------------------------------------------------------

/// Returns the places of `count` items in the order of key(place). Items of equal keys stay in their order.
template <class Key>
std::vector<std::uint32_t> order_by(std::size_t count, const Key& key) {
  std::vector<std::uint32_t> order(count);
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) { return key(a) < key(b); });
  return order;
}

/// Candidates in the order of a NodeState.
std::vector<std::uint32_t> order_of_candidates(const Model& m) {
  return order_by(m.links.candidate_count(), [&](std::uint32_t candidate) {
    const std::uint32_t* entry = m.links.candidates.data() + 2 * std::size_t{candidate};
    return std::pair(m.layout.node_of_row[m.contact.surface_rows[entry[0]]], entry[1]);
  });
}

/// The places of what edges remember, in a layout.
class EdgeMemories {
 public:
  explicit EdgeMemories(const Model& m) : m_(m) {
    for (std::uint32_t contact = 0; contact < m.body_contacts.size(); ++contact) {
      // A body that touches itself has one side, and no edges search there.
      const bool self = m.body_contacts[contact].body == m.body_contacts[contact].other;
      contact_of_side_.insert(contact_of_side_.end(), self ? 1 : 2, contact);
    }
    for (std::uint32_t edge = 0; edge < m.links.edge_rows.size() / 4; ++edge) edges_.emplace(nodes_of(edge), edge);
    for (std::uint32_t candidate = 0; candidate < m.links.edge_candidate_count(); ++candidate) {
      candidates_.emplace(std::pair(contact_of(candidate), edge_of(candidate)), candidate);
    }
  }

  std::uint32_t edge_of(std::uint32_t candidate) const { return m_.links.edge_candidates[2 * std::size_t{candidate}]; }
  std::uint32_t contact_of(std::uint32_t candidate) const {
    return contact_of_side_[m_.links.edge_candidates[2 * std::size_t{candidate} + 1]];
  }
  EdgePair::Edge nodes_of(std::uint32_t edge) const {
    const std::uint32_t* rows = m_.links.edge_rows.data() + 4 * std::size_t{edge};
    const auto [low, high] = std::minmax(m_.layout.node_of_row[rows[0]], m_.layout.node_of_row[rows[1]]);
    return {low, high};
  }
  std::optional<std::uint32_t> edge_at(const EdgePair::Edge& nodes) const {
    const auto found = edges_.find(nodes);
    return found == edges_.end() ? std::nullopt : std::optional(found->second);
  }
  std::optional<std::uint32_t> candidate_at(std::uint32_t contact, std::uint32_t edge) const {
    const auto found = candidates_.find({contact, edge});
    return found == candidates_.end() ? std::nullopt : std::optional(found->second);
  }

 private:
  const Model& m_;
  std::vector<std::uint32_t> contact_of_side_;
  std::map<EdgePair::Edge, std::uint32_t> edges_;
  std::map<std::pair<std::uint32_t, std::uint32_t>, std::uint32_t> candidates_;  // by contact and edge
};

/// Returns the pair with its lower edge first. The stretch points from the other edge to the one that feels it.
EdgePair ordered(EdgePair pair) {
  if (pair.edge < pair.other) return pair;
  std::swap(pair.edge, pair.other);
  for (double& stretch : pair.stretch_m) stretch = -stretch;
  return pair;
}

/// memory: [edge candidate][kEdgeSlots][kEdgeMemory]
std::vector<EdgePair> edge_pairs_of(const Model& m, const double* memory) {
  const EdgeMemories edges(m);
  std::vector<EdgePair> out;
  for (std::uint32_t candidate = 0; candidate < m.links.edge_candidate_count(); ++candidate) {
    for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot, memory += view::kEdgeMemory) {
      if (!(memory[view::kEdgePartner] > 0)) continue;
      const std::uint32_t other = static_cast<std::uint32_t>(memory[view::kEdgePartner]) - 1;
      EdgePair pair{
          edges.contact_of(candidate), edges.nodes_of(edges.edge_of(candidate)), edges.nodes_of(other), slot, {},
          memory[view::kEdgeForce]};
      std::copy_n(memory + view::kEdgeStretch, 3, pair.stretch_m.begin());
      out.push_back(ordered(pair));
    }
  }
  std::sort(out.begin(), out.end());
  return out;
}

/// Returns the slot for a pair: its own, or the first free one, or that of the weakest pair if it presses less.
/// memory: of one candidate
double* slot_for(double* memory, const EdgePair& pair) {
  const auto at = [&](std::uint32_t slot) { return memory + std::size_t{view::kEdgeMemory} * slot; };
  const auto is_free = [&](std::uint32_t slot) { return at(slot)[view::kEdgePartner] == 0; };
  if (is_free(pair.slot)) return at(pair.slot);
  std::uint32_t weakest = 0;
  for (std::uint32_t slot = 0; slot < view::kEdgeSlots; ++slot) {
    if (is_free(slot)) return at(slot);
    if (at(slot)[view::kEdgeForce] < at(weakest)[view::kEdgeForce]) weakest = slot;
  }
  return at(weakest)[view::kEdgeForce] < pair.force_n ? at(weakest) : nullptr;
}

void put_edge_pairs(const Model& m, std::span<const EdgePair> pairs, double* memory) {
  if (pairs.empty()) return;
  const EdgeMemories edges(m);
  for (EdgePair pair : pairs) {
    std::uint32_t own = edges.edge_at(pair.edge).value(), other = edges.edge_at(pair.other).value();
    auto candidate = edges.candidate_at(pair.contact, own);
    if (!candidate) {  // the other one searches
      std::swap(own, other);
      for (double& stretch : pair.stretch_m) stretch = -stretch;
      candidate = edges.candidate_at(pair.contact, own);
    }
    double* to = slot_for(memory + std::size_t{view::kEdgeSlots} * view::kEdgeMemory * candidate.value(), pair);
    if (to == nullptr) continue;
    std::copy_n(pair.stretch_m.begin(), 3, to + view::kEdgeStretch);
    to[view::kEdgeForce] = pair.force_n;
    to[view::kEdgePartner] = other + 1;
  }
}

/// Reals of a layout that blade points remember (view::BladesView::reals).
std::size_t blade_reals(const Model& m) {
  return m.links.blades.point_count() * (view::kBladeMemory + std::size_t{m.layout.patch_count});
}

/// Returns what blade points remember. It follows what contacts do.
std::vector<double> blade_points_of(const Model& m, const std::vector<double>& link_slips) {
  const std::size_t points = m.links.blades.point_count(), patches = m.layout.patch_count;
  std::vector<double> out;
  if (points == 0) return out;
  const double* memory = link_slips.data() + link_slips.size() - blade_reals(m);
  const double* found = memory + points * view::kBladeMemory;
  for (std::size_t point = 0; point < points; ++point, memory += view::kBladeMemory, found += patches) {
    out.insert(out.end(), memory, memory + view::kBladeMemory);
    double first = 0;  // the lowest one, as contact::take_anchor chooses
    for (std::size_t patch = 0; patch < patches; ++patch) {
      if (found[patch] > 0 && (first == 0 || found[patch] < first)) first = found[patch];
    }
    out.push_back(first);
  }
  return out;
}

void put_blade_points(const Model& m, const std::vector<double>& blade_points, std::vector<double>& link_slips) {
  const std::size_t points = m.links.blades.point_count(), patches = m.layout.patch_count, begin = link_slips.size();
  link_slips.resize(begin + blade_reals(m));
  for (std::size_t point = 0; point < points; ++point) {
    const double* from = blade_points.data() + kBladeReals * point;
    std::copy_n(from, std::size_t{view::kBladeMemory}, link_slips.data() + begin + view::kBladeMemory * point);
    link_slips[begin + view::kBladeMemory * points + patches * point] = from[view::kBladeMemory];
  }
}

}  // namespace

NodeStateSizes sizes_of(const Model& m) {
  const std::size_t vectors = 3 * m.layout.row_of_node.size();
  return {.nodes = vectors,
          .previous = m.integrator == model::Integrator::kBdf2 ? vectors : 0,
          .solution = m.iterates() ? 0 : vectors,
          .internal_variables = variables_by_element(m),
          .slips = m.contacts_remember() ? kSlipReals * m.contact_points() * m.contact.triangle_count() : 0,
          .link_slips = kSlipReals * m.links.candidate_count(),
          .broken = m.links.spring_count(),
          .blade_points = kBladeReals * m.links.blades.point_count()};
}

/// The layout sorts them by the row of their first corner, and those of one row
/// stay in the order of the boundary. Edits move triangles within the room of their patch, so a scene with editing
/// keeps the layout's order.
std::vector<std::uint32_t> order_of_triangles(const Model& m) {
  if (m.edit_tables) return order_by(m.contact.triangle_count(), [](std::uint32_t triangle) { return triangle; });
  return order_by(m.contact.triangle_count(),
                  [&](std::uint32_t triangle) { return m.layout.node_of_row[m.contact.row_of(triangle)]; });
}

std::vector<std::uint32_t> elements_of(const ElementGroup& group) {
  std::vector<std::uint32_t> out = group.elements;
  std::erase(out, mesh::kNone);
  std::sort(out.begin(), out.end());
  return out;
}

NodeState by_node(const Model& m, const LayoutState& state) {
  const auto& [rows, history] = state;
  const NodeStateSizes sizes = sizes_of(m);
  NodeState out;
  out.displacement = nodes_of(m.layout, rows.displacement);
  out.velocity = nodes_of(m.layout, rows.velocity);
  out.previous_displacement = nodes_of(m.layout, history.previous_displacement);
  out.previous_velocity = nodes_of(m.layout, history.previous_velocity);
  out.solution = nodes_of(m.layout, history.solution);
  out.internal_dt_s = rows.internal_dt_s;
  out.last_dt_s = history.last_dt_s;
  out.largest_force_squared = history.largest_force_squared;
  out.coarse_solves = history.coarse_solves;

  TM_ASSERT(rows.internal_variables.size() == variables_in_layout(m), "a state is of the same model");
  out.internal_variables.resize(sizes.internal_variables);
  for_each_viscoelastic(m, [&](const GroupVariables& group, std::size_t in_layout, std::size_t by_element) {
    group.to_elements(rows.internal_variables.data() + in_layout, out.internal_variables.data() + by_element);
  });

  TM_ASSERT(history.slips.size() == sizes.slips, "a history is of the same model");
  if (!history.slips.empty()) {
    out.slips.reserve(sizes.slips);
    for (const std::uint32_t triangle : order_of_triangles(m)) {
      for (std::size_t point = 0; point < m.contact_points(); ++point) {
        const double* slip = history.slips.data() + kSlipReals * (point * m.contact.triangle_count() + triangle);
        out.slips.insert(out.slips.end(), slip, slip + kSlipReals);
      }
    }
  }
  if (m.links.contacts_remember()) {
    out.link_slips.reserve(sizes.link_slips);
    for (const std::uint32_t candidate : order_of_candidates(m)) {
      const double* slip = history.link_slips.data() + kSlipReals * candidate;
      out.link_slips.insert(out.link_slips.end(), slip, slip + kSlipReals);
    }
    if (m.links.edge_candidate_count() > 0) {
      out.edge_pairs = edge_pairs_of(m, history.link_slips.data() + sizes.link_slips);
    }
  }
  out.blade_points = blade_points_of(m, history.link_slips);
  out.broken.reserve(sizes.broken);
  for (const std::uint32_t place : m.links.spring_places) out.broken.push_back(history.broken[place] != 0 ? 1 : 0);
  return out;
}

LayoutState in_layout(const Model& m, const NodeState& state) {
  const NodeStateSizes sizes = sizes_of(m);
  TM_ASSERT(state.displacement.size() == sizes.nodes && state.velocity.size() == sizes.nodes &&
                state.previous_displacement.size() == sizes.previous &&
                state.previous_velocity.size() == sizes.previous && state.solution.size() == sizes.solution &&
                state.internal_variables.size() == sizes.internal_variables && state.slips.size() == sizes.slips &&
                state.link_slips.size() == sizes.link_slips && state.broken.size() == sizes.broken &&
                state.blade_points.size() == sizes.blade_points,
            "a state is of the same scene");
  LayoutState out;
  auto& [rows, history] = out;
  rows.displacement = rows_of(m.layout, state.displacement);
  rows.velocity = rows_of(m.layout, state.velocity);
  history.previous_displacement = rows_of(m.layout, state.previous_displacement);
  history.previous_velocity = rows_of(m.layout, state.previous_velocity);
  history.solution = rows_of(m.layout, state.solution);
  rows.internal_dt_s = state.internal_dt_s;
  history.last_dt_s = state.last_dt_s;
  history.largest_force_squared = state.largest_force_squared;
  history.coarse_solves = state.coarse_solves;

  rows.internal_variables.assign(variables_in_layout(m), 0.0);
  for_each_viscoelastic(m, [&](const GroupVariables& group, std::size_t in_layout, std::size_t by_element) {
    group.to_layout(state.internal_variables.data() + by_element, rows.internal_variables.data() + in_layout);
  });

  history.slips.resize(sizes.slips);
  if (const double* slip = state.slips.data(); sizes.slips > 0) {
    for (const std::uint32_t triangle : order_of_triangles(m)) {
      for (std::size_t point = 0; point < m.contact_points(); ++point, slip += kSlipReals) {
        std::copy_n(slip, kSlipReals, &history.slips[kSlipReals * (point * m.contact.triangle_count() + triangle)]);
      }
    }
  }
  if (m.links.contacts_remember()) {
    history.link_slips.assign(sizes.link_slips + view::kEdgeMemory * std::size_t{m.links.edge_slot_count()}, 0.0);
    const double* slip = state.link_slips.data();
    for (const std::uint32_t candidate : order_of_candidates(m)) {
      std::copy_n(slip, kSlipReals, &history.link_slips[kSlipReals * candidate]);
      slip += kSlipReals;
    }
    put_edge_pairs(m, state.edge_pairs, history.link_slips.data() + sizes.link_slips);
  }
  put_blade_points(m, state.blade_points, history.link_slips);
  history.broken.resize(sizes.broken);
  for (std::size_t spring = 0; spring < sizes.broken; ++spring) {
    history.broken[m.links.spring_places[spring]] = state.broken[spring];
  }
  return out;
}

Result<void> check_edge_pairs(const Model& m, std::span<const EdgePair> pairs) {
  if (pairs.empty()) return {};
  const EdgeMemories edges(m);
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    const EdgePair& pair = pairs[i];
    const std::string where = fmt::format("edge_pairs[{}]", i);
    if (!(pair.edge < pair.other) || (i > 0 && !(pairs[i - 1] < pair))) {
      return invalid(fmt::format("{}: pairs of edges do not ascend", where));
    }
    if (pair.contact >= m.body_contacts.size() || pair.slot >= view::kEdgeSlots) {
      return invalid(fmt::format("{}: contact {}, slot {}; this scene has {} contacts of {} slots", where, pair.contact,
                                 pair.slot, m.body_contacts.size(), view::kEdgeSlots));
    }
    const auto edge = edges.edge_at(pair.edge), other = edges.edge_at(pair.other);
    if (!edge || !other) return invalid(fmt::format("{}: this scene has no such sharp edges", where));
    const model::BodyContactModel& contact = m.body_contacts[pair.contact];
    const std::size_t body = m.body_of_node(pair.edge[0]), other_body = m.body_of_node(pair.other[0]);
    const bool searches = edges.candidate_at(pair.contact, *edge) || edges.candidate_at(pair.contact, *other);
    if (!searches || std::minmax(body, other_body) != std::minmax(contact.body, contact.other)) {
      return invalid(
          fmt::format("{}: these edges are not of the two bodies that touch in contact {}", where, pair.contact));
    }
  }
  return {};
}

}  // namespace tensormass::world
