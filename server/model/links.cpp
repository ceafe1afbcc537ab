#include <algorithm>
#include <array>
#include <map>
#include <numeric>
#include <utility>

#include "mesh/partition.h"
#include "model/compile_parts.h"

/// Makes the tables of links (view/links.h) from contacts between bodies and attachments.
namespace tensormass::model {

namespace {

/// Cosine of the angle between the normals of two triangles beyond which their edge is sharp: 45°.
constexpr double kSharpTurnCosine = 0.7;
/// Cosine of the angle up to which an edge continues the ridge of another.
constexpr double kRidgeCosine = 0.7;

class LinkMaker {
 public:
  explicit LinkMaker(const LinkInput& input) : in_(input), layout_(input.layout) {}

  Links make() {
    if (!in_.links.contacts.empty()) {
      find_surfaces();
      for (const BodyContactModel& contact : in_.links.contacts) {
        const auto side = static_cast<std::uint32_t>(out_.side_groups.size() / 3);
        add_side(contact, contact.body, contact.other);
        if (contact.body == contact.other) continue;
        add_side(contact, contact.other, contact.body);
        add_edges(contact, side);
      }
      store_candidates();
      store_edges();
    }
    store_springs();
    if (!in_.links.blades.empty()) out_.blades = make_blades(in_);
    store_rows();
    return std::move(out_);
  }

 private:
  struct Candidate {
    std::uint32_t row, vertex, side;
    double area_m2, modulus_pa;
  };
  struct Spring {
    std::uint32_t row, other, number;  // number: in the order of the scene
    std::array<double, 3> numbers;
  };
  struct EdgeCandidate {
    std::uint32_t row, edge, side;
  };
  struct Surface {
    std::vector<std::uint32_t> vertices, triangles;  ///< places in ContactSurface
    std::array<std::uint32_t, 2> groups{0, 0};       ///< groups of boxes
    bool has_edges = false;                          ///< its sharp edges have been looked for
    std::uint32_t edge_begin = 0, edge_end = 0;      ///< sharp edges
    double mean_edge_m = 0;                          ///< mean length of the sharp edges
  };

  std::size_t body_of_row(std::uint32_t row) const { return body_of_node(in_.bodies.bodies, layout_.node_of_row[row]); }

  /// Divides the contact surface among the bodies, and puts boxes around the triangles of those that are touched.
  void find_surfaces() {
    const ContactSurface& contact = in_.contact;
    surfaces_.resize(in_.bodies.bodies.size());
    sums_ = sums_at_vertices(contact);
    for (std::uint32_t v = 0; v < contact.surface_rows.size(); ++v) {
      surfaces_[body_of_row(contact.surface_rows[v])].vertices.push_back(v);
    }
    for (std::uint32_t t = 0; t < contact.outer_count(); ++t) {
      surfaces_[body_of_row(contact.triangle_rows[3 * std::size_t{t}])].triangles.push_back(t);
    }
    for (const BodyContactModel& pair : in_.links.contacts) {
      for (const std::size_t body : {pair.body, pair.other}) {
        if (surfaces_[body].groups[1] == 0) add_boxes(surfaces_[body]);
      }
    }
  }

  void add_boxes(Surface& surface) {
    const ContactSurface& contact = in_.contact;
    std::vector<Eigen::Vector3d> centers;
    for (const std::uint32_t triangle : surface.triangles) {
      Eigen::Vector3d sum = Eigen::Vector3d::Zero();
      for (std::size_t i = 0; i < 3; ++i) {
        sum += in_.bodies.merged.nodes[layout_.node_of_row[contact.triangle_rows[3 * std::size_t{triangle} + i]]];
      }
      centers.push_back(sum / 3);
    }
    constexpr std::uint32_t kGroupTriangles = view::kLeafTriangles * view::kGroupLeaves;
    const auto begin = static_cast<std::uint32_t>(out_.leaf_triangles.size() / kGroupTriangles);
    for (const std::uint32_t i : mesh::bisection_order(centers, view::kLeafTriangles)) {
      out_.leaf_triangles.push_back(surface.triangles[i]);
    }
    const auto groups = (static_cast<std::uint32_t>(surface.triangles.size()) - 1) / kGroupTriangles + 1;
    out_.leaf_triangles.resize(std::size_t{begin + groups} * kGroupTriangles, view::kNoTriangle);
    surface.groups = {begin, begin + groups};
  }

  /// Lets the nodes of one body touch the surface of another.
  void add_side(const BodyContactModel& contact, std::size_t of_nodes, std::size_t touched) {
    const auto side = static_cast<std::uint32_t>(out_.side_groups.size() / 3);
    const std::array<std::uint32_t, 2>& groups = surfaces_[touched].groups;
    out_.side_groups.insert(out_.side_groups.end(), {groups[0], groups[1], of_nodes == touched ? 1u : 0u});
    std::array<double, view::kSideNumbers> numbers{};
    numbers[view::kSidePenalty] = contact.penalty_pa_per_m;
    numbers[view::kSidePenaltyPerM] = contact.penalty_per_m;
    numbers[view::kSideDistance] = contact.distance_m;
    numbers[view::kSideReach] = contact.reach_m;
    numbers[view::kSideFriction] = contact.friction;
    out_.side_numbers.insert(out_.side_numbers.end(), numbers.begin(), numbers.end());
    for (const std::uint32_t vertex : surfaces_[of_nodes].vertices) {
      candidates_.push_back({in_.contact.surface_rows[vertex], vertex, side, sums_.area_m2[vertex] / 2,
                             sums_.stiffness[vertex] / sums_.area_m2[vertex]});
    }
  }

  Eigen::Vector3d position_of_row(std::uint32_t row) const { return in_.bodies.merged.nodes[layout_.node_of_row[row]]; }
  std::uint32_t row_of_corner(std::uint32_t triangle, std::size_t corner) const {
    return in_.contact.triangle_rows[3 * std::size_t{triangle} + corner % 3];
  }
  Eigen::Vector3d normal_of(std::uint32_t triangle) const {
    const Eigen::Vector3d x = position_of_row(row_of_corner(triangle, 0));
    return (position_of_row(row_of_corner(triangle, 1)) - x)
        .cross(position_of_row(row_of_corner(triangle, 2)) - x)
        .normalized();
  }

  /// Lets the sharp edges of two bodies touch. The body with the shorter ones searches, so an edge finds few others.
  ///
  ///   side   the one of the nodes of contact.body; that of contact.other follows it
  void add_edges(const BodyContactModel& contact, std::uint32_t side) {
    find_edges(surfaces_[contact.body]);
    find_edges(surfaces_[contact.other]);
    const Surface &a = surfaces_[contact.body], &b = surfaces_[contact.other];
    if (a.edge_begin == a.edge_end || b.edge_begin == b.edge_end) return;
    const bool first = a.mean_edge_m <= b.mean_edge_m;
    const Surface& searching = first ? a : b;
    for (std::uint32_t edge = searching.edge_begin; edge < searching.edge_end; ++edge) {
      edge_candidates_.push_back({out_.edge_rows[4 * std::size_t{edge}], edge, first ? side : side + 1});
    }
  }

  /// Stores the sharp edges of a body.
  void find_edges(Surface& surface) {
    if (surface.has_edges) return;
    surface.has_edges = true;
    surface.edge_begin = surface.edge_end = static_cast<std::uint32_t>(out_.edge_rows.size() / 4);
    const ContactSurface& contact = in_.contact;
    out_.triangle_edges.resize(contact.triangle_rows.size(), view::kNoEntry);
    double sum_m = 0;
    for (const std::uint32_t triangle : surface.triangles) {
      for (std::size_t corner = 0; corner < 3; ++corner) {
        const std::uint32_t across = contact.triangle_neighbours[3 * std::size_t{triangle} + corner];
        if (across >= contact.outer_count() || across < triangle) continue;  // none, carried; or each edge once
        const Eigen::Vector3d normal = normal_of(triangle), other_normal = normal_of(across);
        if (!(normal.dot(other_normal) < kSharpTurnCosine)) continue;
        const std::array<std::uint32_t, 3> rows{row_of_corner(triangle, corner), row_of_corner(triangle, corner + 1),
                                                row_of_corner(triangle, corner + 2)};
        std::size_t far = 0;
        while (row_of_corner(across, far) == rows[0] || row_of_corner(across, far) == rows[1]) ++far;
        const std::uint32_t far_row = row_of_corner(across, far);
        const Eigen::Vector3d start = position_of_row(rows[0]);
        if (!(other_normal.dot(position_of_row(rows[2]) - start) < 0)) continue;  // concave
        const double length_m = (position_of_row(rows[1]) - start).norm(), area = contact.triangle_area[triangle],
                     other_area = contact.triangle_area[across];
        out_.triangle_edges[3 * std::size_t{triangle} + corner] = surface.edge_end++;
        out_.edge_rows.insert(out_.edge_rows.end(), {rows[0], rows[1], rows[2], far_row});
        std::array<double, view::kEdgeNumbers> numbers{};
        numbers[view::kEdgeArea] = (area + other_area) / 3;
        numbers[view::kEdgeModulus] = modulus_of_edge(contact, triangle, across);
        numbers[view::kEdgeWidth] = 2 * std::min(area, other_area) / length_m;
        out_.edge_numbers.insert(out_.edge_numbers.end(), numbers.begin(), numbers.end());
        sum_m += length_m;
      }
    }
    if (surface.edge_end > surface.edge_begin) surface.mean_edge_m = sum_m / (surface.edge_end - surface.edge_begin);
    find_ends_of_ridges(surface);
  }

  /// Finds at which of their ends sharp edges are not continued by another.
  void find_ends_of_ridges(const Surface& surface) {
    std::map<std::uint32_t, std::vector<std::pair<std::uint32_t, Eigen::Vector3d>>> leaving;  // by row: edge, direction
    const auto row_of = [&](std::uint32_t edge, std::size_t end) {
      return out_.edge_rows[4 * std::size_t{edge} + end];
    };
    const auto direction = [&](std::uint32_t edge, std::size_t from) -> Eigen::Vector3d {
      return (position_of_row(row_of(edge, 1 - from)) - position_of_row(row_of(edge, from))).normalized();
    };
    for (std::uint32_t edge = surface.edge_begin; edge < surface.edge_end; ++edge) {
      for (const std::size_t end : {0, 1}) leaving[row_of(edge, end)].emplace_back(edge, direction(edge, end));
    }
    for (std::uint32_t edge = surface.edge_begin; edge < surface.edge_end; ++edge) {
      for (const std::size_t end : {0, 1}) {
        const Eigen::Vector3d own = direction(edge, end);
        const auto& others = leaving[row_of(edge, end)];
        const bool goes_on = std::any_of(others.begin(), others.end(), [&](const auto& other) {
          return other.first != edge && other.second.dot(own) < -kRidgeCosine;
        });
        out_.edge_numbers[std::size_t{view::kEdgeNumbers} * edge + view::kEdgeFirstEnds + end] = goes_on ? 0 : 1;
      }
    }
  }

  void store_edges() {
    if (edge_candidates_.empty()) {  // no pair of bodies has sharp edges on both sides
      out_.edge_rows.clear();
      out_.edge_numbers.clear();
      out_.triangle_edges.clear();
      return;
    }
    out_.patch_edge_candidates = group_by_patch(edge_candidates_);
    for (const EdgeCandidate& candidate : edge_candidates_) {
      out_.edge_candidates.insert(out_.edge_candidates.end(), {candidate.edge, candidate.side});
    }
  }

  /// Sorts items by row and counts those of each patch.
  template <class Item>
  std::vector<std::uint32_t> group_by_patch(std::vector<Item>& items) const {
    std::stable_sort(items.begin(), items.end(), [](const Item& a, const Item& b) { return a.row < b.row; });
    std::vector<std::uint32_t> begin(layout_.patch_count + 1, 0);
    for (const Item& item : items) ++begin[layout_.patch_of_row(item.row) + 1];
    std::partial_sum(begin.begin(), begin.end(), begin.begin());
    return begin;
  }

  void store_candidates() {
    out_.patch_candidates = group_by_patch(candidates_);
    for (const Candidate& candidate : candidates_) {
      out_.candidates.insert(out_.candidates.end(), {candidate.vertex, candidate.side});
      out_.candidate_area.push_back(candidate.area_m2);
      out_.candidate_modulus.push_back(candidate.modulus_pa);
    }
  }

  void store_springs() {
    std::vector<Spring> springs;
    if (in_.links.attachments.empty()) return;
    out_.attachment_begin.push_back(0);
    for (const ReadAttachment& attachment : in_.links.attachments) {
      for (std::size_t i = 0; i < attachment.springs.size(); ++i) {
        const auto& [node, other] = attachment.springs[i];
        springs.push_back({layout_.row_of_node[node],
                           layout_.row_of_node[other],
                           static_cast<std::uint32_t>(springs.size()),
                           {attachment.stiffness_n_per_m, attachment.rest_lengths_m[i], attachment.breaking_force_n}});
      }
      out_.attachment_begin.push_back(static_cast<std::uint32_t>(springs.size()));
    }
    out_.patch_springs = group_by_patch(springs);
    out_.spring_places.resize(springs.size());
    for (const Spring& spring : springs) {
      out_.spring_places[spring.number] = out_.spring_count();
      out_.spring_rows.insert(out_.spring_rows.end(), {spring.row, spring.other});
      out_.spring_numbers.insert(out_.spring_numbers.end(), spring.numbers.begin(), spring.numbers.end());
    }
  }

  void store_rows() {
    std::vector<bool> linked(layout_.row_count, false);
    for (const BodyContactModel& pair : in_.links.contacts) {
      for (const std::size_t body : {pair.body, pair.other}) {
        for (const std::uint32_t vertex : surfaces_[body].vertices) linked[in_.contact.surface_rows[vertex]] = true;
      }
    }
    for (const std::uint32_t row : out_.spring_rows) linked[row] = true;
    for (const std::uint32_t row : out_.blades.rows) linked[row] = true;
    out_.patch_rows.assign(layout_.patch_count + 1, 0);
    out_.row_place.resize(layout_.row_count);
    for (std::uint32_t row = 0; row < layout_.row_count; ++row) {
      const std::uint32_t patch = layout_.patch_of_row(row);
      out_.row_place[row] = row + layout_.patch_halo[patch];  // view::Patch::local_begin
      if (!linked[row]) continue;
      out_.rows.push_back(row);
      ++out_.patch_rows[patch + 1];
    }
    std::partial_sum(out_.patch_rows.begin(), out_.patch_rows.end(), out_.patch_rows.begin());
  }

  const LinkInput& in_;
  const matrix::Layout& layout_;
  Links out_;
  std::vector<Surface> surfaces_;  // [body]
  VertexSums sums_;
  std::vector<Candidate> candidates_;
  std::vector<EdgeCandidate> edge_candidates_;
};

}  // namespace

Links make_links(const LinkInput& input) { return LinkMaker(input).make(); }

}  // namespace tensormass::model
