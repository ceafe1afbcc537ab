#include <algorithm>
#include <map>
#include <numeric>
#include <utility>

#include <fmt/format.h>

#include "mesh/admission.h"
#include "mesh/embedding.h"
#include "mesh/surface.h"
#include "model/compile_parts.h"
#include "model/cut_bodies.h"
#include "model/scene_input.h"
#include "model/texture.h"
#include "tensormass/v1/scene.pb.h"

/// Makes the surfaces of a scene: triangles that tools can touch, and what clients see.
namespace tensormass::model {

namespace {

/// Vertices that a scene has room for at least, if its bodies may be cut.
constexpr std::uint32_t kLeastRoomForCuts = 4096;

/// Returns the boundary of all bodies; of one that is cut, what no cut crosses.
mesh::Surface boundary_of(const ReadBodies& all) {
  const auto is_cut = [](const ReadBody& body) { return body.cut != nullptr; };
  if (std::none_of(all.bodies.begin(), all.bodies.end(), is_cut)) return mesh::boundary(all.merged);
  std::vector<mesh::BoundaryFace> faces;
  for (const ReadBody& body : all.bodies) {
    for (mesh::BoundaryFace face : uncut_boundary_faces(body)) {
      face.element += body.element_begin;
      for (std::uint32_t i = 0; i < face.nodes.count; ++i) face.nodes.nodes[i] += body.node_begin;
      faces.push_back(face);
    }
  }
  return mesh::surface_of(all.merged, faces);
}

}  // namespace

void add_moduli(std::span<const ReadBody> bodies, std::uint32_t element, ContactSurface& out) {
  const ReadBody& body = bodies[body_of_element(bodies, element)];
  const std::array<double, 2> moduli = contact_moduli(body.material(element - body.element_begin));
  out.triangle_moduli.insert(out.triangle_moduli.end(), moduli.begin(), moduli.end());
  out.triangle_elements.push_back(element);
}

ContactSurface make_contact_surface(const ReadBodies& bodies, const matrix::Layout& layout) {
  const mesh::Surface surface = boundary_of(bodies);
  ContactSurface out;
  const auto row_of = [&](std::uint32_t vertex) { return layout.row_of_node[surface.nodes[vertex]]; };

  // Sorts surface vertices by row, which groups them by patch.
  std::vector<std::uint32_t> vertices(surface.nodes.size()), place(surface.nodes.size());
  std::iota(vertices.begin(), vertices.end(), 0);
  std::sort(vertices.begin(), vertices.end(), [&](std::uint32_t a, std::uint32_t b) { return row_of(a) < row_of(b); });
  for (std::uint32_t i = 0; i < vertices.size(); ++i) place[vertices[i]] = i;
  // Sorts triangles by the row of their first corner: its patch owns them.
  std::vector<std::uint32_t> triangles(surface.triangles.size()), triangle_place(surface.triangles.size());
  std::iota(triangles.begin(), triangles.end(), 0);
  std::stable_sort(triangles.begin(), triangles.end(), [&](std::uint32_t a, std::uint32_t b) {
    return row_of(surface.triangles[a][0]) < row_of(surface.triangles[b][0]);
  });
  for (std::uint32_t i = 0; i < triangles.size(); ++i) triangle_place[triangles[i]] = i;

  out.patch_triangles.assign(layout.patch_count + 1, 0);
  for (const std::uint32_t triangle : triangles) {
    const mesh::Triangle& corners = surface.triangles[triangle];
    Vec3<double> x[3];
    for (std::size_t i = 0; i < 3; ++i) {
      out.triangle_rows.push_back(row_of(corners[i]));
      out.vertex_of_corner.push_back(place[corners[i]]);
      const std::uint32_t neighbour = surface.neighbours[triangle][i];
      out.triangle_neighbours.push_back(neighbour == mesh::kNone ? view::kNoTriangle : triangle_place[neighbour]);
      x[i] = bodies.merged.nodes[surface.nodes[corners[i]]];
    }
    out.triangle_area.push_back(0.5 * (x[1] - x[0]).cross(x[2] - x[0]).norm());
    add_moduli(bodies.bodies, surface.triangle_elements[triangle], out);
    ++out.patch_triangles[layout.patch_of_row(row_of(corners[0])) + 1];
  }
  std::partial_sum(out.patch_triangles.begin(), out.patch_triangles.end(), out.patch_triangles.begin());

  out.patch_surface.assign(layout.patch_count + 1, 0);
  out.incidence_begin.assign(1, 0);
  for (const std::uint32_t vertex : vertices) {
    const std::uint32_t row = row_of(vertex);
    out.surface_rows.push_back(row);
    ++out.patch_surface[layout.patch_of_row(row) + 1];
    for (const std::uint32_t triangle : surface.vertex_triangles[vertex]) {
      const mesh::Triangle& corners = surface.triangles[triangle];
      const auto corner =
          static_cast<std::uint32_t>(std::find(corners.begin(), corners.end(), vertex) - corners.begin());
      out.incidence.push_back(triangle_place[triangle]);
      out.incidence.push_back(corner);
      out.incidence.push_back(layout.slot(row, row_of(corners[(corner + 1) % 3])));
      out.incidence.push_back(layout.slot(row, row_of(corners[(corner + 2) % 3])));
    }
    out.incidence_begin.push_back(static_cast<std::uint32_t>(out.incidence.size() / 4));
  }
  std::partial_sum(out.patch_surface.begin(), out.patch_surface.end(), out.patch_surface.begin());
  carry_triangles(bodies, layout, out);
  return out;
}

Result<VisibleBodies> make_visible_surface(const v1::Scene& scene, const ReadBodies& bodies, BodyBoundaries& boundaries,
                                           const matrix::Layout& layout) {
  VisibleBodies out;
  VisibleSurface& visible = out.surface;
  for (std::size_t b = 0; b < bodies.bodies.size(); ++b) {
    const ReadBody& read = bodies.bodies[b];
    const v1::Body& source = scene.bodies(static_cast<int>(b));
    VisibleBody& body = out.bodies.emplace_back();
    body.vertex_begin = visible.count();
    const std::string where = fmt::format("body '{}'", read.name);
    const auto add = [&](const std::array<std::uint32_t, 4>& nodes, const std::array<double, 4>& weights) {
      for (std::size_t i = 0; i < 4; ++i) {
        visible.rows.push_back(layout.row_of_node[read.node_begin + nodes[i]]);
        visible.weights.push_back(weights[i]);
      }
    };
    if (source.has_skin()) {
      if (read.cut != nullptr) return invalid(fmt::format("{}: a body with a skin cannot be cut yet", where));
      TM_ASSIGN_OR_RETURN(skin, read_skin(source, where));
      TM_ASSIGN_OR_RETURN(report, mesh::admit_skin(skin.vertices, skin.triangles, where));
      for (Finding& finding : report.findings) {
        finding.body = read.name;
        out.findings.push_back(std::move(finding));
      }
      TM_ASSIGN_OR_RETURN(embedding, mesh::embed(read.mesh, skin.vertices, fmt::format("the skin of {}", where)));
      for (std::size_t i = 0; i < skin.vertices.size(); ++i) add(embedding.nodes[i], embedding.weights[i]);
      body.triangles = std::move(skin.triangles);
      body.has_skin = true;
    } else {
      // That of the mesh as loaded: what cuts change of it is appended (append_cut_vertices).
      const mesh::Surface& surface = read.cut == nullptr ? boundaries.of(b) : read.cut->whole().surface;
      for (const std::uint32_t node : surface.nodes) add({node, node, node, node}, {1, 0, 0, 0});
      body.triangles = surface.triangles;
      body.vertex_nodes = surface.nodes;
    }
    body.vertex_count = visible.count() - body.vertex_begin;
    TM_ASSIGN_OR_RETURN(texture, read_texture(source, body.triangles.size(), where));
    body.texture = std::move(texture);
  }
  visible.vertex_count = visible.count();
  return out;
}

Result<void> append_cut_vertices(const v1::Scene& scene, const ReadBodies& bodies, const matrix::Layout& layout,
                                 VisibleSurface& visible) {
  SceneCuts cuts;
  std::size_t triangles = 0;
  for (const ReadBody& body : bodies.bodies) {
    cuts.push_back(body.cut);
    if (body.cut != nullptr) triangles += body.cut->changes().appended_triangles().size();
  }
  const std::vector<std::vector<std::uint32_t>> places = places_of_appended(cuts);
  std::uint32_t appended = 0;
  for (const std::vector<std::uint32_t>& of_body : places) appended += static_cast<std::uint32_t>(of_body.size());
  const v1::Editing& editing = scene.editing();
  const std::uint32_t usual = visible.vertex_count + kLeastRoomForCuts;
  const std::uint32_t room = !editing.has_cutting()           ? appended
                             : editing.has_max_new_vertices() ? editing.max_new_vertices()
                                                              : usual;
  const std::size_t most = editing.has_max_new_triangles() ? editing.max_new_triangles() : 2 * std::size_t{usual};
  if (appended > room || triangles > most) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("the surface would have {} new vertices and {} new triangles, and scene.editing has room "
                            "for {} and {}; raise max_new_vertices or max_new_triangles, or reset the scene",
                            appended, triangles, room, most));
  }
  const std::size_t first = 4 * std::size_t{visible.point_count()};
  visible.rows.resize(first + 4 * std::size_t{room}, 0);
  visible.weights.resize(visible.rows.size(), 0);
  visible.room = room;
  visible.appended_count = appended;
  for (std::size_t b = 0; b < cuts.size(); ++b) {
    for (std::size_t v = 0; v < places[b].size(); ++v) {
      const mesh::CutChanges::Vertex& vertex = cuts[b]->changes().appended_vertices()[v];
      const std::size_t at = first + 4 * std::size_t{places[b][v]};
      if (vertex.size() > 4) {
        return invalid(
            fmt::format("body '{}': hexahedra that are cut cannot be shown yet; leave "
                        "streams.frame_rate_hz out",
                        bodies.bodies[b].name));
      }
      for (std::size_t i = 0; i < 4; ++i) {
        const auto& [node, weight] = vertex[std::min(i, vertex.size() - 1)];
        visible.rows[at + i] = layout.row_of_node[bodies.bodies[b].node_begin + node];
        visible.weights[at + i] = i < vertex.size() ? weight : 0;
      }
    }
  }
  return {};
}

VisibleSprings make_visible_springs(std::span<const ReadAttachment> attachments, const matrix::Layout& layout) {
  VisibleSprings all;
  std::map<std::uint32_t, std::uint32_t> points;  // by node of the scene
  const auto point_of = [&](std::uint32_t node) {
    const auto [point, is_new] = points.emplace(node, static_cast<std::uint32_t>(points.size()));
    if (is_new) {
      all.rows.insert(all.rows.end(), 4, layout.row_of_node[node]);
      all.weights.insert(all.weights.end(), {1, 0, 0, 0});
    }
    return point->second;
  };
  for (const ReadAttachment& attachment : attachments) {
    VisibleAttachment out{attachment.name, {}, {}, attachment.stiffness_n_per_m, attachment.breaking_force_n};
    for (const auto& [node, other] : attachment.springs) {
      const std::uint32_t first = point_of(node), second = point_of(other);
      out.springs.push_back({first, second});
    }
    out.rest_lengths_m.assign(attachment.rest_lengths_m.begin(), attachment.rest_lengths_m.end());
    all.attachments.push_back(std::move(out));
  }
  return all;
}

}  // namespace tensormass::model
