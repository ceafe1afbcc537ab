#include <algorithm>
#include <array>
#include <limits>
#include <utility>
#include <vector>

#include "core/assert.h"
#include "mesh/box_tree.h"
#include "mesh/surface.h"
#include "model/edit_tables.h"

/// Finds what the skins of bodies hang on, so that edits can tear them.
///
/// Skin and boundary are two surfaces of one body, and neither need be the finer one. So a triangle of each is compared
/// with the other by points spread over it: each point names the triangle that is nearest to it on the other side.
namespace tensormass::model {

namespace {

using mesh::kNone;
using Vector = Eigen::Vector3d;
using Pair = std::pair<std::uint32_t, std::uint32_t>;

/// Parts of an edge between the points of a triangle: 10 points, with corners and middle.
constexpr int kParts = 3;
/// Longest edges of a piece below which a vertex of a skin is on it.
constexpr double kOnBoundary = 1e-6;

/// A triangle of one of the surfaces, for BoxTree.
struct Facet {
  std::array<Vector, 3> corners;
  std::uint32_t number;

  double longest_edge_m() const {
    return std::max(
        {(corners[1] - corners[0]).norm(), (corners[2] - corners[1]).norm(), (corners[0] - corners[2]).norm()});
  }
  /// Returns the weights of the corners for a point of the triangle.
  std::array<double, 3> weights(const Vector& point) const {
    const Vector normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
    std::array<double, 3> out{};
    for (std::size_t c = 0; c < 3; ++c) {
      const Vector &from = corners[(c + 1) % 3], &to = corners[(c + 2) % 3];
      out[c] = normal.dot((to - from).cross(point - from)) / normal.squaredNorm();
    }
    return out;
  }
};

/// The nearest facet found so far.
struct Nearest {
  double squared_distance = std::numeric_limits<double>::infinity();
  const Facet* facet = nullptr;
  Vector point = Vector::Zero();

  void offer(const Facet& candidate, const Vector& from) {
    const Vector at = mesh::nearest_on_triangle(from, candidate.corners[0], candidate.corners[1], candidate.corners[2]);
    const double squared = (from - at).squaredNorm();
    if (!(squared < squared_distance)) return;
    squared_distance = squared;
    facet = &candidate;
    point = at;
  }
};

/// Calls visit(point) for points spread over a facet.
template <class Visit>
void for_each_point(const Facet& facet, const Visit& visit) {
  for (int i = 0; i <= kParts; ++i) {
    for (int j = 0; i + j <= kParts; ++j) {
      visit(Vector((i * facet.corners[0] + j * facet.corners[1] + (kParts - i - j) * facet.corners[2]) / kParts));
    }
  }
}

/// Returns lists of the second numbers of pairs, each once and ascending.
Lists<std::uint32_t> lists_of(std::size_t count, std::vector<Pair> pairs) {
  std::sort(pairs.begin(), pairs.end());
  pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
  Lists<std::uint32_t> out;
  auto pair = pairs.begin();
  for (std::uint32_t list = 0; list < count; ++list) {
    for (; pair != pairs.end() && pair->first == list; ++pair) out.items.push_back(pair->second);
    out.end_list();
  }
  return out;
}

class SkinTablesMaker {
 public:
  SkinTablesMaker(const Model& model, const EditTables& tables) : m_(model), tables_(tables) {}

  SkinTables make() {
    if (std::none_of(m_.bodies.begin(), m_.bodies.end(), [](const BodyModel& body) { return body.has_skin; }))
      return {};
    std::uint32_t triangles = 0;
    for (const BodyModel& body : m_.bodies) {
      out_.triangle_begin.push_back(triangles);
      triangles += static_cast<std::uint32_t>(body.triangles.size());
    }
    out_.triangle_begin.push_back(triangles);
    out_.neighbours.assign(triangles, {kNone, kNone, kNone});
    out_.feet.resize(m_.visible.vertex_count);
    out_.nearest_vertex.assign(m_.layout.row_count, kNone);
    find_elements_of_pieces();
    for (std::size_t b = 0; b < m_.bodies.size(); ++b) {
      if (m_.bodies[b].has_skin) read(b);
      out_.boundary.end_list();
    }
    out_.hanging = lists_of(tables_.element_count(), std::move(hanging_));
    out_.covered = lists_of(triangles, std::move(covered_));
    return std::move(out_);
  }

 private:
  void find_elements_of_pieces() {
    for (std::uint32_t face = 0; face < tables_.face_element.size(); ++face) {
      out_.piece_element.resize(tables_.pieces.begin[face + 1], tables_.face_element[face]);
    }
  }

  void read(std::size_t b) {
    const BodyModel& body = m_.bodies[b];
    const std::vector<Facet> skin = facets_of_skin(b), boundary = facets_of_boundary(b);
    const mesh::BoxTree<Facet> skin_tree(skin), boundary_tree(boundary);
    std::vector<std::uint32_t> under(body.vertex_count), around(body.vertex_count);  // piece, element of each vertex
    for (std::uint32_t vertex = 0; vertex < body.vertex_count; ++vertex) {
      const Vector x = point_at_rest(body.vertex_begin + vertex);
      const Nearest nearest = boundary_tree.nearest<Nearest>(x);
      under[vertex] = nearest.facet->number;
      around[vertex] = element_of_point(body.vertex_begin + vertex);
      if ((nearest.point - x).norm() < kOnBoundary * nearest.facet->longest_edge_m()) continue;
      out_.feet[body.vertex_begin + vertex] = {tables_.pieces.items[nearest.facet->number],
                                               nearest.facet->weights(nearest.point)};
    }
    for (const Facet& triangle : skin) {
      for_each_point(triangle,
                     [&](const Vector& x) { cover(triangle.number, boundary_tree.nearest<Nearest>(x).facet->number); });
      for (const std::uint32_t vertex : body.triangles[triangle.number - out_.triangle_begin[b]]) {
        cover(triangle.number, under[vertex]);
        hanging_.emplace_back(around[vertex], triangle.number);
      }
    }
    for (const Facet& piece : boundary) {
      for_each_point(piece, [&](const Vector& x) { cover(skin_tree.nearest<Nearest>(x).facet->number, piece.number); });
      for (std::size_t c = 0; c < 3; ++c) {
        const Facet& nearest = *skin_tree.nearest<Nearest>(piece.corners[c]).facet;
        cover(nearest.number, piece.number);
        std::size_t corner = 0;
        for (const std::size_t other : {1u, 2u}) {
          const auto distance = [&](std::size_t i) { return (nearest.corners[i] - piece.corners[c]).squaredNorm(); };
          if (distance(other) < distance(corner)) corner = other;
        }
        out_.nearest_vertex[tables_.pieces.items[piece.number][c]] =
            body.triangles[nearest.number - out_.triangle_begin[b]][corner];
      }
    }
    find_neighbours(b);
  }

  void cover(std::uint32_t triangle, std::uint32_t piece) {
    covered_.emplace_back(triangle, piece);
    hanging_.emplace_back(out_.piece_element[piece], triangle);
  }

  std::vector<Facet> facets_of_skin(std::size_t b) const {
    std::vector<Facet> out;
    for (const mesh::Triangle& triangle : m_.bodies[b].triangles) {
      Facet& facet = out.emplace_back();
      for (std::size_t c = 0; c < 3; ++c) facet.corners[c] = point_at_rest(m_.bodies[b].vertex_begin + triangle[c]);
      facet.number = out_.triangle_begin[b] + static_cast<std::uint32_t>(out.size()) - 1;
    }
    return out;
  }

  std::vector<Facet> facets_of_boundary(std::size_t b) {
    std::vector<Facet> out;
    const BodyModel& body = m_.bodies[b];
    for (std::uint32_t e = body.element_begin; e < body.element_begin + body.element_count; ++e) {
      for (const std::uint32_t face : tables_.faces[e]) {
        if (tables_.face_behind[face] != kNone) continue;
        for (std::uint32_t p = tables_.pieces.begin[face]; p < tables_.pieces.begin[face + 1]; ++p) {
          Facet& facet = out.emplace_back();
          for (std::size_t c = 0; c < 3; ++c) {
            facet.corners[c] = view::load3<double>(m_.rest.data(), tables_.pieces.items[p][c]);
          }
          facet.number = p;
          out_.boundary.items.push_back(p);
        }
      }
    }
    return out;
  }

  Vector point_at_rest(std::size_t point) const {
    Vector x = Vector::Zero();
    for (std::size_t i = 4 * point; i < 4 * point + 4; ++i) {
      x += m_.visible.weights[i] * view::load3<double>(m_.rest.data(), m_.visible.rows[i]);
    }
    return x;
  }

  /// Returns the element in which a vertex of a skin is embedded: the one that has all four of its rows.
  std::uint32_t element_of_point(std::size_t point) const {
    const auto first = m_.visible.rows.begin() + 4 * static_cast<std::ptrdiff_t>(point);
    for (const EditTables::Corner& corner : tables_.corners[*first]) {
      const std::span<const std::uint32_t> rows = tables_.rows[corner.item];
      const bool has_all = std::all_of(
          first, first + 4, [&](std::uint32_t row) { return std::find(rows.begin(), rows.end(), row) != rows.end(); });
      if (has_all) return corner.item;
    }
    TM_ASSERT(false, "a vertex of a skin is embedded in an element");
    return kNone;
  }

  void find_neighbours(std::size_t b) {
    const std::uint32_t first = out_.triangle_begin[b];
    const auto neighbours = mesh::edge_neighbours(m_.bodies[b].triangles);
    for (std::size_t t = 0; t < neighbours.size(); ++t) {
      for (std::size_t side = 0; side < 3; ++side) {
        const std::uint32_t across = neighbours[t][side];
        if (across != kNone) out_.neighbours[first + t][side] = first + across;
      }
    }
  }

  const Model& m_;
  const EditTables& tables_;
  SkinTables out_;
  std::vector<Pair> hanging_;  // element, triangle
  std::vector<Pair> covered_;  // triangle, piece
};

}  // namespace

SkinTables make_skin_tables(const Model& model, const EditTables& tables) {
  return SkinTablesMaker(model, tables).make();
}

}  // namespace tensormass::model
