#include "mesh/admission.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <future>
#include <numbers>
#include <numeric>

#include <fmt/format.h>
#include <fmt/ranges.h>

#include "core/finding_kinds.h"
#include "core/limits.h"
#include "mesh/components.h"
#include "mesh/conformity.h"
#include "mesh/geometry.h"
#include "mesh/shapes.h"

/// One pass over the elements does most checks (see `admit` in admission.h for their order).
///
/// Each check only counts and describes its first occurrence (Problem): a broken mesh may have millions of broken
/// elements. Volume and component count of the report come from the same pass. Errors are put together at the end, so
/// that the user sees all kinds at once.
namespace tensormass::mesh {
namespace {

using thresholds::kSliverDihedralDeg;

using Nodes = std::span<const std::uint32_t>;

bool acceptable(const Eigen::Vector3d& point) {
  return (point.array().abs() <= limits::kMaxLength).all();  // false for NaN
}

/// Checks the coordinates of a mesh's nodes or a skin's vertices. `what` names one of them in the error.
Result<void> check_points(std::span<const Eigen::Vector3d> points, std::string_view what, std::string_view owner) {
  Problem bad;
  for (std::size_t i = 0; i < points.size(); ++i) {
    if (acceptable(points[i])) continue;
    bad.add([&] {
      return fmt::format("{} {} of {} is at ({}, {}, {})", what, i, owner, points[i].x(), points[i].y(), points[i].z());
    });
  }
  if (bad.count == 0) return {};
  return invalid(bad.text(fmt::format("give finite coordinates within ±{} m", limits::kMaxLength)));
}

Result<void> check_sizes(const Mesh& mesh, std::string_view body) {
  if (mesh.nodes.empty()) return invalid(fmt::format("body '{}' has no nodes; give a mesh", body));
  if (mesh.nodes.size() > limits::kMaxNodes) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("body '{}' has {} nodes; limits::kMaxNodes is {}; use a coarser mesh", body,
                            mesh.nodes.size(), limits::kMaxNodes));
  }
  std::size_t elements = 0;
  for (const ElementBlock& block : mesh.blocks) {
    const Topology& shape = topology(block.shape);
    if (block.nodes.size() % shape.node_count != 0) {
      return invalid(
          fmt::format("body '{}' has {} node indices in {} elements, not a multiple of {}; send whole elements", body,
                      block.nodes.size(), shape.name, shape.node_count));
    }
    elements += block.nodes.size() / shape.node_count;
  }
  if (elements == 0) return invalid(fmt::format("body '{}' has no elements; give a volume mesh", body));
  if (elements > limits::kMaxElements) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("body '{}' has {} elements; limits::kMaxElements is {}; use a coarser mesh", body, elements,
                            limits::kMaxElements));
  }
  return {};
}

Result<void> check_indices(const Mesh& mesh, std::string_view body) {
  Problem out_of_range;
  for_each_element(mesh, [&](std::uint32_t element, const Topology&, Nodes nodes) {
    for (const std::uint32_t node : nodes) {
      if (node < mesh.nodes.size()) continue;
      out_of_range.add([&] {
        return fmt::format("element {} of body '{}' refers to node {}, and the mesh has {} nodes", element, body, node,
                           mesh.nodes.size());
      });
      break;
    }
  });
  if (out_of_range.count == 0) return {};
  return invalid(out_of_range.text("count nodes from 0 and send all of them"));
}

bool repeats_a_node(Nodes nodes) {
  for (std::size_t i = 1; i < nodes.size(); ++i) {
    if (std::find(nodes.begin(), nodes.begin() + i, nodes[i]) != nodes.begin() + i) return true;
  }
  return false;
}

bool is_flat(const ElementGeometry& geometry) {
  return std::abs(geometry.min_jacobian_m3) < kMinRelativeVolume * std::pow(geometry.max_edge_m, 3) ||
         geometry.max_edge_m == 0.0;
}

/// Finds elements with the same nodes in any order. Sorts elements by a hash of their nodes, then compares those with
/// equal hashes.
Problem find_duplicates(const Mesh& mesh, std::string_view body) {
  using Sorted = std::vector<std::uint32_t>;
  struct Entry {
    std::uint64_t hash;
    std::uint32_t element;
    bool operator<(const Entry& other) const {
      return hash != other.hash ? hash < other.hash : element < other.element;
    }
  };
  std::vector<Entry> entries;
  entries.reserve(element_count(mesh));
  for_each_element(mesh, [&](std::uint32_t element, const Topology&, Nodes nodes) {
    std::uint64_t hash = 0;
    for (const std::uint32_t node : nodes) {  // a sum, so that the order of the nodes does not matter
      std::uint64_t mixed = (node + std::uint64_t{1}) * 0x9E3779B97F4A7C15u;
      mixed = (mixed ^ mixed >> 32) * 0xD6E8FEB86659FD93u;
      hash += mixed ^ mixed >> 32;
    }
    entries.push_back({hash, element});
  });
  std::sort(entries.begin(), entries.end());

  const auto nodes_of = element_nodes(mesh);
  std::vector<std::pair<std::uint32_t, std::uint32_t>> pairs;  // (the later element, the earlier one)
  std::vector<std::pair<Sorted, std::uint32_t>> same_hash;
  for (auto entry = entries.begin(); entry != entries.end();) {
    const auto end = std::find_if(entry, entries.end(), [&](const Entry& other) { return other.hash != entry->hash; });
    if (end - entry > 1) {
      same_hash.clear();
      for (auto it = entry; it != end; ++it) {
        Sorted sorted(nodes_of[it->element].begin(), nodes_of[it->element].end());
        std::sort(sorted.begin(), sorted.end());
        same_hash.emplace_back(std::move(sorted), it->element);
      }
      std::sort(same_hash.begin(), same_hash.end());
      for (std::size_t i = 1; i < same_hash.size(); ++i) {
        if (same_hash[i].first == same_hash[i - 1].first) {
          pairs.emplace_back(same_hash[i].second, same_hash[i - 1].second);
        }
      }
    }
    entry = end;
  }
  std::sort(pairs.begin(), pairs.end());

  Problem duplicates;
  for (const auto& [later, earlier] : pairs) {
    duplicates.add([&, later = later, earlier = earlier] {
      return fmt::format("element {} of body '{}' has the same nodes as element {} ({})", later, body, earlier,
                         fmt::join(nodes_of[later], ", "));
    });
  }
  return duplicates;
}

}  // namespace

Result<MeshReport> admit(const Mesh& mesh, std::string_view body) {
  if (auto ok = check_sizes(mesh, body); !ok) return tl::make_unexpected(ok.error());
  if (auto ok = check_points(mesh.nodes, "node", fmt::format("body '{}'", body)); !ok)
    return tl::make_unexpected(ok.error());
  if (auto ok = check_indices(mesh, body); !ok) return tl::make_unexpected(ok.error());

  MeshReport report;
  report.node_count = static_cast<std::uint32_t>(mesh.nodes.size());
  report.element_count = element_count(mesh);
  double worst_cosine = -2.0;
  std::uint64_t sliver_count = 0;
  const double sliver_cosine = std::cos(kSliverDihedralDeg * std::numbers::pi / 180.0);
  Problem repeated, flat, inverted, folded, bent, isolated;
  Components components(mesh.nodes.size());
  std::vector<bool> used(mesh.nodes.size(), false);
  const auto name = [&](std::uint32_t element, Nodes nodes) {
    return fmt::format("element {} of body '{}' (nodes {})", element, body, fmt::join(nodes, ", "));
  };

  // In parallel to the loop below: the two take about as long.
  auto searching = std::async(std::launch::async, [&] { return find_duplicates(mesh, body); });
  for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, Nodes nodes) {
    for (const std::uint32_t node : nodes) {
      used[node] = true;
      components.join(nodes[0], node);
    }
    if (repeats_a_node(nodes)) {
      repeated.add([&] { return name(element, nodes) + " repeats a node"; });
      return;
    }
    const ElementGeometry geometry = element_geometry(mesh, shape, nodes);
    if (is_flat(geometry)) {
      flat.add([&] {
        return fmt::format("{} is flat at node {}: a Jacobian of {:.3g} m³ with a longest edge of {:.3g} m",
                           name(element, nodes), nodes[geometry.min_jacobian_node], geometry.min_jacobian_m3,
                           geometry.max_edge_m);
      });
      return;
    }
    if (geometry.volume_m3 < 0.0) {
      inverted.add([&] {
        return fmt::format("{} is inverted: its volume is {:.3g} m³", name(element, nodes), geometry.volume_m3);
      });
      return;
    }
    if (geometry.min_jacobian_m3 < 0.0) {
      Problem& problem = shape.has_mid_edge_nodes() ? bent : folded;
      problem.add([&] {
        return fmt::format("{} of shape {} is folded over at node {}: the Jacobian there is {:.3g} m³",
                           name(element, nodes), shape.name, nodes[geometry.min_jacobian_node],
                           geometry.min_jacobian_m3);
      });
      return;
    }
    report.volume_m3 += geometry.volume_m3;
    const double cosine = max_dihedral_cosine(mesh, shape, nodes);
    if (cosine > sliver_cosine) ++sliver_count;
    if (cosine > worst_cosine) {
      worst_cosine = cosine;
      report.min_dihedral_element = element;
    }
  });
  for (std::uint32_t node = 0; node < mesh.nodes.size(); ++node) {
    if (used[node]) {
      report.component_count += components.is_root(node) ? 1 : 0;
    } else {
      isolated.add([&] { return fmt::format("node {} of body '{}' belongs to no element", node, body); });
    }
  }
  const Problem duplicates = searching.get();
  Conformity conformity;
  const Problem* const element_errors[] = {&repeated, &flat, &inverted, &folded, &bent, &duplicates};
  if (std::all_of(std::begin(element_errors), std::end(element_errors),
                  [](const Problem* f) { return f->count == 0; })) {
    conformity = check_conformity(mesh, body);
  }

  const std::pair<const Problem&, std::string_view> errors[] = {
      {repeated, "remove it or give it nodes of its own; `tensormass mesh FILE -o OUT` removes it"},
      {inverted,
       "put its nodes in VTK order (in a tetrahedron, exchange the last two; in a wedge, its triangles; in a pyramid "
       "or hexahedron, turn its quadrilaterals about); `tensormass mesh FILE -o OUT` does so"},
      {folded, "put its nodes in VTK order if they are in another, else remesh around it"},
      {bent, "move its mid-edge nodes to the middle of their edges, and away from their quarter points at least"},
      {flat, "remove it or remesh around it; `tensormass mesh FILE -o OUT` removes it"},
      {duplicates, "remove one of them; `tensormass mesh FILE -o OUT` does so"},
      {conformity.overlapping, "remove the elements that overlap others"},
      {conformity.nonconforming,
       "put a pyramid between a quadrilateral and triangles, and give the elements along a quadratic one the same "
       "mid-edge nodes"},
      {isolated,
       "remove it or connect it; it would have no stiffness and no mass (`tensormass mesh FILE -o OUT` removes it)"},
  };
  std::string message;
  for (const auto& [problem, what_to_do] : errors) {
    if (problem.count == 0) continue;
    if (!message.empty()) message += '\n';
    message += problem.text(what_to_do);
  }
  if (!message.empty()) return invalid(std::move(message));

  report.min_dihedral_angle_deg = std::acos(worst_cosine) * 180.0 / std::numbers::pi;
  if (sliver_count > 0) {
    report.findings.push_back(
        {.code = FindingCode::kSlivers,
         .value = report.min_dihedral_angle_deg,
         .limit = kSliverDihedralDeg,
         .place = fmt::format("body '{}'.mesh", body),
         .body = std::string(body),
         .message = fmt::format("body '{}': {} elements have a dihedral angle below {}°, the smallest {:.3g}° in "
                                "element {}",
                                body, sliver_count, kSliverDihedralDeg, report.min_dihedral_angle_deg,
                                report.min_dihedral_element),
         .remedy = "they slow the solver down, remesh for better ones"});
  }
  if (report.component_count > 1) {
    report.findings.push_back(
        {.code = FindingCode::kSeparateParts,
         .value = static_cast<double>(report.component_count),
         .limit = kind_of(FindingCode::kSeparateParts).limit,
         .place = fmt::format("body '{}'.mesh", body),
         .body = std::string(body),
         .message = fmt::format("body '{}' consists of {} parts that share no node", body, report.component_count),
         .remedy = "they move independently, and each needs its own fixed nodes to stay in place"});
  }
  return report;
}

Result<SkinReport> admit_skin(std::span<const Eigen::Vector3d> vertices, std::span<const Triangle> triangles,
                              std::string_view owner) {
  if (vertices.empty() || triangles.empty()) {
    return invalid(fmt::format("the skin of {} has {} vertices and {} triangles; give a surface or none", owner,
                               vertices.size(), triangles.size()));
  }
  if (vertices.size() > limits::kMaxNodes || triangles.size() > limits::kMaxElements) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("the skin of {} has {} vertices and {} triangles; limits::kMaxNodes is {} and "
                            "limits::kMaxElements {}; simplify it",
                            owner, vertices.size(), triangles.size(), limits::kMaxNodes, limits::kMaxElements));
  }
  if (auto ok = check_points(vertices, "skin vertex", owner); !ok) return tl::make_unexpected(ok.error());

  std::uint64_t flat_count = 0;
  Problem out_of_range, repeated;
  std::vector<bool> used(vertices.size(), false);
  for (std::size_t i = 0; i < triangles.size(); ++i) {
    const Triangle& triangle = triangles[i];
    const auto highest = *std::max_element(triangle.begin(), triangle.end());
    if (highest >= vertices.size()) {
      out_of_range.add([&] {
        return fmt::format("skin triangle {} of {} refers to vertex {}, and the skin has {} vertices", i, owner,
                           highest, vertices.size());
      });
      continue;
    }
    if (repeats_a_node(triangle)) {
      repeated.add([&] {
        return fmt::format("skin triangle {} of {} repeats a vertex ({})", i, owner, fmt::join(triangle, ", "));
      });
      continue;
    }
    for (const std::uint32_t vertex : triangle) used[vertex] = true;
    const Eigen::Vector3d& x0 = vertices[triangle[0]];
    const Eigen::Vector3d a = vertices[triangle[1]] - x0;
    const Eigen::Vector3d b = vertices[triangle[2]] - x0;
    // Compares the sine of the angle, which does not depend on the triangle's size.
    if (a.cross(b).norm() <= kMinRelativeVolume * a.norm() * b.norm()) ++flat_count;
  }
  std::string message;
  if (out_of_range.count > 0) message = out_of_range.text("count vertices from 0 and send all of them");
  if (repeated.count > 0) {
    if (!message.empty()) message += '\n';
    message += repeated.text("remove it");
  }
  if (!message.empty()) return invalid(std::move(message));

  SkinReport report{static_cast<std::uint32_t>(vertices.size()), static_cast<std::uint32_t>(triangles.size()), {}};
  if (flat_count > 0) {
    report.findings.push_back(
        {.code = FindingCode::kFlatSkinTriangles,
         .value = static_cast<double>(flat_count),
         .place = fmt::format("{}.skin", owner),
         .message = fmt::format("the skin of {} has {} triangles without area", owner, flat_count),
         .remedy = "they have no normal, so remove them"});
  }
  if (const auto unused = std::count(used.begin(), used.end(), false); unused > 0) {
    report.findings.push_back(
        {.code = FindingCode::kUnusedSkinVertices,
         .value = static_cast<double>(unused),
         .place = fmt::format("{}.skin", owner),
         .message = fmt::format("the skin of {} has {} vertices that belong to no triangle", owner, unused),
         .remedy = "remove them, unless the triangles lack some"});
  }
  return report;
}

}  // namespace tensormass::mesh
