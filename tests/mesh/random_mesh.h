#pragma once

#include <algorithm>
#include <numeric>
#include <random>

#include "mesh/grid.h"
#include "mesh/shapes.h"

/// Meshes with nothing regular about them, for comparison with brute force.
namespace tensormass::mesh::testing {

/// A grid of `cells` cells a side over [0, 1]³ m.
inline Mesh unit_grid(std::uint32_t cells) {
  return make_grid(Eigen::Vector3d::Zero(), Eigen::Vector3d::Ones(), cells, cells, cells).value();
}

/// A grid with moved nodes, about `kept` of its elements, and nodes and elements in random order. Admitted, with holes,
/// and usually with non-manifold edges and several components.
inline Mesh random_mesh(std::uint32_t seed, std::uint32_t cells, double kept) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  const Mesh grid = unit_grid(cells);

  std::vector<std::uint32_t> elements(element_count(grid));
  std::iota(elements.begin(), elements.end(), 0u);
  std::shuffle(elements.begin(), elements.end(), random);
  elements.resize(std::max<std::size_t>(1, static_cast<std::size_t>(kept * static_cast<double>(elements.size()))));

  const auto nodes_of = element_nodes(grid);
  std::vector<bool> used(grid.nodes.size(), false);
  for (const std::uint32_t element : elements) {
    for (const std::uint32_t node : nodes_of[element]) used[node] = true;
  }
  std::vector<std::uint32_t> old_nodes;
  for (std::uint32_t node = 0; node < used.size(); ++node) {
    if (used[node]) old_nodes.push_back(node);
  }
  std::shuffle(old_nodes.begin(), old_nodes.end(), random);

  Mesh mesh;
  std::vector<std::uint32_t> new_node(grid.nodes.size(), kNone);
  for (const std::uint32_t node : old_nodes) {
    new_node[node] = static_cast<std::uint32_t>(mesh.nodes.size());
    const Eigen::Vector3d shift(uniform(random) - 0.5, uniform(random) - 0.5, uniform(random) - 0.5);
    mesh.nodes.push_back(grid.nodes[node] + 0.2 / cells * shift);  // too little to invert an element
  }
  ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = grid.blocks[0].shape;
  for (const std::uint32_t element : elements) {
    for (const std::uint32_t node : nodes_of[element]) block.nodes.push_back(new_node[node]);
  }
  return mesh;
}

inline double volume_m3(const Mesh& mesh) {
  double sum = 0.0;
  for_each_element(mesh, [&](std::uint32_t, const Topology& shape, std::span<const std::uint32_t> nodes) {
    for (const Simplex& s : shape.simplices) {
      sum += six_volumes(mesh.nodes[nodes[s[0]]], mesh.nodes[nodes[s[1]]], mesh.nodes[nodes[s[2]]],
                         mesh.nodes[nodes[s[3]]]) /
             6.0;
    }
  });
  return sum;
}

}  // namespace tensormass::mesh::testing
