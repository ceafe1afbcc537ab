#include <algorithm>
#include <array>
#include <numeric>
#include <span>
#include <vector>

#include <fmt/format.h>

#include "core/cut_limits.h"
#include "mesh/components.h"
#include "mesh/faces.h"
#include "model/compile_parts.h"
#include "model/cut_bodies.h"
#include "tensormass/v1/scene.pb.h"

/// Makes the tables of blades (view/blades.h).
namespace tensormass::model {

namespace {

/// Returns the neighbours of each tetrahedron across the face opposite to each corner. Where a cut ends, a face may
/// belong to more than two copies of elements; an element then has the first of those on the other side.
std::vector<std::uint32_t> neighbours_of(const mesh::Mesh& mesh,
                                         const std::vector<std::array<std::uint32_t, 4>>& elements) {
  const auto corner_opposite = [&](const mesh::ElementFace& face) {
    const auto& nodes = elements[face.element];
    const auto off_face = [&](std::uint32_t node) {
      return std::ranges::find(face.corners, node) == face.corners.end();
    };
    return static_cast<std::uint32_t>(std::ranges::find_if(nodes, off_face) - nodes.begin());
  };
  // Copies of one element lie on the same side of a face: their fourth corner is the same place.
  const auto opposite = [&](const mesh::ElementFace& face) -> const Eigen::Vector3d& {
    return mesh.nodes[elements[face.element][corner_opposite(face)]];
  };
  std::vector<std::uint32_t> out(4 * elements.size(), view::kNoTetrahedron);
  mesh::match_faces(mesh, [&](std::span<const mesh::ElementFace> same) {
    for (const mesh::ElementFace& face : same) {
      const auto other = std::ranges::find_if(
          same, [&](const mesh::ElementFace& one) { return &one != &face && opposite(one) != opposite(face); });
      if (other != same.end()) out[4 * std::size_t{face.element} + corner_opposite(face)] = other->element;
    }
  });
  return out;
}

/// Refuses what only shows when a cut is compiled.
Result<void> check_may_be_cut(const v1::Body& message, const ReadBody& body) {
  const auto refuse = [&](std::string_view what) {
    return invalid(fmt::format("body '{}': {} cannot be cut yet; leave it or the blade out", body.name, what));
  };
  if (message.has_skin()) return refuse("a skin");
  const bool is_pressed = std::any_of(message.loads().begin(), message.loads().end(),
                                      [](const v1::Load& load) { return !load.has_force_n(); });
  if (is_pressed) return refuse("a load on its surface");
  const bool remembers = std::any_of(body.materials.begin(), body.materials.end(),
                                     [](const Material& material) { return !material.prony.empty(); });
  if (remembers && body.quadrature == physics::Quadrature::kSelective) {
    return refuse("viscoelasticity with selective quadrature");
  }
  return {};
}

/// Returns how many edges a tool has, and how many points each of them; zero for a tool that is not a blade.
struct Edges {
  std::uint32_t count = 0, points = 0;
};
Edges edges_of(const ToolModel& tool) {
  Edges out;
  physics::with_blade(tool.kind, [&](auto tag) {
    using Kind = typename decltype(tag)::Type;
    out = {Kind::kEdges, Kind::edge_points(tool.parameters)};
  });
  return out;
}

/// Refuses a blade that cannot cut in its scene.
Result<void> check_blade(const v1::Scene& scene, const ToolModel& tool, std::uint32_t points) {
  const std::string where = fmt::format("tool '{}'", tool.name);
  if (!scene.editing().has_cutting()) {
    return fail(ErrorCode::kFailedPrecondition,
                fmt::format("{}: a blade needs a scene that can be cut; give scene.editing.cutting", where));
  }
  if (tool.fixed) return invalid(fmt::format("{}: a blade cuts where it moves, so leave fixed out", where));
  if (tool.mass_kg > 0) {
    return invalid(fmt::format("{}: a blade is where the hand is, so leave mass_kg out", where));
  }
  if (points < 2 || points > limits::kMaxBladePoints) {
    return invalid(
        fmt::format("{}.spacing_m: {} points along an edge; give a spacing that makes 2 to "
                    "limits::kMaxBladePoints = {}",
                    where, points, limits::kMaxBladePoints));
  }
  const bool has_offset = static_cast<int>(tool.kind) == physics::index_of<physics::Scissors>(physics::Tools{});
  if (has_offset && tool.parameters[3] > tool.parameters[0] / 2) {
    return invalid(
        fmt::format("{}.edge_offset_m: {} is more than half of blade_length_m, {}; its edges would hardly "
                    "open, so give less",
                    where, tool.parameters[3], tool.parameters[0]));
  }
  return {};
}

}  // namespace

Result<std::vector<std::uint32_t>> find_blades(const v1::Scene& scene, const ReadBodies& bodies,
                                               std::span<const ToolModel> tools) {
  std::vector<std::uint32_t> out;
  for (std::uint32_t t = 0; t < tools.size(); ++t) {
    const Edges edges = edges_of(tools[t]);
    if (edges.count == 0) continue;
    TM_RETURN_IF_ERROR(check_blade(scene, tools[t], edges.points));
    out.insert(out.end(), edges.count, t);
  }
  if (out.empty()) return out;
  if (out.size() > limits::kMaxBlades) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.tools: {} edges of blades exceed limits::kMaxBlades = {}; scissors have two",
                            out.size(), limits::kMaxBlades));
  }
  if (!scene.body_contacts().empty()) {
    return invalid("scene.body_contacts: a scene with a blade cannot have them yet; leave one of the two out");
  }
  std::size_t elements = 0;
  for (const ReadBody& body : bodies.bodies) {
    TM_RETURN_IF_ERROR(check_may_be_cut(scene.bodies(static_cast<int>(&body - bodies.bodies.data())), body));
    for (const mesh::ElementBlock& block : body.mesh.blocks) {
      if (block.shape == mesh::Shape::kTetrahedron || block.nodes.empty()) continue;
      return invalid(
          fmt::format("body '{}': a blade cuts linear tetrahedra only, and it has other shapes; mesh it "
                      "with tetrahedra, or take the blade out",
                      body.name));
    }
    elements += body.element_count;
  }
  if (elements > limits::kMaxBladeTetrahedra) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("scene.bodies: {} tetrahedra exceed limits::kMaxBladeTetrahedra = {} of a scene with a "
                            "blade; take a coarser mesh",
                            elements, limits::kMaxBladeTetrahedra));
  }
  return out;
}

/// Shares of an element below which a part holds a blade less, and elements of a free piece, likewise.
constexpr double kHoldingPart = 0.1, kHoldingPiece = 64;

/// Returns how much of its toughness each element has for a blade: [element] 1 is all of it.
///
/// A splinter or a small piece would take the whole force of a cut, and tear off or go along. So both hold a blade in
/// proportion to their material.
std::vector<double> holds_of(const ReadBodies& bodies, std::span<const std::array<std::uint32_t, 4>> elements) {
  std::vector<double> out(elements.size(), 1);
  if (std::all_of(bodies.bodies.begin(), bodies.bodies.end(), [](const auto& body) { return body.cut == nullptr; })) {
    return out;
  }
  mesh::Components pieces(bodies.merged.nodes.size());
  for (const auto& nodes : elements) {
    for (const std::uint32_t node : nodes) pieces.join(nodes[0], node);
  }
  std::vector<double> size(bodies.merged.nodes.size(), 0);  // [lowest node] elements
  const auto for_each_copy = [&](const auto& visit) {
    for (const ReadBody& body : bodies.bodies) {
      if (body.cut == nullptr) continue;
      for (std::uint32_t e = 0; e < body.element_count; ++e) {
        const mesh::PartShares* const shares = part_of(body, e).shares;
        visit(body, body.element_begin + e, shares == nullptr ? 1 : shares->volume);
      }
    }
  };
  for_each_copy([&](const ReadBody&, std::uint32_t e, double share) { size[pieces.root(elements[e][0])] += share; });
  for_each_copy([&](const ReadBody& body, std::uint32_t e, double share) {
    const double holding = std::min(kHoldingPiece, body.loaded_element_count / 2.0);
    out[e] = std::min(share / kHoldingPart, 1.0) * std::min(size[pieces.root(elements[e][0])] / holding, 1.0);
  });
  return out;
}

Blades make_blades(const LinkInput& in) {
  Blades out;
  out.tools = in.links.blades;
  out.first_points.push_back(0);
  for (const std::uint32_t tool : out.tools) {
    out.first_points.push_back(out.first_points.back() + edges_of(in.tools[tool]).points);
  }
  std::vector<std::array<std::uint32_t, 4>> elements;
  for_each_element(in.bodies, [&](auto, std::size_t body, std::uint32_t, std::span<const std::uint32_t> nodes, auto&) {
    elements.push_back({nodes[0], nodes[1], nodes[2], nodes[3]});
    out.toughness.push_back(in.bodies.bodies[body].fracture_toughness_j_per_m2);
  });
  const std::vector<double> holds = holds_of(in.bodies, elements);
  for (std::size_t e = 0; e < elements.size(); ++e) out.toughness[e] *= holds[e];
  out.neighbours = neighbours_of(in.bodies.merged, elements);
  std::vector<std::uint32_t> patches;
  for (const auto& nodes : elements) {
    for (const std::uint32_t node : nodes) out.rows.push_back(in.layout.row_of_node[node]);
    patches.push_back(in.layout.patch_of_row(out.rows[out.rows.size() - 4]));
  }
  out.patch_tetrahedra.assign(in.layout.patch_count + 1, 0);
  for (const std::uint32_t patch : patches) ++out.patch_tetrahedra[patch + 1];
  std::partial_sum(out.patch_tetrahedra.begin(), out.patch_tetrahedra.end(), out.patch_tetrahedra.begin());
  out.tetrahedra.resize(elements.size());
  std::vector<std::uint32_t> next(out.patch_tetrahedra.begin(), out.patch_tetrahedra.end() - 1);
  for (std::uint32_t e = 0; e < elements.size(); ++e) out.tetrahedra[next[patches[e]]++] = e;
  return out;
}

}  // namespace tensormass::model
