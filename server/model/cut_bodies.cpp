#include "model/cut_bodies.h"

#include <algorithm>
#include <array>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/cut_limits.h"
#include "mesh/components.h"
#include "mesh/cut_surface.h"
#include "mesh/geometry.h"
#include "mesh/shapes.h"
#include "model/crumbs.h"
#include "physics/element/quadrature.h"

namespace tensormass::model {

namespace {

using mesh::kNone;

/// Most parts and virtual nodes that the cuts of a body make: for each element and node of its mesh, and so many more.
/// Memory beyond what is used is only addresses.
constexpr std::uint32_t kPartsOfElement = 2, kRowsOfNode = 4, kMoreCopies = 4096;

/// Whether the physics knows parts of a shape. Weights of parts of the others are not measured yet.
bool has_parts(mesh::Shape shape) { return shape == mesh::Shape::kTetrahedron || shape == mesh::Shape::kHexahedron; }

/// Numbers the parts of split elements as elements of the body: see the top of cut_bodies.h.
void number_parts(const BodyCut& cut, ReadBody& body) {
  const std::span<const mesh::CutPart> parts = cut.cut().parts();
  std::uint32_t next = cut.topology().element_count();
  for (std::uint32_t p = 0; p < parts.size(); ++p) {
    const bool is_first = cut.cut().first_part(parts[p].element) == p;
    body.part_elements.push_back(is_first ? parts[p].element : next++);
    if (!is_first) body.copy_parts.push_back(p);
  }
}

std::span<const std::uint32_t> rows_of(const BodyCut& cut, std::uint32_t part) {
  const mesh::CutPart& of = cut.cut().parts()[part];
  return std::span(of.rows).first(cut.topology().nodes(of.element).size());
}

mesh::Shape shape_of(const mesh::Topology& topology) {
  return &topology == &mesh::topology(mesh::Shape::kTetrahedron) ? mesh::Shape::kTetrahedron : mesh::Shape::kHexahedron;
}

/// Returns the mesh with rows of parts as nodes of elements.
/// copies: ReadBody::copy_parts
mesh::Mesh mesh_of(const BodyCut& cut, std::span<const std::uint32_t> copies) {
  const mesh::Mesh& loaded = cut.whole().mesh;
  mesh::Mesh out = loaded;
  for (const mesh::VirtualNode& node : cut.cut().virtual_nodes()) out.nodes.push_back(loaded.nodes[node.node]);
  std::uint32_t element = 0;
  for (mesh::ElementBlock& block : out.blocks) {
    const std::size_t width = mesh::topology(block.shape).node_count;
    for (auto nodes = block.nodes.begin(); nodes != block.nodes.end(); nodes += std::ptrdiff_t(width), ++element) {
      const std::uint32_t part = cut.cut().first_part(element);
      if (part != kNone) std::ranges::copy(rows_of(cut, part), nodes);
    }
  }
  for (const std::uint32_t part : copies) {
    const mesh::Shape shape = shape_of(cut.topology().shape(cut.cut().parts()[part].element));
    const bool starts = out.blocks.size() == loaded.blocks.size() || out.blocks.back().shape != shape;
    if (starts) out.blocks.push_back({shape, {}});
    std::ranges::copy(rows_of(cut, part), std::back_inserter(out.blocks.back().nodes));
  }
  return out;
}

/// Puts the copies that cuts make into a body. Leaves its ranges open.
Result<void> cut_apart(ReadBody& body, std::shared_ptr<const BodyCut> cut) {
  if (!body.middle_of.empty()) {
    return invalid(fmt::format("body '{}': a mesh that element_order made quadratic cannot be cut yet", body.name));
  }
  number_parts(*cut, body);
  const std::span<const mesh::CutPart> parts = cut->cut().parts();
  for (const mesh::VirtualNode& node : cut->cut().virtual_nodes()) body.node_copies.push_back({node.node, node.parent});
  for (const std::uint32_t part : body.copy_parts) {
    const mesh::CutPart& of = parts[part];
    const std::uint32_t parent = of.parent == kNone ? of.element : body.part_elements[of.parent];
    body.element_copies.push_back({of.element, parent});
    if (!body.element_materials.empty()) body.element_materials.push_back(body.element_materials[of.element]);
  }
  body.mesh = mesh_of(*cut, body.copy_parts);
  body.node_count = static_cast<std::uint32_t>(body.mesh.nodes.size());
  body.element_count += static_cast<std::uint32_t>(body.copy_parts.size());
  body.cut = std::move(cut);
  return {};
}

std::vector<mesh::CutPiece> pieces_of(mesh::Cut& cut) {
  std::vector<mesh::CutPiece> out(cut.pieces({}));
  cut.pieces(out);
  return out;
}

}  // namespace

BodyCut::Whole::Whole(mesh::Mesh of_mesh, std::vector<ElementRing> of_rings)
    : mesh(std::move(of_mesh)), rings(std::move(of_rings)) {
  mesh::for_each_element(mesh, [&](std::uint32_t, const mesh::Topology& shape, std::span<const std::uint32_t> nodes) {
    volumes_m3.push_back(mesh::element_geometry(mesh, shape, nodes).volume_m3);
  });
}

BodyCut::BodyCut(std::shared_ptr<const Whole> whole, mesh::CutChanges changes)
    : whole_(std::move(whole)),
      cut_(topology(), {.parts = kPartsOfElement * topology().element_count() + kMoreCopies,
                        .rows = kRowsOfNode * topology().node_count() + kMoreCopies}),
      changes_(std::move(changes)) {}

Result<std::unique_ptr<BodyCut>> BodyCut::make(const ReadBody& body) {
  TM_ASSERT(body.cut == nullptr, "cuts are made in the mesh as loaded");
  for (const mesh::ElementBlock& block : body.mesh.blocks) {
    if (has_parts(block.shape)) continue;
    return invalid(fmt::format("body '{}': elements of shape {} cannot be cut yet; tetrahedra and hexahedra can",
                               body.name, mesh::topology(block.shape).name));
  }
  auto whole = std::make_shared<const Whole>(body.mesh, ring_tetrahedra(body));
  mesh::CutChanges none(whole->surface);
  std::unique_ptr<BodyCut> out(new BodyCut(std::move(whole), std::move(none)));
  out->pieces_ = out->whole_pieces_ = pieces_of(out->cut_);
  return out;
}

std::unique_ptr<BodyCut> BodyCut::copy() const {
  std::unique_ptr<BodyCut> out(new BodyCut(whole_, changes_));
  out->cut_again(batches_);
  out->batches_ = batches_;
  out->shares_ = shares_;
  out->surface_ = surface_;
  out->pieces_ = pieces_;
  out->whole_pieces_ = whole_pieces_;
  out->area_m2_ = area_m2_;
  return out;
}

/// Makes cuts in a body that is whole.
void BodyCut::cut_again(const std::vector<CutBatch>& batches) {
  for (const CutBatch& batch : batches) {
    const bool refused = cut_.cut(batch.edges).refused;
    TM_ASSERT(!refused, "the same edges were cut before");
  }
}

std::vector<mesh::CutEdge> BodyCut::without_crumbs(std::vector<mesh::CutEdge> edges) {
  const auto again = [&] {
    cut_.reset();
    cut_again(batches_);
  };
  // Crumbs may hang on each other. Each round leaves edges out, so it ends.
  while (!cut_.cut(edges).refused) {
    const std::vector<std::size_t> whole = edges_that_crumbs_keep(cut_, whole_->volumes_m3, edges);
    again();
    if (whole.empty()) break;
    for (auto edge = whole.rbegin(); edge != whole.rend(); ++edge) edges.erase(edges.begin() + std::ptrdiff_t(*edge));
  }
  return edges;
}

Result<void> BodyCut::make_cut(std::uint32_t order, std::vector<mesh::CutEdge> edges) {
  TM_ASSERT(batches_.empty() || order > batches_.back().order, "cuts are in the order in which they were made");
  if (batches_.size() == limits::kMaxCutsOfBody) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{} cuts, limits::kMaxCutsOfBody, were made already; reset the scene", batches_.size()));
  }
  if (cut_.cut(edges).refused) {
    return fail(ErrorCode::kResourceExhausted,
                "the mesh is cut into more parts than it has room for; cut less finely, or reset the scene");
  }
  surface_ = std::make_shared<const mesh::CutSurface>(mesh::visible_surface(cut_));
  const mesh::CutSurface& surface = *surface_;
  changes_.take(surface);
  pieces_ = pieces_of(cut_);
  shares_ = shares_in_physics(cut_);
  area_m2_ = 0;
  const std::vector<Eigen::Vector3d> rows = mesh::row_positions(cut_);
  for (std::size_t t = 0; t < surface.triangles.size(); ++t) {
    if (surface.triangle_is_cut[t] == 0) continue;
    const auto corner = [&](std::size_t i) { return surface.position(surface.triangles[t][i], rows); };
    area_m2_ += (corner(1) - corner(0)).cross(corner(2) - corner(0)).norm() / 4;  // each face is there on both sides
  }
  batches_.push_back({order, std::move(edges), static_cast<std::uint32_t>(changes_.appended_vertices().size())});
  return {};
}

std::vector<std::vector<std::uint32_t>> places_of_appended(const SceneCuts& cuts) {
  struct Part {
    std::uint32_t order, begin, end;
    std::size_t body;
  };
  std::vector<Part> parts;
  for (std::size_t b = 0; b < cuts.size(); ++b) {
    std::uint32_t begin = 0;
    for (std::size_t i = 0; cuts[b] != nullptr && i < cuts[b]->batches().size(); ++i) {
      const CutBatch& batch = cuts[b]->batches()[i];
      parts.push_back({batch.order, begin, batch.appended_vertices, b});
      begin = batch.appended_vertices;
    }
  }
  std::sort(parts.begin(), parts.end(), [](const Part& a, const Part& b) { return a.order < b.order; });
  std::vector<std::vector<std::uint32_t>> out(cuts.size());
  std::uint32_t next = 0;
  for (const Part& part : parts) {
    for (std::uint32_t v = part.begin; v < part.end; ++v) out[part.body].push_back(next++);
  }
  return out;
}

Result<ReadBodies> cut_apart(ReadBodies whole, const SceneCuts& cuts) {
  if (std::all_of(cuts.begin(), cuts.end(), [](const auto& cut) { return cut == nullptr; })) return whole;
  TM_ASSERT(cuts.size() == whole.bodies.size(), "each body has its cuts, or nullptr");
  ReadBodies out;
  out.findings = std::move(whole.findings);
  for (std::size_t b = 0; b < cuts.size(); ++b) {
    ReadBody& body = out.bodies.emplace_back(std::move(whole.bodies[b]));
    if (cuts[b] != nullptr) TM_RETURN_IF_ERROR(cut_apart(body, cuts[b]));
    append_mesh(b, body, out);
  }
  return out;
}

ElementPart part_of(const ReadBody& body, std::uint32_t element) {
  if (body.cut == nullptr) return {element, kNone};
  const bool is_copy = element >= body.loaded_element_count;
  const std::uint32_t loaded = is_copy ? body.element_copies[element - body.loaded_element_count].loaded : element;
  const std::uint32_t part =
      is_copy ? body.copy_parts[element - body.loaded_element_count] : body.cut->cut().first_part(element);
  return {loaded, part, part == kNone ? nullptr : &body.cut->shares()[part]};
}

bool carries_triangles(const mesh::Topology& shape) { return &shape == &mesh::topology(mesh::Shape::kTetrahedron); }

std::vector<mesh::BoundaryFace> uncut_boundary_faces(const ReadBody& body) {
  if (body.cut == nullptr) return mesh::boundary_faces(body.mesh);
  const BodyCut& cut = *body.cut;
  std::vector<mesh::BoundaryFace> out;
  for (const mesh::BoundaryFace& face : cut.whole().faces) {
    const mesh::Topology& shape = cut.topology().shape(face.element);
    const mesh::Face& local = shape.faces[face.face];
    if (carries_triangles(shape) && mesh::has_cut_edge(cut.cut().element_cut(face.element), local)) continue;
    if (cut.cut().first_part(face.element) == kNone) {
      out.push_back(face);
      continue;
    }
    const std::uint32_t part = cut.cut().part_of(face.element, local.nodes[0]);
    const std::uint8_t corners = cut.cut().parts()[part].corners;
    const bool is_uncut = std::all_of(local.nodes.begin(), local.nodes.begin() + std::ptrdiff_t(local.corner_count()),
                                      [&](std::uint8_t corner) { return (corners >> corner & 1) != 0; });
    if (!is_uncut) continue;
    out.push_back({body.part_elements[part], face.face, mesh::face_nodes(local, rows_of(cut, part))});
  }
  std::sort(out.begin(), out.end(), [](const mesh::BoundaryFace& a, const mesh::BoundaryFace& b) {
    return std::pair(a.element, a.face) < std::pair(b.element, b.face);
  });
  return out;
}

std::vector<ElementRing> rings_of_cut(const ReadBody& body) {
  const BodyCut& cut = *body.cut;
  const auto nodes_of = mesh::element_nodes(body.mesh);
  std::vector<ElementRing> out;
  for (const ElementRing& ring : cut.whole().rings) {
    const auto is_whole = [&](std::uint32_t element) { return cut.cut().first_part(element) == kNone; };
    if (std::all_of(ring.begin(), ring.end(), is_whole)) {
      out.push_back(ring);
      continue;
    }
    std::vector<std::uint32_t> copies;
    for (const std::uint32_t element : ring) {
      std::uint32_t part = cut.cut().first_part(element);
      if (part == kNone) copies.push_back(element);
      for (; part != kNone; part = cut.cut().parts()[part].next) copies.push_back(body.part_elements[part]);
    }
    const auto shares_face = [&](std::uint32_t a, std::uint32_t b) {
      const auto has = [&](std::uint32_t node) { return std::ranges::find(nodes_of[b], node) != nodes_of[b].end(); };
      constexpr std::ptrdiff_t kFaceCorners = 3;
      return std::ranges::count_if(nodes_of[a], has) == kFaceCorners;
    };
    mesh::Components components(copies.size());
    for (std::uint32_t i = 0; i < copies.size(); ++i) {
      for (std::uint32_t j = i + 1; j < copies.size(); ++j) {
        if (shares_face(copies[i], copies[j])) components.join(i, j);
      }
    }
    for (std::uint32_t root = 0; root < copies.size(); ++root) {
      if (!components.is_root(root)) continue;
      ElementRing left;
      std::vector<std::uint32_t> nodes;
      for (std::uint32_t i = root; i < copies.size(); ++i) {
        if (components.root(i) != root) continue;
        left.push_back(copies[i]);
        nodes.insert(nodes.end(), nodes_of[copies[i]].begin(), nodes_of[copies[i]].end());
      }
      std::sort(nodes.begin(), nodes.end());
      nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
      if (left.size() < 2 || left.size() > kMaxClusterElements || nodes.size() > kClusterNodes) continue;
      std::sort(left.begin(), left.end());
      out.push_back(std::move(left));
    }
  }
  std::sort(out.begin(), out.end());
  return out;
}

std::vector<double> point_shares_of(const ReadBody& body, const ElementPart& part, std::span<const double> weights,
                                    const physics::QuadratureRule& rule) {
  if (part.shares == nullptr) return {};
  std::vector<double> out(weights.size(), part.shares->volume);
  if (rule.size() == 1 || weights.size() < rule.size()) return out;
  const mesh::Cut& cut = body.cut->cut();
  std::vector<Eigen::Vector3d> points;
  for (const physics::QuadraturePoint& point : rule) points.push_back(point.at);
  std::vector<std::array<double, mesh::kMaxElementParts>> shares(points.size());
  const mesh::PartLabels labels = cut.labels(part.loaded);
  mesh::point_shares(cut.element_cut(part.loaded), labels, points, shares);
  std::size_t label = 0;
  while (labels.corners(static_cast<std::uint8_t>(label)) != cut.parts()[part.part].corners) ++label;
  double sum = 0, kept = 0;
  for (std::size_t q = 0; q < rule.size(); ++q) {
    raise_to_least(std::span(shares[q]).first(labels.count));
    out[q] = shares[q][label];
    sum += weights[q];
    kept += weights[q] * out[q];
  }
  // A further point has the mean gradients of the others.
  for (std::size_t q = rule.size(); q < out.size(); ++q) out[q] = kept / sum;
  return out;
}

}  // namespace tensormass::model
