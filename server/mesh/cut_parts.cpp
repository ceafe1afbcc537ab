#include "mesh/cut_parts.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "core/assert.h"

namespace tensormass::mesh {
namespace {

using Eigen::Vector3d;
using Kind = CutPoint::Kind;
using Weights = std::array<double, kMaxElementNodes>;

CutPoint node_point(std::size_t node) { return {Kind::kNode, static_cast<std::uint8_t>(node)}; }
CutPoint edge_point(std::size_t edge) { return {Kind::kEdge, static_cast<std::uint8_t>(edge)}; }
CutPoint face_point(std::size_t face) { return {Kind::kFace, static_cast<std::uint8_t>(face)}; }
constexpr CutPoint kCentre{Kind::kCell, 0};

/// The edge on each side of each face.
using SideEdges = std::array<std::array<std::uint8_t, kMaxFaceCorners>, kMaxFaces>;

constexpr SideEdges side_edges(const Topology& shape) {
  SideEdges edges{};
  for (std::size_t f = 0; f < shape.faces.size(); ++f) {
    const Face& face = shape.faces[f];
    for (std::size_t side = 0; side < face.corner_count(); ++side) {
      const std::uint8_t a = face.nodes[side], b = face.nodes[(side + 1) % face.corner_count()];
      for (std::size_t i = 0; i < shape.edges.size(); ++i) {
        const auto& ends = shape.edges[i].nodes;
        if ((ends[0] == a && ends[1] == b) || (ends[0] == b && ends[1] == a)) {
          edges[f][side] = static_cast<std::uint8_t>(i);
        }
      }
    }
  }
  return edges;
}

constexpr std::array<SideEdges, kShapes.size()> kSideEdges = [] {
  std::array<SideEdges, kShapes.size()> all{};
  for (std::size_t i = 0; i < kShapes.size(); ++i) all[i] = side_edges(kShapes[i]);
  return all;
}();

/// Returns the local edge on a side of a local face.
std::size_t side_edge(const Topology& shape, std::size_t face, std::size_t side) {
  return kSideEdges[static_cast<std::size_t>(&shape - kShapes.data())][face][side];
}

/// Corners of the reference shapes, as in physics/element.
Vector3d reference_corner(const Topology& shape, std::size_t corner) {
  constexpr double kUnit[8][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0},
                                  {0, 0, 1}, {1, 0, 1}, {1, 1, 1}, {0, 1, 1}};
  constexpr double kTetrahedron[4][3] = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
  constexpr double kPyramid[5][3] = {{-1, -1, 0}, {1, -1, 0}, {1, 1, 0}, {-1, 1, 0}, {0, 0, 1}};
  constexpr double kWedge[6][3] = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {1, 0, 1}, {0, 1, 1}};
  const double* at = shape.corner_count == 4   ? kTetrahedron[corner]
                     : shape.corner_count == 5 ? kPyramid[corner]
                     : shape.corner_count == 6 ? kWedge[corner]
                                               : kUnit[corner];
  return {at[0], at[1], at[2]};
}

/// The points of an element's subdivision as weights on corners (reference shape) and on nodes (the element).
class Subdivision {
 public:
  Subdivision(const ElementCut& cut, const PartLabels& labels) : cut_(cut), shape_(*cut.shape), labels_(labels) {}

  /// A piece of an edge of a face, run through as the face's winding says, and the corner that has it.
  struct Piece {
    CutPoint from, to;
    std::uint8_t owner = 0;
  };
  struct Pieces {
    std::array<Piece, 3> items;
    std::size_t count = 0;
    const Piece* begin() const { return items.data(); }
    const Piece* end() const { return items.data() + count; }
  };

  /// Returns the pieces of a face's side.
  Pieces pieces(std::size_t of_face, std::size_t side) const {
    const Face& face = shape_.faces[of_face];
    const std::uint8_t a = face.nodes[side], b = face.nodes[(side + 1) % face.corner_count()];
    const std::size_t edge = side_edge(shape_, of_face, side);
    Pieces result;
    const auto add = [&](CutPoint from, CutPoint to, std::uint8_t owner) {
      result.items[result.count++] = {from, to, owner};
    };
    const CutPoint middle = node_point(shape_.corner_count + edge);
    if (!cut_.is_cut(edge)) {
      if (!shape_.has_mid_edge_nodes()) {
        add(node_point(a), node_point(b), a);
      } else {
        add(node_point(a), middle, a);
        add(middle, node_point(b), b);
      }
      return result;
    }
    const double at = cut_.crossings[edge];
    const bool with_middle = shape_.has_mid_edge_nodes() && std::abs(at - 0.5) > kMiddleWidth;
    const std::uint8_t owner = owner_of_middle(cut_, edge);
    if (with_middle && owner == a) {
      add(node_point(a), middle, a);
      add(middle, edge_point(edge), a);
    } else {
      add(node_point(a), edge_point(edge), a);
    }
    if (with_middle && owner == b) {
      add(edge_point(edge), middle, b);
      add(middle, node_point(b), b);
    } else {
      add(edge_point(edge), node_point(b), b);
    }
    return result;
  }

  /// Visits the tetrahedra that fill the element.
  ///
  ///   visit(owner corner, {C, u, v, F})   is called for each
  template <class Visitor>
  void for_each_tetrahedron(Visitor&& visit) const {
    for (std::size_t f = 0; f < shape_.faces.size(); ++f) {
      const Face& face = shape_.faces[f];
      for (std::size_t side = 0; side < face.corner_count(); ++side) {
        for (const Piece& piece : pieces(f, side)) {
          visit(piece.owner, std::array{kCentre, piece.from, piece.to, face_point(f)});
        }
      }
    }
  }

  /// Returns a point's weights: on nodes if `quadratic` and the shape has mid-edge nodes, otherwise on corners.
  Weights weights(CutPoint point, bool quadratic) const {
    Weights sum{};
    if (point.kind == Kind::kNode) {
      add_node(point.index, 1.0, quadratic, sum);
    } else if (point.kind == Kind::kEdge) {
      add_edge(point.index, 1.0, quadratic, sum);
    } else if (point.kind == Kind::kFace) {
      add_mean(edges_of_face(point.index), 2, quadratic, sum);
    } else {
      std::uint32_t between = 0;
      for (std::size_t i = 0; i < shape_.edges.size(); ++i) {
        const auto [a, b] = shape_.edges[i].nodes;
        if (labels_.part[a] != labels_.part[b]) between |= 1u << i;
      }
      add_mean(between == 0 ? (1u << shape_.edges.size()) - 1 : between, 1, quadratic, sum);
    }
    return sum;
  }

  /// Returns a point's reference coordinates.
  Vector3d reference(CutPoint point) const {
    const Weights weight = weights(point, false);
    Vector3d at = Vector3d::Zero();
    for (std::size_t k = 0; k < shape_.corner_count; ++k) at += weight[k] * reference_corner(shape_, k);
    return at;
  }

 private:
  std::uint32_t edges_of_face(std::size_t face) const {
    std::uint32_t edges = 0;
    for (std::size_t side = 0; side < shape_.faces[face].corner_count(); ++side) {
      edges |= 1u << side_edge(shape_, face, side);
    }
    return edges;
  }

  void add_node(std::size_t node, double weight, bool quadratic, Weights& sum) const {
    if (quadratic || node < shape_.corner_count) {
      sum[node] += weight;
      return;
    }
    const auto [a, b] = shape_.edges[node - shape_.corner_count].nodes;
    sum[a] += 0.5 * weight;
    sum[b] += 0.5 * weight;
  }

  /// Adds the point where an edge is cut; its middle if it is not.
  void add_edge(std::size_t edge, double weight, bool quadratic, Weights& sum) const {
    const double t = cut_.is_cut(edge) ? cut_.crossings[edge] : 0.5;
    const auto [a, b] = shape_.edges[edge].nodes;
    if (!quadratic || !shape_.has_mid_edge_nodes()) {
      sum[a] += (1.0 - t) * weight;
      sum[b] += t * weight;
      return;
    }
    sum[a] += (1.0 - t) * (1.0 - 2.0 * t) * weight;
    sum[b] += t * (2.0 * t - 1.0) * weight;
    sum[shape_.corner_count + edge] += 4.0 * t * (1.0 - t) * weight;
  }

  /// Adds the mean of where some edges are cut if at least `least` are, otherwise of their middles.
  void add_mean(std::uint32_t edges, int least, bool quadratic, Weights& sum) const {
    const std::uint32_t cut = edges & cut_.cut_edges;
    const bool of_cut = __builtin_popcount(cut) >= least;
    const std::uint32_t taken = of_cut ? cut : edges;
    const double weight = 1.0 / __builtin_popcount(taken);
    for (std::size_t i = 0; i < shape_.edges.size(); ++i) {
      if ((taken >> i & 1u) == 0) continue;
      if (of_cut) {
        add_edge(i, weight, quadratic, sum);
      } else if (quadratic && shape_.has_mid_edge_nodes()) {
        add_node(shape_.corner_count + i, weight, true, sum);
      } else {
        for (const std::uint8_t end : shape_.edges[i].nodes) sum[end] += 0.5 * weight;
      }
    }
  }

  const ElementCut& cut_;
  const Topology& shape_;
  const PartLabels& labels_;
};

constexpr std::size_t kMaxTetrahedra = 3 * kMaxFaceCorners * kMaxFaces;
constexpr std::size_t kPointCodes = kMaxElementNodes + kMaxElementEdges + kMaxFaces + 1;

std::size_t code(CutPoint point) {
  switch (point.kind) {
    case Kind::kNode:
      return point.index;
    case Kind::kEdge:
      return kMaxElementNodes + point.index;
    case Kind::kFace:
      return kMaxElementNodes + kMaxElementEdges + point.index;
    case Kind::kCell:
      break;
  }
  return kPointCodes - 1;
}

/// The tetrahedra of a subdivision with their volumes.
struct Filling {
  struct Item {
    std::uint8_t part;
    std::array<std::uint8_t, 4> points;  // codes
    double volume;                       // in the reference shape, or where the element is
  };
  std::array<Item, kMaxTetrahedra> items;
  std::size_t count = 0;
  std::array<bool, kPointCodes> known{};
  std::array<Vector3d, kPointCodes> reference;
};

/// Fills an element. positions_m: empty if volumes are those of the reference shape.
void fill(const ElementCut& cut, const PartLabels& labels, std::span<const Vector3d> positions_m, Filling& filling) {
  const Subdivision subdivision(cut, labels);
  std::array<bool, kPointCodes>& known = filling.known;
  std::array<Vector3d, kPointCodes> place;
  subdivision.for_each_tetrahedron([&](std::uint8_t owner, const std::array<CutPoint, 4>& points) {
    Filling::Item& item = filling.items[filling.count++];
    item.part = labels.part[owner];
    for (std::size_t i = 0; i < 4; ++i) {
      const std::size_t at = code(points[i]);
      item.points[i] = static_cast<std::uint8_t>(at);
      if (known[at]) continue;
      known[at] = true;
      filling.reference[at] = subdivision.reference(points[i]);
      if (positions_m.empty()) continue;
      const Weights weight = subdivision.weights(points[i], true);
      place[at].setZero();
      // Relative to a node, so that far from the origin no digits are lost.
      for (std::size_t k = 0; k < cut.shape->node_count; ++k) {
        place[at] += weight[k] * (positions_m[k] - positions_m[0]);
      }
    }
  });
  const auto measure = [&](const std::array<Vector3d, kPointCodes>& at) {
    double least = std::numeric_limits<double>::infinity();
    for (std::size_t i = 0; i < filling.count; ++i) {
      const auto& [c, u, v, f] = filling.items[i].points;
      filling.items[i].volume = six_volumes(at[c], at[u], at[v], at[f]) / 6.0;
      least = std::min(least, filling.items[i].volume);
    }
    return least;
  };
  if (positions_m.empty() || !(measure(place) > 0.0)) measure(filling.reference);
}

/// Positive functions of the nodes, for their masses.
Weights node_values(const Topology& shape, const Vector3d& at) {
  Weights values{};
  const auto corners = corner_values(shape, at);
  std::copy(corners.begin(), corners.end(), values.begin());
  for (std::size_t k = shape.corner_count; k < shape.node_count; ++k) {
    const auto [a, b] = shape.edges[k - shape.corner_count].nodes;
    values[k] = 4.0 * corners[a] * corners[b];
  }
  return values;
}

/// Integrates node_values over tetrahedra. Linear functions take the centre; others a rule of degree three, the corners
/// by 1/40 and the centres of the faces by 9/40 (Keast 1986).
class Integral {
 public:
  Integral(const Topology& shape, const Filling& filling) : shape_(shape), filling_(filling) {
    for (std::size_t at = 0; at < kPointCodes; ++at) {
      if (filling.known[at]) values_[at] = node_values(shape, filling.reference[at]);
    }
  }

  void add(const Filling::Item& item, Weights& sum) const {
    if (shape_.node_count == 4) {
      for (const std::uint8_t at : item.points) add(values_[at], 0.25 * item.volume, sum);
      return;
    }
    Vector3d all = Vector3d::Zero();
    for (const std::uint8_t at : item.points) all += filling_.reference[at];
    for (const std::uint8_t at : item.points) {
      add(values_[at], item.volume / 40.0, sum);
      add(node_values(shape_, (all - filling_.reference[at]) / 3.0), 9.0 / 40.0 * item.volume, sum);
    }
  }

 private:
  void add(const Weights& values, double weight, Weights& sum) const {
    for (std::size_t k = 0; k < shape_.node_count; ++k) sum[k] += weight * values[k];
  }

  const Topology& shape_;
  const Filling& filling_;
  std::array<Weights, kPointCodes> values_;
};

}  // namespace

std::uint8_t PartLabels::corners(std::uint8_t of_part) const {
  std::uint8_t bits = 0;
  for (std::size_t i = 0; i < kMaxElementCorners; ++i) {
    if (part[i] == of_part) bits = static_cast<std::uint8_t>(bits | 1u << i);
  }
  return bits;
}

PartLabels label_parts(const Topology& shape, std::uint32_t cut_edges) {
  std::array<std::uint8_t, kMaxElementCorners> lowest{};
  for (std::uint8_t i = 0; i < kMaxElementCorners; ++i) lowest[i] = i;
  for (bool changed = true; changed;) {
    changed = false;
    for (std::size_t i = 0; i < shape.edges.size(); ++i) {
      if ((cut_edges >> i & 1u) != 0) continue;
      const auto [a, b] = shape.edges[i].nodes;
      if (lowest[a] == lowest[b]) continue;
      lowest[a] = lowest[b] = std::min(lowest[a], lowest[b]);
      changed = true;
    }
  }
  PartLabels labels{.count = 0, .part = {}};
  labels.part.fill(0xFF);
  for (std::size_t i = 0; i < shape.corner_count; ++i) {
    labels.part[i] = lowest[i] == i ? labels.count++ : labels.part[lowest[i]];
  }
  return labels;
}

std::uint8_t owner_of_middle(const ElementCut& cut, std::size_t edge) {
  const auto [a, b] = cut.shape->edges[edge].nodes;
  if (!cut.is_cut(edge) || cut.crossings[edge] > 0.5) return a;
  return b;
}

std::array<double, kMaxElementCorners> corner_values(const Topology& shape, const Eigen::Vector3d& at) {
  std::array<double, kMaxElementCorners> n{};
  const double x = at[0], y = at[1], z = at[2], rest = 1.0 - x - y;
  if (shape.corner_count == 4) {
    n = {1.0 - x - y - z, x, y, z};
  } else if (shape.corner_count == 5) {
    const double t = 1.0 - z;
    n[4] = z;
    for (std::size_t k = 0; k < 4 && t > 0.0; ++k) {
      const Vector3d corner = reference_corner(shape, k);
      n[k] = 0.25 * (t + corner[0] * x) * (t + corner[1] * y) / t;
    }
  } else if (shape.corner_count == 6) {
    n = {rest * (1.0 - z), x * (1.0 - z), y * (1.0 - z), rest * z, x * z, y * z};
  } else {
    const std::array<double, 4> base{(1.0 - x) * (1.0 - y), x * (1.0 - y), x * y, (1.0 - x) * y};
    for (std::size_t k = 0; k < 4; ++k) {
      n[k] = base[k] * (1.0 - z);
      n[k + 4] = base[k] * z;
    }
  }
  return n;
}

std::array<PartShares, kMaxElementParts> part_shares(const ElementCut& cut, const PartLabels& labels,
                                                     std::span<const Eigen::Vector3d> positions_m) {
  const Topology& shape = *cut.shape;
  TM_ASSERT(positions_m.size() == shape.node_count, "a position for each node");
  std::array<PartShares, kMaxElementParts> parts{};
  if (labels.count == 1) {
    parts[0].volume = 1.0;
    parts[0].nodes.fill(1.0);
    return parts;
  }
  Filling filling;
  // A tetrahedron's map is affine, so shares are those of the reference shape.
  fill(cut, labels, shape.node_count == 4 ? std::span<const Vector3d>() : positions_m, filling);
  const Integral integral(shape, filling);
  PartShares sum;
  for (std::size_t i = 0; i < filling.count; ++i) {
    const Filling::Item& item = filling.items[i];
    parts[item.part].volume += item.volume;
    integral.add(item, parts[item.part].nodes);
  }
  for (std::size_t p = 0; p < labels.count; ++p) {
    sum.volume += parts[p].volume;
    for (std::size_t k = 0; k < shape.node_count; ++k) sum.nodes[k] += parts[p].nodes[k];
  }
  for (std::size_t p = 0; p < labels.count; ++p) {
    parts[p].volume /= sum.volume;
    for (std::size_t k = 0; k < shape.node_count; ++k) parts[p].nodes[k] /= sum.nodes[k];
  }
  return parts;
}

void point_shares(const ElementCut& cut, const PartLabels& labels, std::span<const Eigen::Vector3d> points,
                  std::span<std::array<double, kMaxElementParts>> shares) {
  TM_ASSERT(shares.size() == points.size(), "shares for each point");
  Filling filling;
  fill(cut, labels, {}, filling);
  for (auto& of_point : shares) of_point.fill(0.0);
  std::array<double, kMaxElementParts> volume{};
  double whole = 0.0;
  for (std::size_t i = 0; i < filling.count; ++i) {
    const Filling::Item& item = filling.items[i];
    Vector3d centre = Vector3d::Zero();
    for (const std::uint8_t at : item.points) centre += 0.25 * filling.reference[at];
    std::size_t nearest = 0;
    for (std::size_t p = 1; p < points.size(); ++p) {
      if ((points[p] - centre).squaredNorm() < (points[nearest] - centre).squaredNorm()) nearest = p;
    }
    shares[nearest][item.part] += item.volume;
    volume[item.part] += item.volume;
    whole += item.volume;
  }
  for (auto& of_point : shares) {
    double sum = 0.0;
    for (const double share : of_point) sum += share;
    if (sum > 0.0) {
      for (double& share : of_point) share /= sum;
    } else {
      for (std::size_t p = 0; p < labels.count; ++p) of_point[p] = volume[p] / whole;
    }
  }
}

std::array<double, kMaxElementNodes> point_weights(const ElementCut& cut, const PartLabels& labels, CutPoint point) {
  return Subdivision(cut, labels).weights(point, true);
}

std::size_t sheet_triangles(const ElementCut& cut, const PartLabels& labels, std::span<CutTriangle> room) {
  TM_ASSERT(room.size() >= kMaxSheetTriangles, "room for all triangles of an element");
  std::size_t count = 0;
  const Topology& shape = *cut.shape;
  for (std::size_t f = 0; f < shape.faces.size(); ++f) {
    const Face& face = shape.faces[f];
    for (std::size_t side = 0; side < face.corner_count(); ++side) {
      const std::uint8_t a = face.nodes[side], b = face.nodes[(side + 1) % face.corner_count()];
      if (labels.part[a] == labels.part[b]) continue;
      // The face runs from a to b, counter-clockwise seen from outside of the element.
      const CutPoint p = edge_point(side_edge(shape, f, side));
      room[count++] = {labels.part[a], {p, kCentre, face_point(f)}};
      room[count++] = {labels.part[b], {p, face_point(f), kCentre}};
    }
  }
  return count;
}

std::size_t face_triangles(const ElementCut& cut, const PartLabels& labels, std::size_t face,
                           std::span<CutTriangle> room) {
  TM_ASSERT(room.size() >= kMaxFaceTriangles, "room for all triangles of a face");
  std::size_t count = 0;
  const Subdivision subdivision(cut, labels);
  const Face& winding = cut.shape->faces[face];
  for (std::size_t side = 0; side < winding.corner_count(); ++side) {
    for (const Subdivision::Piece& piece : subdivision.pieces(face, side)) {
      room[count++] = {labels.part[piece.owner], {piece.from, piece.to, face_point(face)}};
    }
  }
  return count;
}

}  // namespace tensormass::mesh
