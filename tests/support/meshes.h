#pragma once

#include <array>
#include <initializer_list>
#include <random>
#include <vector>

#include "mesh/shapes.h"

/// Small meshes built in code.
namespace tensormass::tests {

/// Returns one element on its shape's reference corners, with straight edges.
inline mesh::Mesh reference_element(mesh::Shape shape) {
  mesh::Mesh mesh;
  switch (shape) {
    case mesh::Shape::kTetrahedron:
    case mesh::Shape::kQuadraticTetrahedron:
      mesh.nodes = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
      break;
    case mesh::Shape::kPyramid:
      mesh.nodes = {{-1, -1, 0}, {1, -1, 0}, {1, 1, 0}, {-1, 1, 0}, {0, 0, 1}};
      break;
    case mesh::Shape::kWedge:
      mesh.nodes = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {0, 0, 1}, {1, 0, 1}, {0, 1, 1}};
      break;
    case mesh::Shape::kHexahedron:
    case mesh::Shape::kQuadraticHexahedron:
      mesh.nodes = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}, {0, 0, 1}, {1, 0, 1}, {1, 1, 1}, {0, 1, 1}};
      break;
  }
  const mesh::Topology& topology = mesh::topology(shape);
  for (std::uint32_t i = 0; topology.corner_count + i < topology.node_count; ++i) {
    const mesh::Edge& edge = topology.edges[i];
    mesh.nodes.push_back(0.5 * (mesh.nodes[edge.nodes[0]] + mesh.nodes[edge.nodes[1]]));
  }
  mesh::ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = shape;
  for (std::uint32_t i = 0; i < topology.node_count; ++i) block.nodes.push_back(i);
  return mesh;
}

/// Returns a conforming mesh with every linear shape: [0, 2] × [0, 1] × [0, 1.5] m in 4 × 2 × 3 cells.
///
///   top layer      pyramids and tetrahedra around each cell's centre; tetrahedra on the triangles of the wedges below
///   below, left    hexahedra
///   below, right   wedges
///
/// `shift` moves every inner node by up to that fraction of a cell in each direction, so that faces are not plane and
/// no two elements are alike. The surface does not move. Up to 0.2 the mesh is admissible.
inline mesh::Mesh mixed_mesh(double shift = 0.1) {
  constexpr std::uint32_t kCells[3] = {4, 2, 3};
  constexpr double kCell = 0.5;  // [m]
  mesh::Mesh mesh;
  for (mesh::Shape shape :
       {mesh::Shape::kTetrahedron, mesh::Shape::kPyramid, mesh::Shape::kWedge, mesh::Shape::kHexahedron}) {
    mesh.blocks.push_back({shape, {}});
  }
  auto &tetrahedra = mesh.blocks[0].nodes, &pyramids = mesh.blocks[1].nodes, &wedges = mesh.blocks[2].nodes,
       &hexahedra = mesh.blocks[3].nodes;
  for (std::uint32_t k = 0; k <= kCells[2]; ++k) {
    for (std::uint32_t j = 0; j <= kCells[1]; ++j) {
      for (std::uint32_t i = 0; i <= kCells[0]; ++i) mesh.nodes.push_back(kCell * Eigen::Vector3d(i, j, k));
    }
  }

  const auto add = [](std::vector<std::uint32_t>& block, const std::array<std::uint32_t, 8>& corners,
                      std::initializer_list<std::uint32_t> locals) {
    for (const std::uint32_t local : locals) block.push_back(corners[local]);
  };
  for (std::uint32_t k = 0; k < kCells[2]; ++k) {
    for (std::uint32_t j = 0; j < kCells[1]; ++j) {
      for (std::uint32_t i = 0; i < kCells[0]; ++i) {
        std::array<std::uint32_t, 8> corners;  // in the node order of a hexahedron
        const mesh::Mesh cell = reference_element(mesh::Shape::kHexahedron);
        for (std::size_t c = 0; c < 8; ++c) {
          const Eigen::Vector3d& at = cell.nodes[c];
          corners[c] = i + static_cast<std::uint32_t>(at.x()) +
                       (kCells[0] + 1) * (j + static_cast<std::uint32_t>(at.y()) +
                                          (kCells[1] + 1) * (k + static_cast<std::uint32_t>(at.z())));
        }
        const bool left = i < kCells[0] / 2;
        if (k + 1 < kCells[2] && left) {
          add(hexahedra, corners, {0, 1, 2, 3, 4, 5, 6, 7});
        } else if (k + 1 < kCells[2]) {
          add(wedges, corners, {0, 1, 2, 4, 5, 6});
          add(wedges, corners, {0, 2, 3, 4, 6, 7});
        } else {
          const auto centre = static_cast<std::uint32_t>(mesh.nodes.size());
          mesh.nodes.push_back(kCell * (Eigen::Vector3d(i, j, k) + Eigen::Vector3d::Constant(0.5)));
          const auto faces = mesh::topology(mesh::Shape::kHexahedron).faces;
          for (std::size_t f = 0; f < faces.size(); ++f) {
            const auto& n = faces[f].nodes;
            if (f == 0 && !left) {  // the bottom face, cut along the diagonal of the wedges
              add(tetrahedra, corners, {0, 1, 2});
              tetrahedra.push_back(centre);
              add(tetrahedra, corners, {0, 2, 3});
              tetrahedra.push_back(centre);
            } else {
              add(pyramids, corners, {n[3], n[2], n[1], n[0]});  // the face as seen from the centre
              pyramids.push_back(centre);
            }
          }
        }
      }
    }
  }

  std::mt19937 random(1);
  const auto uniform = [&] { return 2.0 * random() / double{0xFFFFFFFFu} - 1.0; };
  for (Eigen::Vector3d& node : mesh.nodes) {
    const Eigen::Vector3d step(uniform(), uniform(), uniform());
    bool inside = true;
    for (int axis = 0; axis < 3; ++axis) inside &= node[axis] > 0 && node[axis] < kCell * kCells[axis];
    if (inside) node += shift * kCell * step;
  }
  return mesh;
}

}  // namespace tensormass::tests
