#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <map>
#include <numeric>
#include <set>
#include <utility>
#include <vector>

#include <Eigen/Dense>

#include "mesh/shapes.h"

/// References for cuts, by other means than server/mesh: brute force over sets, maps and permutations.
namespace tensormass::mesh::testing {

/// A forest of sets.
class Sets {
 public:
  explicit Sets(std::size_t count) : parent_(count) { std::iota(parent_.begin(), parent_.end(), std::size_t{0}); }
  std::size_t find(std::size_t i) const {
    while (parent_[i] != i) i = parent_[i];
    return i;
  }
  void unite(std::size_t a, std::size_t b) {
    a = find(a);
    b = find(b);
    parent_[std::max(a, b)] = std::min(a, b);
  }

 private:
  std::vector<std::size_t> parent_;
};

/// Returns for each corner the lowest corner that hangs together with it by uncut edges.
inline std::vector<std::size_t> reference_labels(const Topology& shape, std::uint32_t cut_edges) {
  Sets sets(shape.corner_count);
  for (std::size_t i = 0; i < shape.edges.size(); ++i) {
    if ((cut_edges >> i & 1u) == 0) sets.unite(shape.edges[i].nodes[0], shape.edges[i].nodes[1]);
  }
  std::vector<std::size_t> lowest;
  for (std::size_t corner = 0; corner < shape.corner_count; ++corner) lowest.push_back(sets.find(corner));
  return lowest;
}

/// Volume [part of the whole] and moments ∫ N_k [part of the whole] of the space around each corner of a tetrahedron,
/// in barycentric coordinates: over all orders of a node, an edge, a face and the cell.
struct ReferenceTetrahedron {
  std::array<double, 4> volume{};
  std::array<Eigen::Vector4d, 4> moment;

  ReferenceTetrahedron(std::uint32_t cut_edges, const std::array<double, 6>& crossings) {
    const Topology& shape = topology(Shape::kTetrahedron);
    const std::vector<std::size_t> lowest = reference_labels(shape, cut_edges);
    std::map<std::set<int>, std::size_t> edge_of;
    std::map<std::set<int>, Eigen::Vector4d> at;
    std::set<std::size_t> between;
    for (std::size_t i = 0; i < 6; ++i) {
      const auto [a, b] = shape.edges[i].nodes;
      const bool cut = (cut_edges >> i & 1u) != 0;
      Eigen::Vector4d p = Eigen::Vector4d::Zero();
      p[a] = cut ? 1.0 - crossings[i] : 0.5;
      p[b] = cut ? crossings[i] : 0.5;
      at[{a, b}] = p;
      edge_of[{a, b}] = i;
      if (lowest[a] != lowest[b]) between.insert(i);
    }
    const auto mean = [&](const std::vector<std::set<int>>& edges, auto&& chosen, std::size_t least) {
      Eigen::Vector4d some = Eigen::Vector4d::Zero(), all = Eigen::Vector4d::Zero();
      std::size_t count = 0;
      for (const std::set<int>& edge : edges) {
        all += at[edge] / static_cast<double>(edges.size());
        if (!chosen(edge_of[edge])) continue;
        some += at[edge];
        ++count;
      }
      return Eigen::Vector4d(count >= least ? Eigen::Vector4d(some / static_cast<double>(count)) : all);
    };
    std::vector<std::set<int>> every;
    for (const auto& [edge, index] : edge_of) every.push_back(edge);
    const Eigen::Vector4d centre = mean(
        every, [&](std::size_t i) { return between.count(i) > 0; }, 1);
    for (Eigen::Vector4d& m : moment) m.setZero();
    std::array<int, 4> order{0, 1, 2, 3};
    do {
      const auto [a, b, c, rest] = order;
      const Eigen::Vector4d face = mean(
          {{a, b}, {a, c}, {b, c}}, [&](std::size_t i) { return (cut_edges >> i & 1u) != 0; }, 2);
      Eigen::Matrix4d q;
      q << Eigen::Vector4d::Unit(a), at[{a, b}], face, centre;
      const double v = std::abs(q.determinant());
      const auto corner = static_cast<std::size_t>(a);
      volume[corner] += v;
      moment[corner] += v * q.rowwise().mean();
    } while (std::next_permutation(order.begin(), order.end()));
  }
};

/// Which copies of nodes are one, over a whole mesh at once. A copy is an element and the lowest corner of a part.
class ReferenceClasses {
 public:
  ///   is_cut(low node, high node)   returns whether the edge between two nodes is cut; called once for each element
  template <class IsCut>
  ReferenceClasses(const Mesh& mesh, IsCut&& is_cut) {
    struct Side {
      std::uint32_t element;
      const Topology* shape;
      std::vector<std::uint32_t> nodes;
    };
    std::map<std::set<std::uint32_t>, std::vector<std::pair<std::uint32_t, std::vector<std::uint32_t>>>> faces;
    std::vector<Side> sides;
    for_each_element(mesh, [&](std::uint32_t element, const Topology& shape, std::span<const std::uint32_t> nodes) {
      std::uint32_t bits = 0;
      for (std::size_t i = 0; i < shape.edges.size(); ++i) {
        const auto [low, high] = ends_of(shape.edges[i], nodes);
        if (is_cut(low, high)) bits |= 1u << i;
      }
      labels_.push_back(reference_labels(shape, bits));
      sides.push_back({element, &shape, {nodes.begin(), nodes.end()}});
      for (const Face& face : shape.faces) {
        std::set<std::uint32_t> corners;
        std::vector<std::uint32_t> all;
        for (std::size_t i = 0; i < face.corner_count(); ++i) corners.insert(nodes[face.nodes[i]]);
        for (std::size_t i = 0; i < face.node_count; ++i) all.push_back(nodes[face.nodes[i]]);
        faces[corners].push_back({element, all});
      }
    });
    const auto add = [&](std::uint32_t element, std::size_t corner, std::uint32_t node) {
      return index_.try_emplace({element, labels_[element][corner], node}, index_.size()).first->second;
    };
    for (const Side& side : sides) {
      for (std::size_t corner = 0; corner < side.shape->corner_count; ++corner) {
        for (const std::uint32_t node : side.nodes) add(side.element, corner, node);
      }
    }
    Sets sets(index_.size());
    const auto local = [&](std::uint32_t element, std::uint32_t node) {
      const auto& nodes = sides[element].nodes;
      return static_cast<std::size_t>(std::find(nodes.begin(), nodes.end(), node) - nodes.begin());
    };
    for (const auto& [corners, of_face] : faces) {
      for (std::size_t i = 1; i < of_face.size(); ++i) {
        for (const std::uint32_t corner : corners) {
          for (const std::uint32_t node : of_face[0].second) {
            const std::uint32_t e = of_face[0].first, f = of_face[i].first;
            sets.unite(add(e, local(e, corner), node), add(f, local(f, corner), node));
          }
        }
      }
    }
    for (const auto& [copy, index] : index_) class_[copy] = sets.find(index);
  }

  using Copy = std::tuple<std::uint32_t, std::size_t, std::uint32_t>;  // element, lowest corner, node
  const std::map<Copy, std::size_t>& classes() const { return class_; }

 private:
  std::vector<std::vector<std::size_t>> labels_;
  std::map<Copy, std::size_t> index_, class_;
};

/// A convex polyhedron as its faces, for clipping by planes.
class Polyhedron {
 public:
  using Polygon = std::vector<Eigen::Vector3d>;
  explicit Polyhedron(std::vector<Polygon> faces) : faces_(std::move(faces)) {}

  /// Keeps what lies below a plane: normal · x < offset.
  Polyhedron below(const Eigen::Vector3d& normal, double offset) const {
    std::vector<Polygon> kept;
    Polygon cap;
    for (const Polygon& face : faces_) {
      Polygon polygon;
      for (std::size_t i = 0; i < face.size(); ++i) {
        const Eigen::Vector3d &a = face[i], &b = face[(i + 1) % face.size()];
        const double at_a = normal.dot(a) - offset, at_b = normal.dot(b) - offset;
        if (at_a < 0) polygon.push_back(a);
        if ((at_a < 0) == (at_b < 0)) continue;
        polygon.push_back(a + at_a / (at_a - at_b) * (b - a));
        cap.push_back(polygon.back());
      }
      if (polygon.size() >= 3) kept.push_back(polygon);
    }
    if (cap.size() >= 3) {
      // Counter-clockwise seen from above the plane.
      Eigen::Vector3d centre = Eigen::Vector3d::Zero();
      for (const Eigen::Vector3d& point : cap) centre += point / static_cast<double>(cap.size());
      const Eigen::Vector3d u = (cap[0] - centre).normalized(), v = normal.normalized().cross(u);
      std::sort(cap.begin(), cap.end(), [&](const auto& a, const auto& b) {
        return std::atan2(v.dot(a - centre), u.dot(a - centre)) < std::atan2(v.dot(b - centre), u.dot(b - centre));
      });
      kept.push_back(cap);
    }
    return Polyhedron(kept);
  }

  /// Returns the volume, and the integral of the position, by cones from a corner to all faces.
  std::pair<double, Eigen::Vector3d> integrals() const {
    double volume = 0.0;
    Eigen::Vector3d moment = Eigen::Vector3d::Zero();
    if (faces_.empty()) return {volume, moment};
    const Eigen::Vector3d origin = faces_[0][0];
    for (const Polygon& face : faces_) {
      for (std::size_t i = 2; i < face.size(); ++i) {
        const double v = six_volumes(origin, face[0], face[i - 1], face[i]) / 6.0;
        volume += v;
        moment += v * (origin + face[0] + face[i - 1] + face[i]) / 4.0;
      }
    }
    return {volume, moment};
  }

 private:
  std::vector<Polygon> faces_;
};

}  // namespace tensormass::mesh::testing
