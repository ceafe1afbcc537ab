#include "mesh/cut_surface.h"

#include <algorithm>
#include <map>
#include <tuple>
#include <unordered_map>

#include "core/assert.h"

namespace tensormass::mesh {
namespace {

/// What makes two points of copies one vertex: the same point of the mesh, and the same rows of all nodes that it may
/// weigh. Its position is then the same in all copies, whatever the deformation.
struct VertexKey {
  CutPoint::Kind kind{};
  std::uint32_t index = 0;  // mesh edge, face or part
  std::array<std::uint32_t, kMaxFaceNodes> rows{};
  bool operator==(const VertexKey&) const = default;
};

struct VertexHash {
  std::size_t operator()(const VertexKey& key) const {
    std::uint64_t hash = static_cast<std::uint64_t>(key.kind) + 4 * std::uint64_t{key.index};
    for (const std::uint32_t row : key.rows) hash = (hash ^ row) * 0x9E3779B97F4A7C15u ^ hash >> 29;
    return hash;
  }
};

class Builder {
 public:
  explicit Builder(const Cut& cut) : cut_(cut), topology_(cut.topology()) {}

  CutSurface build() {
    add_skin();
    for (std::uint32_t element = 0; element < topology_.element_count(); ++element) {
      if (cut_.first_part(element) != kNone) add_sheet(element);
    }
    divide_shared_edges();
    return std::move(surface_);
  }

 private:
  /// A copy of an element: a part, or the whole element.
  struct Copy {
    std::uint32_t element, part;
    std::span<const std::uint32_t> rows;
  };

  Copy copy_of(std::uint32_t element, std::uint8_t label) const {
    std::uint32_t part = cut_.first_part(element);
    const std::size_t count = topology_.nodes(element).size();
    if (part == kNone) return {element, kNone, topology_.nodes(element)};
    for (; label > 0; --label) part = cut_.parts()[part].next;
    return {element, part, std::span<const std::uint32_t>(cut_.parts()[part].rows).first(count)};
  }

  VertexKey key_of(const Copy& copy, CutPoint point) const {
    VertexKey key{point.kind, 0, {}};
    key.rows.fill(kNone);
    const Topology& shape = topology_.shape(copy.element);
    switch (point.kind) {
      case CutPoint::Kind::kNode:
        key.rows[0] = copy.rows[point.index];
        break;
      case CutPoint::Kind::kEdge: {
        key.index = topology_.edges(copy.element)[point.index];
        const Edge& edge = shape.edges[point.index];
        key.rows[0] = copy.rows[edge.nodes[0]];
        key.rows[1] = copy.rows[edge.nodes[1]];
        if (shape.has_mid_edge_nodes()) key.rows[2] = copy.rows[shape.corner_count + point.index];
        break;
      }
      case CutPoint::Kind::kFace: {
        key.index = topology_.face_index(copy.element, point.index);
        const Face& face = shape.faces[point.index];
        for (std::size_t i = 0; i < face.node_count; ++i) key.rows[i] = copy.rows[face.nodes[i]];
        break;
      }
      case CutPoint::Kind::kCell:
        key.index = copy.part;
        break;
    }
    std::sort(key.rows.begin(), key.rows.end());  // elements list the nodes of a face in different orders
    return key;
  }

  std::uint32_t vertex(const Copy& copy, CutPoint point) {
    const auto [entry, added] = vertices_.try_emplace(key_of(copy, point), surface_.vertex_count());
    if (added) {
      const ElementCut cut = cut_.element_cut(copy.element);
      const auto weights = point_weights(cut, label_parts(*cut.shape, cut.cut_edges), point);
      for (std::size_t k = 0; k < copy.rows.size(); ++k) {
        if (weights[k] != 0.0) add_weight(copy.rows[k], weights[k]);
      }
      surface_.offsets.push_back(static_cast<std::uint32_t>(surface_.rows.size()));
    }
    return entry->second;
  }
  void add_weight(std::uint32_t row, double weight) {
    surface_.rows.push_back(row);
    surface_.weights.push_back(weight);
  }

  void add(const Copy& copy, const std::array<CutPoint, 3>& points, bool is_cut) {
    add(Triangle{vertex(copy, points[0]), vertex(copy, points[1]), vertex(copy, points[2])}, copy.element, copy.part,
        is_cut);
  }
  void add(const Triangle& triangle, std::uint32_t element, std::uint32_t part, bool is_cut) {
    surface_.triangles.push_back(triangle);
    surface_.triangle_elements.push_back(element);
    surface_.triangle_parts.push_back(part);
    surface_.triangle_is_cut.push_back(is_cut ? 1 : 0);
  }

  /// Faces without a cut edge have the triangles of `boundary`.
  void add_skin() {
    const Surface skin = boundary(topology_.mesh());
    std::size_t next = 0;  // triangle of `skin`; those of a face follow each other, in the order of faces
    for (const BoundaryFace& face : boundary_faces(topology_.mesh())) {
      const std::size_t first = next, count = face.nodes.size();
      next += count == 3 ? 1 : count == 4 ? 2 : quadratic_face_triangles(count).size();
      const ElementCut cut = cut_.element_cut(face.element);
      const PartLabels labels = label_parts(*cut.shape, cut.cut_edges);
      const Face& local = cut.shape->faces[face.face];
      if (has_cut_edge(cut, local)) {
        std::array<CutTriangle, kMaxFaceTriangles> room;
        const std::size_t added = face_triangles(cut, labels, face.face, room);
        for (std::size_t i = 0; i < added; ++i) add(copy_of(face.element, room[i].part), room[i].points, false);
        continue;
      }
      // All corners are in one part.
      const Copy copy = copy_of(face.element, labels.part[local.nodes[0]]);
      const std::span<const std::uint32_t> nodes = topology_.nodes(face.element);
      for (std::size_t t = first; t < next; ++t) {
        std::array<CutPoint, 3> points;
        for (std::size_t i = 0; i < 3; ++i) {
          const std::uint32_t node = skin.nodes[skin.triangles[t][i]];
          points[i].index = static_cast<std::uint8_t>(std::find(nodes.begin(), nodes.end(), node) - nodes.begin());
        }
        add(copy, points, false);
      }
    }
  }

  void add_sheet(std::uint32_t element) {
    const ElementCut cut = cut_.element_cut(element);
    std::array<CutTriangle, kMaxSheetTriangles> room;
    const std::size_t count = sheet_triangles(cut, label_parts(*cut.shape, cut.cut_edges), room);
    for (std::size_t i = 0; i < count; ++i) add(copy_of(element, room[i].part), room[i].points, true);
  }

  /// Four triangles meet at an edge if a cut is closed there on all sides. Two of them that run in opposite directions,
  /// of one element if there are such, get a vertex in the edge's middle, and are divided there.
  void divide_shared_edges() {
    while (true) {
      std::map<std::pair<std::uint32_t, std::uint32_t>, std::vector<std::uint32_t>> of_edge;
      for (std::uint32_t t = 0; t < surface_.triangles.size(); ++t) {
        for (std::size_t i = 0; i < 3; ++i) {
          const auto [low, high] = std::minmax(surface_.triangles[t][i], surface_.triangles[t][(i + 1) % 3]);
          of_edge[{low, high}].push_back(t);
        }
      }
      std::vector<std::uint8_t> divided(surface_.triangles.size(), 0);
      bool any = false;
      for (const auto& [ends, triangles] : of_edge) {
        if (triangles.size() < 4) continue;
        const auto [low, high] = ends;
        for (const auto& [t, u] : opposite_pair(triangles, low, high)) {
          if (divided[t] != 0 || divided[u] != 0) {
            any = true;  // in the next round
            continue;
          }
          divided[t] = divided[u] = 1;
          any = true;
          const std::uint32_t middle = middle_vertex(low, high);
          divide(t, low, high, middle);
          divide(u, low, high, middle);
          ++surface_.divided_edges;
        }
      }
      if (!any) return;
    }
  }

  bool runs(std::uint32_t triangle, std::uint32_t from, std::uint32_t to) const {
    const Triangle& t = surface_.triangles[triangle];
    for (std::size_t i = 0; i < 3; ++i) {
      if (t[i] == from && t[(i + 1) % 3] == to) return true;
    }
    return false;
  }

  /// Returns one pair of triangles in opposite directions of an edge; none if the boundary of the mesh is to blame.
  std::vector<std::pair<std::uint32_t, std::uint32_t>> opposite_pair(const std::vector<std::uint32_t>& triangles,
                                                                     std::uint32_t low, std::uint32_t high) const {
    const auto is_cut = [&](std::uint32_t t) { return surface_.triangle_is_cut[t] != 0; };
    if (std::none_of(triangles.begin(), triangles.end(), is_cut)) return {};
    for (const bool of_one_element : {true, false}) {
      for (const std::uint32_t t : triangles) {
        for (const std::uint32_t u : triangles) {
          const bool same = surface_.triangle_elements[t] == surface_.triangle_elements[u];
          if (of_one_element && !same) continue;
          if (runs(t, low, high) && runs(u, high, low)) return {{t, u}};
        }
      }
    }
    return {};
  }

  std::uint32_t middle_vertex(std::uint32_t a, std::uint32_t b) {
    std::map<std::uint32_t, double> weights;
    for (const std::uint32_t end : {a, b}) {
      for (std::uint32_t i = surface_.offsets[end]; i < surface_.offsets[end + 1]; ++i) {
        weights[surface_.rows[i]] += 0.5 * surface_.weights[i];
      }
    }
    for (const auto& [row, weight] : weights) add_weight(row, weight);
    surface_.offsets.push_back(static_cast<std::uint32_t>(surface_.rows.size()));
    return surface_.vertex_count() - 1;
  }

  void divide(std::uint32_t triangle, std::uint32_t low, std::uint32_t high, std::uint32_t middle) {
    Triangle& first = surface_.triangles[triangle];
    Triangle second = first;
    for (std::size_t i = 0; i < 3; ++i) {
      const std::uint32_t from = first[i], to = first[(i + 1) % 3];
      if (std::min(from, to) != low || std::max(from, to) != high) continue;
      second[i] = middle;
      first[(i + 1) % 3] = middle;
      break;
    }
    add(second, surface_.triangle_elements[triangle], surface_.triangle_parts[triangle],
        surface_.triangle_is_cut[triangle] != 0);
  }

  const Cut& cut_;
  const CutTopology& topology_;
  CutSurface surface_;
  std::unordered_map<VertexKey, std::uint32_t, VertexHash> vertices_;
};

}  // namespace

bool has_cut_edge(const ElementCut& cut, const Face& face) {
  const auto end = face.nodes.begin() + face.node_count;
  const auto has = [&](std::uint8_t node) { return std::find(face.nodes.begin(), end, node) != end; };
  for (std::size_t i = 0; i < cut.shape->edges.size(); ++i) {
    const auto [a, b] = cut.shape->edges[i].nodes;
    if (cut.is_cut(i) && has(a) && has(b)) return true;
  }
  return false;
}

Eigen::Vector3d CutSurface::position(std::uint32_t vertex, std::span<const Eigen::Vector3d> row_positions_m) const {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (std::uint32_t i = offsets[vertex]; i < offsets[vertex + 1]; ++i) sum += weights[i] * row_positions_m[rows[i]];
  return sum;
}

std::vector<Eigen::Vector3d> row_positions(const Cut& cut) {
  const std::vector<Eigen::Vector3d>& nodes = cut.topology().mesh().nodes;
  std::vector<Eigen::Vector3d> positions = nodes;
  for (const VirtualNode& copy : cut.virtual_nodes()) positions.push_back(nodes[copy.node]);
  return positions;
}

CutSurface visible_surface(const Cut& cut) { return Builder(cut).build(); }

}  // namespace tensormass::mesh
