#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"
#include "model/compile.h"
#include "model/material_input.h"
#include "model/model.h"
#include "physics/lists.h"
#include "tensormass/v1/scene.pb.h"

/// The parts of model::compile, which calls them in the order of this file. Each adds to the model.
namespace tensormass::model {

/// A body read and admitted, before it becomes part of the scene's mesh.
struct ReadBody {
  mesh::Mesh mesh;
  physics::Quadrature quadrature = physics::Quadrature::kFull;
  bool consistent_mass = false;
  double density_kg_per_m3 = 0;
  std::vector<Material> materials;
  std::vector<std::uint32_t> element_materials;  ///< [element_count] into materials; empty: all have the first

  const Material& material(std::uint32_t element) const {
    return materials[element_materials.empty() ? 0 : element_materials[element]];
  }
};

/// Two wedges that integrate their change of volume together (wedge_pairs.h).
struct WedgePair {
  std::size_t body;
  std::array<std::uint32_t, 2> elements;    ///< in the body
  std::array<std::uint32_t, 8> nodes;       ///< in the scene: the first wedge's, then what the second one adds
  std::array<std::size_t, 6> second_nodes;  ///< where the second wedge's nodes are in `nodes`
};

/// A model that is being compiled.
struct Compilation {
  const v1::Scene& scene;
  Model model;
  mesh::Mesh merged;                      ///< all bodies; its blocks are those of the bodies in their order
  std::vector<std::size_t> block_bodies;  ///< the body of each block of merged
  std::vector<ReadBody> bodies;
  std::vector<WedgePair> wedge_pairs;
};

/// Calls visit(shape tag, body, index of the element in its body, its scene nodes, their positions) for every element.
/// mesh::Shape counts as physics::Shapes does.
template <class Visit>
void for_each_element(const Compilation& c, const Visit& visit) {
  std::uint32_t element = 0;
  std::size_t body = 0;
  for (std::size_t b = 0; b < c.merged.blocks.size(); ++b) {
    const mesh::ElementBlock& block = c.merged.blocks[b];
    if (c.block_bodies[b] != body) element = 0;
    body = c.block_bodies[b];
    physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
      using Shape = typename decltype(tag)::Type;
      if (index != static_cast<int>(block.shape)) return;
      for (std::size_t first = 0; first < block.nodes.size(); first += Shape::kNodes, ++element) {
        const std::span<const std::uint32_t> nodes(block.nodes.data() + first, Shape::kNodes);
        Vec3<double> x[Shape::kNodes];
        for (int k = 0; k < Shape::kNodes; ++k) x[k] = c.merged.nodes[nodes[static_cast<std::size_t>(k)]];
        visit(tag, body, element, nodes, x);
      }
    });
  }
}

/// body.law, law_regions, element_fields, quadrature, mass.
Result<void> read_materials(const v1::Body& body, ReadBody& out, std::string_view where);

/// Rest positions, masses, damping.
Result<void> fill_row_fields(Compilation& c);

/// Fixed and prescribed nodes, forces, tractions, pressures, gravity, initial displacements and velocities.
Result<void> fill_boundary_conditions(Compilation& c);

/// Linear laws go into constant tensors; every element goes into a group.
Result<void> group_elements(Compilation& c);

/// With storage by rows: lists the elements that each row evaluates.
Result<void> list_elements_of_rows(Compilation& c);

/// Decides who runs the solve, where its vectors live, and which volumes it checks at its end.
void equip_solve(Compilation& c, const PatchPolicy& policy);

void make_contact_surface(Compilation& c);
Result<void> make_visible_surface(Compilation& c);

}  // namespace tensormass::model
