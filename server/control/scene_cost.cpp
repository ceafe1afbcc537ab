#include "control/scene_cost.h"

#include <cstdint>

namespace tensormass::control {
namespace {

/// Costs of an element of a shape with all that belongs to it: its nodes, its share of the matrix, its part of the
/// surface. Measured as the growth of the process's peak, plus a fifth.
struct ShapeCost {
  double bytes;
  double compile_s;
  double nodes_per_element;  ///< as the message counts them: indices of one element
  double per_cell;           ///< elements that a grid makes of a cell
  double nodes_per_cell;     ///< in a large grid
};

constexpr ShapeCost cost_of(v1::Shape shape) {
  switch (shape) {
    case v1::SHAPE_PYRAMID:
      return {2400, 18e-6, 5, 6, 2};
    case v1::SHAPE_WEDGE:
      return {2600, 33e-6, 6, 2, 1};
    case v1::SHAPE_HEXAHEDRON:
      return {5000, 40e-6, 8, 1, 1};
    case v1::SHAPE_QUADRATIC_TETRAHEDRON:
      return {5000, 60e-6, 10, 6, 8};
    case v1::SHAPE_QUADRATIC_HEXAHEDRON:
      return {28'000, 170e-6, 20, 1, 4};
    default:
      return {600, 5e-6, 4, 6, 1};
  }
}

/// The shape that the elements of a body get in the model.
v1::Shape modelled(v1::Shape shape, const v1::Body& body) {
  if (body.element_order() != v1::ELEMENT_ORDER_QUADRATIC) return shape;
  if (shape == v1::SHAPE_HEXAHEDRON) return v1::SHAPE_QUADRATIC_HEXAHEDRON;
  return shape == v1::SHAPE_UNSPECIFIED || shape == v1::SHAPE_TETRAHEDRON ? v1::SHAPE_QUADRATIC_TETRAHEDRON : shape;
}

/// Bytes of what the message itself has, which is parsed, checked and kept.
constexpr double kBytesPerMessageByte = 4;
/// Bytes of a node of a packed mesh, which need not belong to an element.
constexpr double kBytesPerNode = 200;
/// Time to test one node against one region.
constexpr double kSecondsPerRegionTest = 5e-9;

void add_mesh(const v1::Body& body, SceneCost& cost) {
  const auto add = [&](v1::Shape shape, double elements, double nodes) {
    const ShapeCost one = cost_of(modelled(shape, body));
    cost.elements += elements;
    cost.nodes += nodes;
    cost.bytes += elements * one.bytes + nodes * kBytesPerNode;
    cost.compile_s += elements * one.compile_s;
  };
  if (body.mesh().has_grid()) {
    const v1::Grid& grid = body.mesh().grid();
    const double cells = double{1} * grid.cells_x() * grid.cells_y() * grid.cells_z();
    const ShapeCost shape = cost_of(grid.shape());
    add(grid.shape(), cells * shape.per_cell, cells * cost_of(modelled(grid.shape(), body)).nodes_per_cell);
  }
  const v1::PackedMesh& packed = body.mesh().packed();
  add(v1::SHAPE_UNSPECIFIED, 0, static_cast<double>(packed.node_positions().size() / (3 * sizeof(double))));
  for (const v1::PackedElements& elements : packed.elements()) {
    const double indices = static_cast<double>(elements.nodes().size() / sizeof(std::uint32_t));
    add(elements.shape(), indices / cost_of(elements.shape()).nodes_per_element, 0);
  }
}

}  // namespace

SceneCost estimate_cost(const v1::Scene& scene) {
  SceneCost cost;
  cost.bytes = kBytesPerMessageByte * static_cast<double>(scene.ByteSizeLong());
  for (const v1::Body& body : scene.bodies()) {
    SceneCost own;
    add_mesh(body, own);
    double regions = body.fixed_size() + body.loads_size() + body.prescribed_size() + body.law_regions_size();
    for (const v1::NamedSet& set : body.sets()) regions += set.regions_size();
    own.compile_s += own.nodes * regions * kSecondsPerRegionTest;
    cost.elements += own.elements;
    cost.nodes += own.nodes;
    cost.bytes += own.bytes;
    cost.compile_s += own.compile_s;
  }
  return cost;
}

}  // namespace tensormass::control
