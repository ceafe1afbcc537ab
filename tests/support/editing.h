#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <random>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include "model/edit.h"
#include "model/read_parts.h"
#include "support/laws.h"
#include "support/scenes.h"

/// Scenes that are edited, random edits of them, and the same scenes without what the edits took.
namespace tensormass::tests {

struct EditedBeam {
  v1::Shape shape = v1::SHAPE_TETRAHEDRON;
  std::string law = "st_venant_kirchhoff";
  v1::Quadrature quadrature = v1::QUADRATURE_FULL;
  bool double_precision = true;
  bool consistent_mass = false;
  bool viscoelastic = false;
  v1::Solver::Integrator integrator = v1::Solver::INTEGRATOR_IMPLICIT_EULER;
  std::uint32_t cells = 3, threads = 2;
  double coagulated_stiffness_factor = 1;
  std::uint32_t lag_steps = 1;

  friend void PrintTo(const EditedBeam& of, std::ostream* out) {
    *out << v1::Shape_Name(of.shape) << " " << of.law << " " << v1::Quadrature_Name(of.quadrature)
         << (of.double_precision ? " double" : " float") << (of.consistent_mass ? " consistent" : "")
         << (of.viscoelastic ? " viscoelastic" : "") << (of.coagulated_stiffness_factor > 1 ? " stiffening" : "")
         << (of.lag_steps > 1 ? " lagged" : "") << " " << v1::Solver::Integrator_Name(of.integrator);
  }
};

/// Returns a beam with editing, fixed at x = 0, under gravity, whose solves make the same number of iterations always.
inline v1::Scene edited_beam(const EditedBeam& of) {
  Beam beam;
  beam.cells_x = 2 * of.cells;
  beam.cells_y = beam.cells_z = of.cells;
  beam.size_x_m = 0.2;
  beam.size_y_m = 0.09;
  beam.size_z_m = 0.1;
  beam.double_precision = of.double_precision;
  beam.cg_max_iterations = 12;
  v1::Scene scene = beam_scene(beam);
  v1::Body& body = *scene.mutable_bodies(0);
  body.mutable_mesh()->mutable_grid()->set_shape(of.shape);
  *body.mutable_law() = law(of.law, 2e5, 0.4);
  body.set_quadrature(of.quadrature);
  body.set_mass(of.consistent_mass ? v1::MASS_CONSISTENT : v1::MASS_LUMPED);
  body.set_rayleigh_mass_per_s(0.1);
  body.set_rayleigh_stiffness_s(0.002);
  if (of.coagulated_stiffness_factor > 1) body.set_coagulated_stiffness_factor(of.coagulated_stiffness_factor);
  if (of.viscoelastic) {
    v1::PronyTerm& term = *body.mutable_law()->add_prony();
    term.set_share(0.3);
    term.set_relaxation_time_s(0.05);
  }
  scene.mutable_solver()->set_integrator(of.integrator);
  scene.mutable_solver()->set_cpu_threads(of.threads);
  if (of.lag_steps > 1) scene.mutable_solver()->set_tangent_lag_steps(of.lag_steps);
  if (of.integrator == v1::Solver::INTEGRATOR_BDF2) scene.mutable_solver()->set_cg_max_iterations(60);
  if (of.integrator == v1::Solver::INTEGRATOR_QUASI_STATIC) {
    scene.mutable_solver()->set_cg_max_iterations(3000);
    scene.mutable_solver()->set_cg_tolerance(of.double_precision ? 1e-13 : 1e-6);
    scene.mutable_solver()->set_allow_unconverged(true);
  }
  scene.mutable_editing();
  return scene;
}

/// Edits with random elements. Some keep a part of their material.
class RandomEdits {
 public:
  explicit RandomEdits(std::uint32_t seed) : random_(seed) {}

  /// Returns at most `count` elements that can lose material; those with more than `low` of them go for good.
  std::vector<model::Ablation> next(const model::Editor& editor, std::uint32_t element_count, std::size_t count) {
    std::vector<model::Ablation> out;
    std::set<std::uint32_t> named;
    for (std::size_t i = 0; i < count; ++i) {
      const auto element = static_cast<std::uint32_t>(random_() % element_count);
      const double kept = editor.kept(element);
      if (!(kept > 0) || !named.insert(element).second) continue;
      out.push_back({element, random_() % 3 == 0 ? kept * share_(random_) : 0});
    }
    return out;
  }
  std::uint32_t operator()() { return static_cast<std::uint32_t>(random_()); }

 private:
  std::mt19937 random_;
  std::uniform_real_distribution<double> share_{0.05, 0.95};
};

/// A body's mesh without some elements, and the nodes that are left of it.
struct RestOfMesh {
  v1::PackedMesh mesh;
  std::vector<std::uint32_t> nodes;  ///< [node of `mesh`] node of the whole one
};

/// Returns what is left of a body's mesh. gone(element) -> bool
template <class Gone>
RestOfMesh without(const mesh::Mesh& whole, const Gone& gone) {
  RestOfMesh out;
  std::vector<std::uint32_t> number(whole.nodes.size(), mesh::kNone);
  std::uint32_t element = 0;
  std::vector<std::pair<v1::Shape, std::vector<std::uint32_t>>> blocks;
  for (const mesh::ElementBlock& block : whole.blocks) {
    const std::size_t nodes = mesh::topology(block.shape).node_count;
    auto& kept = blocks.emplace_back(shapes()[static_cast<std::size_t>(block.shape)], std::vector<std::uint32_t>{});
    for (std::size_t first = 0; first < block.nodes.size(); first += nodes, ++element) {
      if (gone(element)) continue;
      for (std::size_t k = first; k < first + nodes; ++k) {
        kept.second.push_back(block.nodes[k]);
        number[block.nodes[k]] = 0;
      }
    }
  }
  std::vector<double> positions;
  for (std::uint32_t node = 0; node < number.size(); ++node) {
    if (number[node] == mesh::kNone) continue;
    number[node] = static_cast<std::uint32_t>(out.nodes.size());
    out.nodes.push_back(node);
    positions.insert(positions.end(), whole.nodes[node].begin(), whole.nodes[node].end());
  }
  const auto bytes = [](const auto& items) {
    return std::string(reinterpret_cast<const char*>(items.data()), items.size() * sizeof(items[0]));
  };
  out.mesh.set_node_positions(bytes(positions));
  for (auto& [shape, nodes] : blocks) {
    if (nodes.empty()) continue;
    for (std::uint32_t& node : nodes) node = number[node];
    v1::PackedElements& elements = *out.mesh.add_elements();
    elements.set_shape(shape);
    elements.set_nodes(bytes(nodes));
  }
  return out;
}

/// Reads the bodies of a scene.
inline model::ReadBodies bodies_of(const v1::Scene& scene) {
  auto bodies = model::read_bodies(scene, {});
  if (!bodies) throw std::runtime_error(bodies.error().message);
  return std::move(*bodies);
}

}  // namespace tensormass::tests
