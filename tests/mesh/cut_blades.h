#pragma once

#include <cmath>
#include <cstring>
#include <map>
#include <random>
#include <set>
#include <tuple>
#include <vector>

#include <gtest/gtest.h>
#include <Eigen/Geometry>

#include "cut_reference.h"
#include "mesh/cut.h"
#include "mesh/cut_surface.h"
#include "mesh/geometry.h"
#include "random_mesh.h"

/// Blades that move through meshes of the unit cube, and what must hold after each cut.
namespace tensormass::mesh::testing {

using Eigen::Vector3d;
using Blade = std::vector<Vector3d>;  // blade points [m]

/// A mesh with everything that cutting needs.
struct CutScene {
  Mesh mesh;
  CutTopology topology{mesh};
  CutSearch search{topology};
  Cut cut;
  std::vector<CutEdge> room;

  explicit CutScene(Mesh of_mesh, CutReserve reserve = {20000, 40000})
      : mesh(std::move(of_mesh)), cut(topology, reserve), room(topology.edge_count()) {}
  CutScene(const CutScene&) = delete;

  /// Moves a blade and cuts what it crosses. Returns the number of edges crossed.
  std::size_t move(const Blade& before, const Blade& after) {
    const Sweep sweep = search.sweep(before, after, room);
    EXPECT_FALSE(sweep.refused);
    const CutChange change = cut.cut(sweep.edges);
    EXPECT_FALSE(change.refused) << words(change.refusal);
    return sweep.edges.size();
  }
};

/// Returns a straight blade along y through the whole cube and beyond.
inline Blade wide_blade(double x, double z, int points = 3) {
  Blade blade;
  for (int i = 0; i < points; ++i) blade.push_back({x, -0.5 + 2.0 * i / (points - 1), z});
  return blade;
}

/// A blade on its way: positions at the steps of a cut.
using Path = std::vector<Blade>;

/// Returns the way of a random blade: of two to five points, straight or bent, that moves on a curve and may turn at
/// the same time. Every tenth lies on the lattice of the grid's nodes and moves from node to node.
inline Path random_path(std::mt19937& random, std::uint32_t cells) {
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  const auto direction = [&] {
    return Vector3d(Vector3d::NullaryExpr([&] { return uniform(random) - 0.5; }).normalized());
  };
  Path path;
  const int points = 2 + static_cast<int>(random() % 4), steps = 1 + static_cast<int>(random() % 4);
  const bool on_nodes = random() % 10 == 0;
  const double bend = random() % 2 == 0 ? 0.0 : 0.3;
  const double turn = random() % 2 == 0 ? 0.0 : 0.6 * (uniform(random) - 0.5);
  Vector3d at = Vector3d::NullaryExpr([&] { return 1.2 * uniform(random) - 0.1; }),
           way = (0.1 + 0.4 * uniform(random)) * direction();
  Vector3d along = direction() * (0.3 + 1.2 * uniform(random));
  const Vector3d axis = direction(), side = bend * along.cross(direction());
  for (int step = 0; step <= steps; ++step) {
    Blade& blade = path.emplace_back();
    for (int i = 0; i < points; ++i) {
      const double s = static_cast<double>(i) / (points - 1) - 0.5;
      Vector3d point = at + s * along + s * s * side;
      if (on_nodes) point = (point * cells).array().round().matrix() / cells;
      blade.push_back(point);
    }
    at += way;
    way = Eigen::AngleAxisd(turn, axis) * way;
    along = Eigen::AngleAxisd(turn, axis) * along;
  }
  return path;
}

/// The state of a cut by the mesh's own numbers: the same for any order of edits that leads to it.
inline std::vector<std::uint64_t> canonical(const Cut& cut) {
  const auto bits = [](double value) {
    std::uint64_t result;
    std::memcpy(&result, &value, sizeof result);
    return result;
  };
  std::vector<std::uint64_t> state;
  for (std::uint32_t edge = 0; edge < cut.topology().edge_count(); ++edge) {
    if (cut.is_cut(edge)) state.insert(state.end(), {edge, bits(cut.crossing(edge))});
  }
  std::map<std::uint32_t, std::uint64_t> number;
  for (std::uint32_t element = 0; element < cut.topology().element_count(); ++element) {
    for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
      const CutPart& part = cut.parts()[p];
      state.insert(state.end(), {element, part.corners, part.nodes, bits(part.shares.volume)});
      for (std::size_t k = 0; k < cut.topology().nodes(element).size(); ++k) {
        const std::uint32_t row = part.rows[k];
        const bool real = row < cut.topology().node_count();
        const std::uint64_t next = (std::uint64_t{1} << 32) + number.size();
        state.push_back(real ? row : number.try_emplace(row, next).first->second);
        state.push_back(bits(part.shares.nodes[k]));
      }
    }
  }
  return state;
}

/// Checks what must hold for every part: a real corner, a row for each node, shares above 0 that sum to 1; each corner
/// of the element in exactly one part, and the node's own row there.
inline void expect_sound_parts(const Cut& cut, std::uint32_t element) {
  const Topology& shape = cut.topology().shape(element);
  const auto nodes = cut.topology().nodes(element);
  std::uint32_t all = 0, lowest = 0;
  PartShares sum;
  for (std::uint32_t p = cut.first_part(element); p != kNone; p = cut.parts()[p].next) {
    const CutPart& part = cut.parts()[p];
    ASSERT_EQ(part.element, element);
    ASSERT_NE(part.corners, 0);
    ASSERT_GE(part.corners & -part.corners, static_cast<int>(lowest));
    lowest = part.corners & -part.corners;
    ASSERT_EQ(all & part.nodes, 0u);
    all |= part.nodes;
    ASSERT_GT(part.shares.volume, 0.0);
    sum.volume += part.shares.volume;
    std::set<std::uint32_t> rows;
    for (std::size_t k = 0; k < nodes.size(); ++k) {
      ASSERT_GE(part.shares.nodes[k], 0.0);
      sum.nodes[k] += part.shares.nodes[k];
      const std::uint32_t row = part.rows[k];
      ASSERT_LT(row, cut.row_count());
      const std::uint32_t node =
          row < cut.topology().node_count() ? row : cut.virtual_nodes()[row - cut.topology().node_count()].node;
      ASSERT_EQ(node, nodes[k]);
      rows.insert(row);
      ASSERT_TRUE((part.nodes >> k & 1u) == 0 || row == nodes[k]) << "a real node has its own row";
    }
    ASSERT_EQ(rows.size(), nodes.size()) << "a row stands twice in an element";
  }
  if (cut.first_part(element) == kNone) return;
  ASSERT_EQ(all, (1u << shape.node_count) - 1);
  ASSERT_NEAR(sum.volume, 1.0, 1e-12);
  for (std::size_t k = 0; k < nodes.size(); ++k) ASSERT_NEAR(sum.nodes[k], 1.0, 1e-12);
}

/// Checks that copies of nodes are one exactly where the reference says so. Virtual rows without material of the node
/// are free: a node's material is in one class.
inline void expect_reference_classes(const CutScene& scene) {
  const Cut& cut = scene.cut;
  const ReferenceClasses reference(scene.mesh, [&](std::uint32_t low, std::uint32_t high) {
    return cut.is_cut(cut.topology().edge_between(low, high));
  });
  std::map<std::size_t, std::uint32_t> row_of;
  std::map<std::uint32_t, std::size_t> class_of;
  for (const auto& [copy, of_class] : reference.classes()) {
    const auto& [element, corner, node] = copy;
    std::uint32_t row = node;
    if (cut.first_part(element) != kNone) {
      const auto nodes = cut.topology().nodes(element);
      const CutPart& part = cut.parts()[cut.part_of(element, static_cast<std::uint32_t>(corner))];
      row = part.rows[static_cast<std::size_t>(std::find(nodes.begin(), nodes.end(), node) - nodes.begin())];
    }
    ASSERT_EQ(row_of.try_emplace(of_class, row).first->second, row);
    ASSERT_EQ(class_of.try_emplace(row, of_class).first->second, of_class);
  }
}

/// Checks that every edge of a surface has exactly two triangles, in opposite directions, and that no triangle has a
/// vertex twice.
inline void expect_watertight(const CutSurface& surface) {
  std::map<std::pair<std::uint32_t, std::uint32_t>, int> uses;
  for (const Triangle& triangle : surface.triangles) {
    for (std::size_t i = 0; i < 3; ++i) {
      ASSERT_NE(triangle[i], triangle[(i + 1) % 3]);
      ++uses[{triangle[i], triangle[(i + 1) % 3]}];
    }
  }
  for (const auto& [edge, count] : uses) {
    ASSERT_EQ(count, 1) << edge.first << " " << edge.second;
    ASSERT_EQ(uses.count({edge.second, edge.first}), 1u) << edge.first << " " << edge.second;
  }
}

}  // namespace tensormass::mesh::testing
