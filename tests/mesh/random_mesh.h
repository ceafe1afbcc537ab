#pragma once

#include <algorithm>
#include <numeric>
#include <random>
#include <string>
#include <tuple>

#include <gtest/gtest.h>

#include "mesh/grid.h"
#include "mesh/shapes.h"

/// Irregular meshes of every shape, for comparison with brute force.
namespace tensormass::mesh::testing {

inline std::vector<Shape> every_shape() {
  std::vector<Shape> shapes;
  for (std::size_t i = 0; i < kShapes.size(); ++i) shapes.push_back(static_cast<Shape>(i));
  return shapes;
}

/// Returns the shape's name in the form that GoogleTest allows in a test's name.
inline std::string test_name(Shape shape) {
  std::string name(topology(shape).name);
  std::replace(name.begin(), name.end(), ' ', '_');
  return name;
}

/// Returns a grid of [0, 1]³ m with `cells` cells along each side.
inline Mesh unit_grid(std::uint32_t cells, Shape shape = Shape::kTetrahedron) {
  return make_grid(Eigen::Vector3d::Zero(), Eigen::Vector3d::Ones(), cells, cells, cells, shape).value();
}

/// Returns an irregular but admissible mesh: a grid with randomly moved nodes, the fraction `kept` of its elements, and
/// nodes and elements in random order.
///
/// It has holes, and usually non-manifold edges and several components. Quadrilaterals are not plane, quadratic edges
/// not straight.
inline Mesh random_mesh(std::uint32_t seed, std::uint32_t cells, double kept, Shape shape = Shape::kTetrahedron) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<double> uniform(0.0, 1.0);
  const Mesh grid = unit_grid(cells, shape);

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

  const double reach = topology(shape).has_mid_edge_nodes() ? 0.1 : 0.2;  // too small to invert an element
  Mesh mesh;
  std::vector<std::uint32_t> new_node(grid.nodes.size(), kNone);
  for (const std::uint32_t node : old_nodes) {
    new_node[node] = static_cast<std::uint32_t>(mesh.nodes.size());
    const Eigen::Vector3d shift(uniform(random) - 0.5, uniform(random) - 0.5, uniform(random) - 0.5);
    mesh.nodes.push_back(grid.nodes[node] + reach / cells * shift);
  }
  ElementBlock& block = mesh.blocks.emplace_back();
  block.shape = shape;
  for (const std::uint32_t element : elements) {
    for (const std::uint32_t node : nodes_of[element]) block.nodes.push_back(new_node[node]);
  }
  return mesh;
}

/// Returns the local node order of an element after a rotation that maps the shape to itself.
inline std::vector<std::uint32_t> turned(Shape shape) {
  switch (shape) {
    case Shape::kTetrahedron:
      return {1, 2, 0, 3};
    case Shape::kPyramid:
      return {1, 2, 3, 0, 4};
    case Shape::kWedge:
      return {1, 2, 0, 4, 5, 3};
    case Shape::kHexahedron:
      return {1, 2, 3, 0, 5, 6, 7, 4};
    case Shape::kQuadraticTetrahedron:
      return {1, 2, 0, 3, 5, 6, 4, 8, 9, 7};
    case Shape::kQuadraticHexahedron:
      return {1, 2, 3, 0, 5, 6, 7, 4, 9, 10, 11, 8, 13, 14, 15, 12, 17, 18, 19, 16};
  }
  return {};
}

/// Fixture for tests over three random meshes of every shape.
class EveryMesh : public ::testing::TestWithParam<std::tuple<Shape, std::uint32_t>> {
 protected:
  const Shape shape_ = std::get<0>(GetParam());
  const std::uint32_t seed_ = std::get<1>(GetParam());
};

#define TENSORMASS_EVERY_MESH(Suite)                                                                            \
  INSTANTIATE_TEST_SUITE_P(                                                                                     \
      Meshes, Suite, ::testing::Combine(::testing::ValuesIn(testing::every_shape()), ::testing::Range(0u, 3u)), \
      [](const auto& mesh) {                                                                                    \
        return testing::test_name(std::get<0>(mesh.param)) + "_" + std::to_string(std::get<1>(mesh.param));     \
      })

}  // namespace tensormass::mesh::testing
