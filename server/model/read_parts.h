#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/findings.h"
#include "core/result.h"
#include "mesh/mesh.h"
#include "mesh/surface.h"
#include "model/material_input.h"
#include "model/model.h"
#include "model/progress.h"
#include "model/scene_input.h"
#include "physics/element/element.h"
#include "physics/lists.h"

namespace tensormass::v1 {
class Body;
class Scene;
}  // namespace tensormass::v1

/// What model::compile reads of a scene: values that are checked, numbered by body, node and element.
///
/// None of them depends on how the mesh is cut into patches, so a part of the model (compile_parts.h) can be made again
/// from them without the message.
namespace tensormass::model {

class BodyCut;

/// A body whose message is read and whose mesh is admitted.
struct ReadBody : AdmittedBody {
  mesh::Mesh mesh;                           ///< a body with cuts has their copies here
  std::shared_ptr<const BodyCut> cut;        ///< cut_bodies.h; nullptr: the body is whole
  std::vector<std::uint32_t> copy_parts;     ///< [element_copies] index into mesh::Cut::parts
  std::vector<std::uint32_t> part_elements;  ///< [mesh::Cut::parts] element of the body
  std::vector<mesh::EdgeEnds> middle_of;     ///< edges in whose middles the last nodes are (BodyNodes)
  physics::Quadrature quadrature = physics::Quadrature::kFull;
  bool consistent_mass = false;
  double density_kg_per_m3 = 0;
  std::vector<Material> materials;
  std::vector<std::uint32_t> element_materials;  ///< [element_count] into materials; empty: all have the first
  /// [loaded_element_count] law of each element: 0 is body.law, i is law_regions[i − 1]; empty: all have body.law
  std::vector<std::uint32_t> element_laws;

  /// element: numbered in the body
  const Material& material(std::uint32_t element) const {
    return materials[element_materials.empty() ? 0 : element_materials[element]];
  }
  /// Nodes as loaded. Regions choose among them, so a copy that a cut makes is free.
  BodyNodes nodes() const { return {std::span(mesh.nodes).first(loaded_node_count), middle_of}; }
};

/// All bodies of a scene.
struct ReadBodies {
  std::vector<ReadBody> bodies;
  mesh::Mesh merged;                      ///< the meshes of all bodies, one after the other
  std::vector<std::size_t> block_bodies;  ///< [block of merged] its body
  std::vector<Finding> findings;          ///< those of their meshes
};

/// The boundaries of the bodies' meshes, each made when it is asked for first. The bodies outlive it.
class BodyBoundaries {
 public:
  explicit BodyBoundaries(std::span<const ReadBody> bodies) : bodies_(bodies), surfaces_(bodies.size()) {}

  const mesh::Surface& of(std::size_t body);
  /// Returns whether the boundary of a body was asked for before.
  bool has(std::size_t body) const { return surfaces_[body].has_value(); }
  /// Returns the mean edge of the boundary of a body [m].
  double mean_edge_m(std::size_t body);

 private:
  std::span<const ReadBody> bodies_;
  std::vector<std::optional<mesh::Surface>> surfaces_;  // [body]
};

/// All tools of a scene.
struct ReadTools {
  std::vector<ToolModel> tools;
  std::vector<float> samples;     ///< Model::tool_samples
  std::vector<Finding> findings;  ///< those of their surfaces
};

/// Springs between two bodies.
struct ReadAttachment {
  std::string name;
  std::vector<std::array<std::uint32_t, 2>> springs;  ///< nodes of the scene
  std::vector<double> rest_lengths_m;                 ///< [spring]
  double stiffness_n_per_m, breaking_force_n;         ///< one spring's
};

/// What couples rows that share no element.
struct ReadLinks {
  std::vector<BodyContactModel> contacts;
  std::vector<ReadAttachment> attachments;
  std::vector<std::uint32_t> blades;  ///< places of the tools that are blades

  bool empty() const { return contacts.empty() && attachments.empty() && blades.empty(); }
};

/// Rayleigh damping of a body.
struct Damping {
  double mass_per_s = 0, stiffness_s = 0;  ///< α, β
};

/// Visits every element of the scene.
///
///   visit(shape tag, body, element, nodes, x)   is called once an element. element: numbered in its body; nodes:
///                                               numbered in the scene; x: their positions [m]. Returns nothing.
///
/// Needs mesh::Shape and physics::Shapes in the same order.
template <class Visit>
void for_each_element(const ReadBodies& all, const Visit& visit) {
  std::uint32_t element = 0;
  std::size_t body = 0;
  for (std::size_t b = 0; b < all.merged.blocks.size(); ++b) {
    const mesh::ElementBlock& block = all.merged.blocks[b];
    if (all.block_bodies[b] != body) element = 0;
    body = all.block_bodies[b];
    physics::for_each_type(physics::Shapes{}, [&](auto tag, int index) {
      using Shape = typename decltype(tag)::Type;
      if (index != static_cast<int>(block.shape)) return;
      for (std::size_t first = 0; first < block.nodes.size(); first += Shape::kNodes, ++element) {
        const std::span<const std::uint32_t> nodes(block.nodes.data() + first, Shape::kNodes);
        Vec3<double> x[Shape::kNodes];
        for (int k = 0; k < Shape::kNodes; ++k) x[k] = all.merged.nodes[nodes[static_cast<std::size_t>(k)]];
        visit(tag, body, element, nodes, x);
      }
    });
  }
}

/// Reads the name, stepping, solver, guard, streams and gravity of the scene.
Result<Settings> read_settings(const v1::Scene& scene);

/// Reads the bodies and merges their meshes.
Result<ReadBodies> read_bodies(const v1::Scene& scene, const Progress& progress);

/// Appends the mesh of a body to those of the scene, and sets its ranges.
void append_mesh(std::size_t body_index, ReadBody& body, ReadBodies& all);

/// Reads body.law, law_regions and element_fields into `out`, whose mesh is read already.
Result<void> read_materials(const v1::Body& body, ReadBody& out, std::string_view where);
/// Returns ReadBody::materials for elements whose laws are known.
///
///   element_laws    ReadBody::element_laws
///   element_count   elements of the body as loaded
Result<std::vector<Material>> read_materials(const v1::Body& body, std::span<const std::uint32_t> element_laws,
                                             std::size_t element_count, std::string_view where);

/// Reads the tools.
///
///   nodes   of all bodies at rest: a plane is as thick as a share of the scene
///   dt_s    time of a step, in which a tool moves a part of its radius at most
Result<ReadTools> read_tools(const v1::Scene& scene, std::span<const Eigen::Vector3d> nodes, double dt_s);

/// Reads contacts between bodies and attachments.
Result<ReadLinks> read_links(const v1::Scene& scene, const ReadBodies& bodies, BodyBoundaries& boundaries);

/// Reads the findings that the scene accepts, of bodies and tools that it has.
Result<std::vector<AcceptedFinding>> read_accepted(const v1::Scene& scene, std::span<const ReadBody> bodies,
                                                   std::span<const ToolModel> tools);

/// Reads the damping of each body.
Result<std::vector<Damping>> read_damping(const v1::Scene& scene);

}  // namespace tensormass::model
