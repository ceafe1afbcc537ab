#include "mesh/cut.h"

#include <algorithm>
#include <cmath>

#include "core/assert.h"
#include "mesh/geometry.h"

namespace tensormass::mesh {
namespace {

constexpr std::uint32_t kReal = 0;  // the member that stands for all material of a node

/// Reserves memory and writes to it once, so that no edit waits for its first page.
template <class Item>
void reserve_touched(std::vector<Item>& items, std::size_t count) {
  items.resize(count);
  items.clear();
}

}  // namespace

std::string_view words(CutRefusal refusal) {
  switch (refusal) {
    case CutRefusal::kUnknownEdge:
      return "an edge to cut is not in the mesh; take edges from CutSearch of the same mesh";
    case CutRefusal::kCrossing:
      return "a crossing is not a number from 0 to 1; take crossings from CutSearch";
    case CutRefusal::kPartsFull:
      return "the reserve of parts is used up; load with a larger reserve, or reset";
    case CutRefusal::kRowsFull:
      return "the reserve of virtual nodes is used up; load with a larger reserve, or reset";
  }
  return "";
}

Cut::Cut(const CutTopology& topology, const CutReserve& reserve)
    : topology_(topology),
      reserve_(reserve),
      edge_cut_(topology.edge_count(), 0),
      crossings_(topology.edge_count(), 0.5),
      first_part_(topology.element_count(), kNone),
      element_edit_(topology.element_count(), 0),
      node_edit_(topology.node_count(), 0),
      part_edit_(reserve.parts, 0),
      member_of_part_(reserve.parts, 0),
      piece_of_row_(topology.node_count() + reserve.rows, 0),
      piece_volume_m3_(topology.node_count() + reserve.rows, 0.0) {
  reserve_touched(parts_, reserve.parts);
  reserve_touched(virtual_nodes_, reserve.rows);
  reserve_touched(new_edges_, topology.edge_count());
  reserve_touched(touched_elements_, topology.element_count());
  reserve_touched(split_elements_, topology.element_count());
  reserve_touched(touched_nodes_, topology.node_count());
  reserve_touched(changed_parts_, reserve.parts);
  reserve_touched(saved_, reserve.parts);
  std::size_t max_members = 0;
  for (std::uint32_t node = 0; node < topology.node_count(); ++node) {
    std::size_t members = 0;
    for (const std::uint32_t element : topology.elements_of_node(node)) {
      members += topology.shape(element).corner_count;
    }
    max_members = std::max(max_members, members);
  }
  reserve_touched(members_, 1 + max_members);
  for (std::uint32_t element = 0; element < topology.element_count(); ++element) {
    const ElementGeometry geometry =
        element_geometry(topology.mesh(), topology.shape(element), topology.nodes(element));
    element_volume_m3_.push_back(geometry.volume_m3);
  }
}

ElementCut Cut::element_cut(std::uint32_t element) const {
  const Topology& shape = topology_.shape(element);
  ElementCut result{.shape = &shape, .cut_edges = 0, .crossings = {}};
  const std::span<const std::uint32_t> edges = topology_.edges(element), nodes = topology_.nodes(element);
  for (std::size_t i = 0; i < edges.size(); ++i) {
    if (edge_cut_[edges[i]] == 0) continue;
    const bool rises = nodes[shape.edges[i].nodes[0]] == topology_.ends(edges[i])[0];
    result.cut_edges |= 1u << i;
    result.crossings[i] = rises ? crossings_[edges[i]] : 1.0 - crossings_[edges[i]];
  }
  return result;
}

PartLabels Cut::labels(std::uint32_t element) const {
  return label_parts(topology_.shape(element), element_cut(element).cut_edges);
}

std::uint32_t Cut::part_of(std::uint32_t element, std::uint32_t corner) const {
  std::uint32_t part = first_part_[element];
  while ((parts_[part].corners >> corner & 1) == 0) part = parts_[part].next;
  return part;
}

CutChange Cut::cut(std::span<const CutEdge> edges) {
  ++edit_;
  new_edges_.clear();
  touched_elements_.clear();
  split_elements_.clear();
  touched_nodes_.clear();
  changed_parts_.clear();
  saved_.clear();
  parts_before_ = static_cast<std::uint32_t>(parts_.size());
  rows_before_ = static_cast<std::uint32_t>(virtual_nodes_.size());
  const auto refuse = [&](CutRefusal why) {
    undo();
    return CutChange{.refused = true,
                     .refusal = why,
                     .edges = {},
                     .elements = {},
                     .parts = {},
                     .first_part = parts_before_,
                     .first_row = rows_before_};
  };

  CutRefusal refusal{};
  if (!take_edges(edges, refusal)) return refuse(refusal);
  for (const std::uint32_t element : touched_elements_) {
    if (!split(element)) return refuse(CutRefusal::kPartsFull);
  }
  for (const std::uint32_t element : split_elements_) {
    for (const std::uint32_t node : topology_.nodes(element)) {
      if (node_edit_[node] == edit_) continue;
      node_edit_[node] = edit_;
      touched_nodes_.push_back(node);
    }
  }
  std::sort(touched_nodes_.begin(), touched_nodes_.end());
  for (const std::uint32_t node : touched_nodes_) {
    if (!join(node)) return refuse(CutRefusal::kRowsFull);
  }
  for (const std::uint32_t element : touched_elements_) share(element);
  std::sort(changed_parts_.begin(), changed_parts_.end());
  return {.refused = false,
          .refusal = {},
          .edges = new_edges_,
          .elements = touched_elements_,
          .parts = changed_parts_,
          .first_part = parts_before_,
          .first_row = rows_before_};
}

/// Marks edges as cut and lists their elements. Returns false if one is refused.
bool Cut::take_edges(std::span<const CutEdge> edges, CutRefusal& refusal) {
  for (const CutEdge& cut : edges) {
    refusal = CutRefusal::kUnknownEdge;
    if (cut.edge >= topology_.edge_count()) return false;
    refusal = CutRefusal::kCrossing;
    if (!(cut.crossing >= 0.0 && cut.crossing <= 1.0)) return false;
    if (edge_cut_[cut.edge] != 0) continue;
    edge_cut_[cut.edge] = 1;
    double& at = crossings_[cut.edge];
    at = std::clamp(cut.crossing, kMinCrossing, 1.0 - kMinCrossing);
    if (topology_.middle(cut.edge) != kNone && std::abs(at - 0.5) < kMiddleGap) at = 0.5 - kMiddleGap;
    new_edges_.push_back(cut.edge);
    for (const std::uint32_t element : topology_.elements_of_edge(cut.edge)) {
      if (element_edit_[element] == edit_) continue;
      element_edit_[element] = edit_;
      touched_elements_.push_back(element);
    }
  }
  std::sort(new_edges_.begin(), new_edges_.end());
  std::sort(touched_elements_.begin(), touched_elements_.end());
  return true;
}

/// Returns a part to write to, whose state before the edit is saved.
CutPart& Cut::change(std::uint32_t part) {
  if (part_edit_[part] != edit_) {
    part_edit_[part] = edit_;
    changed_parts_.push_back(part);
    if (part < parts_before_) saved_.push_back({part, parts_[part]});
  }
  return parts_[part];
}

void Cut::undo() {
  for (const std::uint32_t edge : new_edges_) {
    edge_cut_[edge] = 0;
    crossings_[edge] = 0.5;
  }
  // The first part of an element that was split before has its lowest corner still, so only new ones are undone.
  for (const std::uint32_t element : split_elements_) {
    if (first_part_[element] >= parts_before_) first_part_[element] = kNone;
  }
  parts_.resize(parts_before_);
  for (const Saved& saved : saved_) parts_[saved.index] = saved.part;
  virtual_nodes_.resize(rows_before_);
}

/// Splits an element into its parts. Each keeps the rows of the part that it comes from. The lowest of them keeps its
/// record. Returns false if there is no room.
bool Cut::split(std::uint32_t element) {
  const Topology& shape = topology_.shape(element);
  const ElementCut cut = element_cut(element);
  const PartLabels labels = label_parts(shape, cut.cut_edges);
  std::uint32_t before = first_part_[element] == kNone ? 1 : 0;
  for (std::uint32_t part = first_part_[element]; part != kNone; part = parts_[part].next) ++before;
  if (labels.count == before) return true;
  split_elements_.push_back(element);

  std::array<std::uint32_t, kMaxElementParts> records{};
  for (std::uint8_t p = 0; p < labels.count; ++p) {
    const std::uint8_t corners = labels.corners(p);
    std::uint32_t source = first_part_[element];
    while (source != kNone && (parts_[source].corners & corners) == 0) source = parts_[source].next;
    const bool keeps =
        source != kNone && std::find(records.begin(), records.begin() + p, source) == records.begin() + p;
    if (keeps) {
      records[p] = source;
      continue;
    }
    if (parts_.size() == reserve_.parts) return false;
    records[p] = static_cast<std::uint32_t>(parts_.size());
    CutPart part;
    part.element = element;
    part.parent = source;
    if (source == kNone) {
      part.rows.fill(kNone);
      const std::span<const std::uint32_t> nodes = topology_.nodes(element);
      std::copy(nodes.begin(), nodes.end(), part.rows.begin());
    } else {
      part.rows = parts_[source].rows;
    }
    parts_.push_back(part);
  }
  for (std::uint8_t p = 0; p < labels.count; ++p) {
    CutPart& part = change(records[p]);
    part.corners = labels.corners(p);
    part.nodes = part.corners;
    for (std::size_t edge = 0; shape.has_mid_edge_nodes() && edge < shape.edges.size(); ++edge) {
      if ((part.corners >> owner_of_middle(cut, edge) & 1) != 0) part.nodes |= 1u << (shape.corner_count + edge);
    }
    part.next = p + 1 < labels.count ? records[p + 1] : kNone;
  }
  first_part_[element] = records[0];
  return true;
}

std::uint32_t Cut::find(std::uint32_t member) {
  while (members_[member].set != member) member = members_[member].set = members_[members_[member].set].set;
  return member;
}

void Cut::unite(std::uint32_t a, std::uint32_t b) {
  a = find(a);
  b = find(b);
  members_[std::max(a, b)].set = std::min(a, b);
}

/// Unites the copies of a node, which `members_` lists, across a face of a split element that has the node.
void Cut::unite_across(std::uint32_t element, std::uint32_t face) {
  const FaceNeighbour other = topology_.neighbour(element, face);
  if (other.element == kNone) return;
  const bool whole = first_part_[other.element] == kNone;
  if (!whole && other.element < element) return;  // done from there
  const Face& corners = topology_.shape(element).faces[face];
  const std::span<const std::uint32_t> nodes = topology_.nodes(element), other_nodes = topology_.nodes(other.element);
  for (std::size_t i = 0; i < corners.corner_count(); ++i) {
    const std::uint32_t corner = corners.nodes[i];
    if (whole) {
      unite(kReal, member_of(element, corner));
      continue;
    }
    const auto same = std::find(other_nodes.begin(), other_nodes.end(), nodes[corner]) - other_nodes.begin();
    unite(member_of(element, corner), member_of(other.element, static_cast<std::uint32_t>(same)));
  }
}

/// Finds which copies of a node are one, and gives each of them a row. Returns false if there is no room.
///
/// Members are the copies of the node in split elements, by element and lowest corner. Member kReal stands for the node
/// itself: for its copies in whole elements and in parts that have its material.
bool Cut::join(std::uint32_t node) {
  members_.clear();
  members_.push_back({kNone, 0, kReal, node});
  const std::span<const std::uint32_t> star = topology_.elements_of_node(node);
  const auto local = [&](std::uint32_t element) {
    const std::span<const std::uint32_t> nodes = topology_.nodes(element);
    return static_cast<std::uint32_t>(std::find(nodes.begin(), nodes.end(), node) - nodes.begin());
  };
  for (const std::uint32_t element : star) {
    for (std::uint32_t part = first_part_[element]; part != kNone; part = parts_[part].next) {
      const auto member = static_cast<std::uint32_t>(members_.size());
      const std::uint32_t k = local(element);
      members_.push_back({part, k, member, kNone});
      member_of_part_[part] = member;
      if ((parts_[part].nodes >> k & 1u) != 0) unite(kReal, member);
    }
  }
  for (const std::uint32_t element : star) {
    if (first_part_[element] == kNone) continue;
    const Topology& shape = topology_.shape(element);
    const std::uint32_t k = local(element);
    for (std::uint32_t f = 0; f < shape.faces.size(); ++f) {
      const Face& face = shape.faces[f];
      const auto end = face.nodes.begin() + face.node_count;
      if (std::find(face.nodes.begin(), end, k) != end) unite_across(element, f);
    }
  }

  for (std::uint32_t m = 1; m < members_.size(); ++m) {
    const std::uint32_t root = find(m), part = members_[m].part, k = members_[m].node;
    if (members_[root].row == kNone) {
      // The first set with a virtual node's row keeps it.
      const std::uint32_t old = parts_[part].rows[k];
      const bool taken =
          std::any_of(members_.begin(), members_.begin() + m, [&](const Member& other) { return other.row == old; });
      if (!taken) {
        members_[root].row = old;
      } else {
        if (virtual_nodes_.size() == reserve_.rows) return false;
        members_[root].row = row_count();
        virtual_nodes_.push_back({node, old});
      }
    }
    if (parts_[part].rows[k] != members_[root].row) change(part).rows[k] = members_[root].row;
  }
  return true;
}

/// Computes the shares of an element's parts.
void Cut::share(std::uint32_t element) {
  if (first_part_[element] == kNone) return;
  const ElementCut cut = element_cut(element);
  const std::span<const std::uint32_t> nodes = topology_.nodes(element);
  std::array<Eigen::Vector3d, kMaxElementNodes> positions_m;
  for (std::size_t k = 0; k < nodes.size(); ++k) positions_m[k] = topology_.mesh().nodes[nodes[k]];
  const auto shares =
      part_shares(cut, label_parts(*cut.shape, cut.cut_edges), std::span(positions_m).first(nodes.size()));
  std::size_t p = 0;
  for (std::uint32_t part = first_part_[element]; part != kNone; part = parts_[part].next) {
    change(part).shares = shares[p++];
  }
}

void Cut::reset() {
  std::fill(edge_cut_.begin(), edge_cut_.end(), std::uint8_t{0});
  std::fill(crossings_.begin(), crossings_.end(), 0.5);
  std::fill(first_part_.begin(), first_part_.end(), kNone);
  parts_.clear();
  virtual_nodes_.clear();
}

std::size_t Cut::pieces(std::span<CutPiece> room) {
  const std::uint32_t rows = row_count();
  for (std::uint32_t row = 0; row < rows; ++row) {
    piece_of_row_[row] = row;
    piece_volume_m3_[row] = 0.0;
  }
  const auto root = [&](std::uint32_t row) {
    while (piece_of_row_[row] != row) row = piece_of_row_[row] = piece_of_row_[piece_of_row_[row]];
    return row;
  };
  const auto join_rows = [&](std::span<const std::uint32_t> of_copy) {
    for (const std::uint32_t row : of_copy) {
      const std::uint32_t a = root(of_copy[0]), b = root(row);
      piece_of_row_[std::max(a, b)] = std::min(a, b);
    }
  };
  // visit(rows, volume) is called for each whole element and each part.
  const auto for_each_copy = [&](auto&& visit) {
    for (std::uint32_t element = 0; element < topology_.element_count(); ++element) {
      const std::span<const std::uint32_t> nodes = topology_.nodes(element);
      if (first_part_[element] == kNone) visit(nodes, element_volume_m3_[element]);
      for (std::uint32_t p = first_part_[element]; p != kNone; p = parts_[p].next) {
        const CutPart& part = parts_[p];
        visit(std::span<const std::uint32_t>(part.rows).first(nodes.size()),
              part.shares.volume * element_volume_m3_[element]);
      }
    }
  };
  for_each_copy([&](std::span<const std::uint32_t> of_copy, double) { join_rows(of_copy); });
  for_each_copy([&](std::span<const std::uint32_t> of_copy, double volume_m3) {
    piece_volume_m3_[root(of_copy[0])] += volume_m3;
  });
  std::size_t count = 0;
  for (std::uint32_t row = 0; row < rows; ++row) {
    if (root(row) != row) continue;
    if (count < room.size()) room[count] = {row, piece_volume_m3_[row]};
    ++count;
  }
  return count;
}

}  // namespace tensormass::mesh
