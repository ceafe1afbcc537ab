#include <algorithm>
#include <array>
#include <limits>
#include <set>
#include <utility>
#include <vector>

#include <fmt/format.h>

#include "core/limits.h"
#include "core/names.h"
#include "model/read_parts.h"
#include "model/scene_input.h"
#include "tensormass/v1/scene.pb.h"

/// Reads contacts between bodies and attachments.
namespace tensormass::model {

namespace {

/// Contact pressure per depth, unless the scene gives it: this factor times E / edge, with E of the softer of the two
/// elements that touch. A tool's is twice as large, because a tool has no compliance of its own.
constexpr double kDefaultLinkPenalty = 10;
/// Distance at which surfaces begin to push each other, unless the scene gives it, as a part of the mean edge.
constexpr double kDefaultDistanceInEdges = 0.1;

class LinkReader {
 public:
  LinkReader(const v1::Scene& scene, const ReadBodies& all, BodyBoundaries& boundaries)
      : scene_(scene), all_(all), bodies_(all.bodies), boundaries_(boundaries) {}

  Result<ReadLinks> read() {
    TM_RETURN_IF_ERROR(
        check_count(scene_.body_contacts_size(), limits::kMaxBodyContacts, "body_contacts", "kMaxBodyContacts"));
    TM_RETURN_IF_ERROR(
        check_count(scene_.attachments_size(), limits::kMaxAttachments, "attachments", "kMaxAttachments"));
    for (int i = 0; i < scene_.body_contacts_size(); ++i) {
      TM_RETURN_IF_ERROR(read_contact(scene_.body_contacts(i), fmt::format("scene.body_contacts[{}]", i)));
    }
    for (int i = 0; i < scene_.attachments_size(); ++i) {
      TM_RETURN_IF_ERROR(read_attachment(scene_.attachments(i), fmt::format("scene.attachments[{}]", i)));
    }
    return std::move(out_);
  }

 private:
  static Result<void> check_count(int count, std::size_t most, std::string_view field, std::string_view limit) {
    if (static_cast<std::size_t>(count) <= most) return {};
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.{}: {} exceed limits::{} = {}", field, count, limit, most));
  }

  Result<std::size_t> find_body(const std::string& name, const std::string& where) const {
    for (std::size_t b = 0; b < bodies_.size(); ++b) {
      if (bodies_[b].name == name) return b;
    }
    const std::string known = list_names(bodies_, [](const ReadBody& body) { return "'" + body.name + "'"; });
    return invalid(fmt::format("{}: no body has the name '{}'; the scene has {}", where, name, known));
  }

  Result<void> read_contact(const v1::BodyContact& contact, const std::string& where) {
    TM_ASSIGN_OR_RETURN(body, find_body(contact.body(), where + ".body"));
    std::size_t other = body;
    if (!contact.other().empty()) {
      TM_ASSIGN_OR_RETURN(named, find_body(contact.other(), where + ".other"));
      other = named;
    }
    if (!pairs_.insert(std::minmax(body, other)).second) {
      return invalid(fmt::format("{}: an earlier entry names the same two bodies", where));
    }
    const double edge_m = boundaries_.mean_edge_m(body), other_edge_m = boundaries_.mean_edge_m(other);
    const double largest_m = std::max(edge_m, other_edge_m);
    BodyContactModel out{body, other, 0, 0, 0, 0, 0};
    TM_ASSIGN_OR_RETURN(distance,
                        read_number(contact.has_distance_m() ? contact.distance_m()
                                                             : kDefaultDistanceInEdges * std::min(edge_m, other_edge_m),
                                    0, limits::kMaxLength, where + ".distance_m"));
    if (contact.has_penalty_stiffness_pa_per_m()) {
      TM_ASSIGN_OR_RETURN(penalty, read_number(contact.penalty_stiffness_pa_per_m(), 1e-3, 1e18,
                                               where + ".penalty_stiffness_pa_per_m"));
      out.penalty_pa_per_m = penalty;
    } else {
      out.penalty_per_m = kDefaultLinkPenalty / largest_m;
    }
    TM_ASSIGN_OR_RETURN(friction, read_number(contact.friction_coefficient(), 0, limits::kMaxFriction,
                                              where + ".friction_coefficient"));
    TM_ASSIGN_OR_RETURN(reach,
                        read_number(contact.has_reach_m() ? contact.reach_m() : std::max(largest_m, 2 * distance), 1e-9,
                                    limits::kMaxLength, where + ".reach_m"));
    if (!(reach > distance)) {
      return invalid(
          fmt::format("{}.reach_m: {:.3g} m is not more than distance_m = {:.3g} m; surfaces could not push "
                      "each other",
                      where, reach, distance));
    }
    out.distance_m = distance;
    out.friction = friction;
    out.reach_m = reach;
    out_.contacts.push_back(out);
    return {};
  }

  /// Returns the nodes of a region, numbered in the scene.
  Result<std::vector<std::uint32_t>> nodes_of(std::size_t body, const v1::Region& region, const std::string& where) {
    const v1::Body& message = scene_.bodies(static_cast<int>(body));
    TM_ASSIGN_OR_RETURN(sets, read_sets(message, bodies_[body].nodes(), fmt::format("body '{}'", bodies_[body].name)));
    TM_ASSIGN_OR_RETURN(nodes, read_region(region, bodies_[body].nodes(), sets, where));
    for (std::uint32_t& node : nodes) node += bodies_[body].node_begin;
    return std::move(nodes);
  }

  /// Reads the lengths at rest, unless the scene leaves them to the mesh. out: [spring] those of the mesh
  static Result<void> read_rest_lengths(const v1::Attachment& attachment, const std::string& where,
                                        std::vector<double>& out) {
    const auto given = static_cast<std::size_t>(attachment.rest_lengths_m_size());
    if (given == 0) return {};
    if (given != 1 && given != out.size()) {
      return invalid(
          fmt::format("{}.rest_lengths_m: {} lengths for {} springs; give one for each, one for all, or none", where,
                      given, out.size()));
    }
    for (std::size_t i = 0; i < out.size(); ++i) {
      const int place = given == 1 ? 0 : static_cast<int>(i);
      TM_ASSIGN_OR_RETURN(length, read_number(attachment.rest_lengths_m(place), 0, limits::kMaxLength,
                                              fmt::format("{}.rest_lengths_m[{}]", where, place)));
      out[i] = length;
    }
    return {};
  }

  Result<void> read_attachment(const v1::Attachment& attachment, const std::string& at) {
    TM_RETURN_IF_ERROR(check_name(attachment.name(), at + ".name"));
    if (!names_.insert(attachment.name()).second) {
      return invalid(fmt::format("{}: the name '{}' is taken by another attachment", at, attachment.name()));
    }
    const std::string where = fmt::format("attachment '{}'", attachment.name());
    TM_ASSIGN_OR_RETURN(body, find_body(attachment.body(), where + ".body"));
    TM_ASSIGN_OR_RETURN(other, find_body(attachment.other(), where + ".other"));
    TM_ASSIGN_OR_RETURN(nodes, nodes_of(body, attachment.region(), where + ".region"));
    TM_ASSIGN_OR_RETURN(others, nodes_of(other, attachment.other_region(), where + ".other_region"));
    if (nodes.size() * others.size() > limits::kMaxAttachmentPairs) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("{}: {} and {} nodes make more pairs than limits::kMaxAttachmentPairs = {}; make the "
                              "regions smaller",
                              where, nodes.size(), others.size(), limits::kMaxAttachmentPairs));
    }
    const auto count = static_cast<double>(nodes.size());
    TM_ASSIGN_OR_RETURN(stiffness,
                        read_number(attachment.stiffness_n_per_m(), 1e-9, 1e12, where + ".stiffness_n_per_m"));
    ReadAttachment out{attachment.name(), {}, {}, stiffness / count, std::numeric_limits<double>::infinity()};
    if (attachment.has_breaking_force_n()) {
      TM_ASSIGN_OR_RETURN(
          force, read_number(attachment.breaking_force_n(), 1e-9, limits::kMaxForceN, where + ".breaking_force_n"));
      out.breaking_force_n = force / count;
    }
    const auto& x = all_.merged.nodes;
    for (const std::uint32_t node : nodes) {
      const std::uint32_t nearest =
          *std::min_element(others.begin(), others.end(), [&](std::uint32_t a, std::uint32_t b) {
            return (x[a] - x[node]).squaredNorm() < (x[b] - x[node]).squaredNorm();
          });
      if (nearest == node) {
        return invalid(fmt::format("{}: node {} of body '{}' is in both regions; a spring needs two nodes", where,
                                   node - bodies_[body].node_begin, attachment.body()));
      }
      out.springs.push_back({node, nearest});
      out.rest_lengths_m.push_back((x[node] - x[nearest]).norm());
    }
    TM_RETURN_IF_ERROR(read_rest_lengths(attachment, where, out.rest_lengths_m));
    out_.attachments.push_back(std::move(out));
    return {};
  }

  const v1::Scene& scene_;
  const ReadBodies& all_;
  const std::vector<ReadBody>& bodies_;
  BodyBoundaries& boundaries_;
  ReadLinks out_;
  std::set<std::pair<std::size_t, std::size_t>> pairs_;
  std::set<std::string> names_;
};

}  // namespace

double BodyBoundaries::mean_edge_m(std::size_t body) {
  const mesh::Surface& surface = of(body);
  const std::vector<Eigen::Vector3d>& nodes = bodies_[body].mesh.nodes;
  double sum_m = 0;
  for (const mesh::Triangle& triangle : surface.triangles) {
    for (std::size_t i = 0; i < 3; ++i)
      sum_m += (nodes[surface.nodes[triangle[i]]] - nodes[surface.nodes[triangle[(i + 1) % 3]]]).norm();
  }
  return sum_m / (3 * static_cast<double>(surface.triangles.size()));
}

Result<ReadLinks> read_links(const v1::Scene& scene, const ReadBodies& bodies, BodyBoundaries& boundaries) {
  return LinkReader(scene, bodies, boundaries).read();
}

}  // namespace tensormass::model
