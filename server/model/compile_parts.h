#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"
#include "mesh/surface.h"
#include "model/compile.h"
#include "model/material_input.h"
#include "model/model.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "physics/lists.h"

namespace tensormass::v1 {
class Body;
class Scene;
}  // namespace tensormass::v1

/// The parts of model::compile. It calls them in the order of this file, and each adds to the model.
namespace tensormass::model {

/// A body whose message is read and whose mesh is admitted.
struct ReadBody {
  mesh::Mesh mesh;
  std::vector<mesh::EdgeEnds> middle_of;  ///< edges in whose middles the last nodes are (BodyNodes)
  physics::Quadrature quadrature = physics::Quadrature::kFull;
  bool consistent_mass = false;
  double density_kg_per_m3 = 0;
  std::vector<Material> materials;
  std::vector<std::uint32_t> element_materials;  ///< [element_count] into materials; empty: all have the first

  const Material& material(std::uint32_t element) const {
    return materials[element_materials.empty() ? 0 : element_materials[element]];
  }
  BodyNodes nodes() const { return {mesh.nodes, middle_of}; }
};

/// The shape whose element pass evaluates a cluster.
using ClusterShape = physics::Hexahedron;
inline constexpr std::size_t kClusterNodes = ClusterShape::kNodes;

/// Elements that share a quadrature point (clusters.h).
struct Cluster {
  std::size_t body;
  double deviatoric_part;                                   ///< d
  std::array<std::uint32_t, kMaxClusterElements> elements;  ///< numbered in the body; mesh::kNone: there are fewer
  std::array<double, kMaxClusterElements> parts;            ///< V_e / V of each element
  std::array<std::uint32_t, kClusterNodes> nodes;           ///< numbered in the scene
  physics::PointGradients<ClusterShape, double> mean;       ///< ā_k and V
};

/// Springs between two bodies.
struct ReadAttachment {
  std::string name;
  std::vector<std::array<std::uint32_t, 2>> springs;  ///< nodes of the scene
  double stiffness_n_per_m, breaking_force_n;         ///< one spring's
};

/// A model that is being compiled.
struct Compilation {
  const v1::Scene& scene;
  Model model;
  mesh::Mesh merged;                      ///< the meshes of all bodies, one after the other
  std::vector<std::size_t> block_bodies;  ///< [block of merged] its body
  std::vector<ReadBody> bodies;
  std::vector<Cluster> clusters;
  std::vector<ReadAttachment> attachments;
  std::vector<std::optional<mesh::Surface>> surfaces;  ///< [body] those that were asked for

  /// Returns the boundary of a body's mesh, which is made when it is asked for first.
  const mesh::Surface& surface(std::size_t body);
  /// Returns the mean edge of that boundary [m].
  double mean_edge_m(std::size_t body);
  bool has_ties() const { return !model.body_contacts.empty() || !attachments.empty(); }
};

/// Visits every element of the scene.
///
///   visit(shape tag, body, element, nodes, x)   is called once an element. element: numbered in its body; nodes:
///                                               numbered in the scene; x: their positions [m]. Returns nothing.
///
/// Needs mesh::Shape and physics::Shapes in the same order.
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

/// Reads the name, stepping, solver, streams and gravity of the scene.
Result<void> read_header(Compilation& c);

/// Reads the bodies and merges their meshes. Adds the findings of their meshes.
Result<void> read_bodies(Compilation& c, const Progress& progress);

/// Reads body.law, law_regions and element_fields.
Result<void> read_materials(const v1::Body& body, ReadBody& out, std::string_view where);

/// Reads the tools. Needs the mesh.
Result<void> read_tools(Compilation& c);

/// Reads contacts between bodies and attachments. Needs the bodies.
Result<void> read_ties(Compilation& c);

/// Reads the findings that the scene accepts. Needs the bodies and tools.
Result<void> read_accepted(Compilation& c);

/// Fills rest positions, masses and damping. Needs the layout.
Result<void> fill_row_fields(Compilation& c);

/// Fills fixed and prescribed nodes, forces, tractions, pressures, gravity, initial displacements and velocities.
Result<void> fill_boundary_conditions(Compilation& c);

/// Puts every element into a group. Adds the tensors of linear laws to the constant edges.
Result<void> group_elements(Compilation& c);

/// Storage::kRows, kTiles: lists the elements that each row evaluates.
Result<void> list_elements_of_rows(Compilation& c);

/// Decides who runs the solve, where its vectors are stored, and which volumes it checks at its end.
void equip_solve(Compilation& c, const PatchPolicy& policy);

/// Makes the triangles that tools and bodies can touch: the boundary of all bodies.
void make_contact_surface(Compilation& c);
/// Makes the ties of contacts between bodies and of attachments. Needs the contact surface if bodies touch.
void make_ties(Compilation& c);
/// Finds the free bodies whose momentum each step balances. Needs the layout, boundary conditions, tools and ties.
void find_free_bodies(Compilation& c);
/// Makes the vertices that clients see: the skin of each body, or the boundary of its mesh.
Result<void> make_visible_surface(Compilation& c);
/// Makes the ends of springs that clients see. Needs the visible surface.
void make_visible_attachments(Compilation& c);

/// Finds what is probably a mistake in the scene, and marks what the scene accepts. Needs all of the above.
void find_mistakes(Compilation& c);
/// The parts of find_mistakes: in overlaps.cpp and tool_mistakes.cpp.
void find_overlaps(Compilation& c);
void find_mistakes_of_tools(Compilation& c);

}  // namespace tensormass::model
