#include "model/compile.h"

#include <algorithm>
#include <iterator>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "core/cut_limits.h"
#include "core/limits.h"
#include "mesh/adjacency.h"
#include "mesh/shapes.h"
#include "model/check.h"
#include "model/clusters.h"
#include "model/compile_parts.h"
#include "model/cut_bodies.h"
#include "model/edit_tables.h"
#include "tensormass/v1/scene.pb.h"

/// Compiles a scene, a message of untrusted input, to a Model, which a step can trust.
///
///   scene --read--> bodies, tools, links --merge--> one mesh --make_layout--> rows --make--> masses, loads, prescribed
///   rows
///                                                                          --group--> elements by (shape, law)
///                                                                          --make---> surfaces for contact and clients
///                                                                          --find---> what is probably a mistake
///
/// Reading may fail: each error names the place in the scene and the remedy. What follows works on checked values, and
/// check_model asserts at the end what the kernels rely on.
namespace tensormass::model {

namespace {

/// Returns the nodes that share an element or a cluster with each node.
mesh::Rows neighbours_of(const mesh::Mesh& mesh, std::span<const Cluster> clusters) {
  std::vector<std::span<const std::uint32_t>> coupled = mesh::element_nodes(mesh);
  for (const Cluster& cluster : clusters) coupled.emplace_back(cluster.nodes);
  return mesh::node_neighbours(static_cast<std::uint32_t>(mesh.nodes.size()), coupled);
}

/// Returns the findings of bodies that are loose in a quasi-static scene: without fixed nodes and inertia their
/// position is not determined.
std::vector<Finding> find_loose_bodies(const Settings& settings, std::span<const BodyModel> bodies) {
  std::vector<Finding> findings;
  if (!settings.quasi_static()) return findings;
  for (const BodyModel& body : bodies) {
    if (body.fixed_node_count > 0) continue;
    findings.push_back(
        {.code = FindingCode::kLooseBody,
         .value = 1,
         .place = fmt::format("body '{}'.fixed", body.name),
         .body = body.name,
         .message = fmt::format("body '{}': no node is fixed or prescribed, and a quasi-static step has no inertia, so "
                                "the position of the body is not determined",
                                body.name),
         .remedy = "give fixed or prescribed nodes"});
  }
  return findings;
}

/// Refuses what the integrator cannot compute.
Result<void> check_integrator(const Settings& settings, std::span<const ElementGroup> groups) {
  if (!settings.extrapolates()) return {};
  for (const ElementGroup& group : groups) {
    if (group.prony.empty()) continue;
    return invalid(
        "scene.solver.integrator: the implicit midpoint rule does not advance viscoelastic stress; take bdf2, or laws "
        "without prony terms");
  }
  return {};
}

Result<void> check_carried(const ContactSurface& contact) {
  if (contact.carried.count() <= limits::kMaxCarriedTriangles) return {};
  return fail(ErrorCode::kResourceExhausted,
              fmt::format("tools would touch {} triangles of cuts, more than limits::kMaxCarriedTriangles = {}; cut "
                          "less finely, or reset the scene",
                          contact.carried.count(), limits::kMaxCarriedTriangles));
}

/// Keeps the first findings of too many, and marks those that the scene accepts.
void finish_findings(const std::vector<AcceptedFinding>& accepted, std::vector<Finding>& findings) {
  if (findings.size() > limits::kMaxFindings) {
    const std::size_t more = findings.size() - limits::kMaxFindings;
    findings.resize(limits::kMaxFindings);
    findings.back().remedy += fmt::format(" (and {} more findings)", more);
  }
  for (Finding& finding : findings) accept(finding, accepted);
}

/// Moves the items of `more` to the end of `all`.
template <class Item>
void append(std::vector<Item>&& more, std::vector<Item>& all) {
  all.insert(all.end(), std::make_move_iterator(more.begin()), std::make_move_iterator(more.end()));
}

void store(RowFields&& fields, Model& model) {
  model.size_m = fields.size_m;
  model.rest = std::move(fields.rest);
  model.inertia = std::move(fields.inertia);
  model.row_mass = std::move(fields.row_mass);
  model.mass_edges = std::move(fields.mass_edges);
}

void store(BoundaryConditions&& boundary, Model& model) {
  hold_directions(boundary.held, model.rest);
  for (std::size_t b = 0; b < model.bodies.size(); ++b) {
    model.bodies[b].fixed_node_count = boundary.fixed_node_count[b];
  }
  model.external = std::move(boundary.external);
  model.initial_displacement = std::move(boundary.initial_displacement);
  model.initial_velocity = std::move(boundary.initial_velocity);
  model.prescribed_rows = std::move(boundary.prescribed_rows);
  model.prescribed = std::move(boundary.prescribed);
  model.pressure = std::move(boundary.pressure);
  model.scheduled = std::move(boundary.scheduled);
}

/// lists: of list_elements_of_rows, empty with kEdges
void store(GroupedElements&& elements, matrix::GroupRowLists&& lists, Model& model) {
  model.groups = std::move(elements.groups);
  model.constant_edges = std::move(elements.constant_edges);
  for (std::size_t g = 0; g < lists.groups.size(); ++g) model.groups[g].row_lists = std::move(lists.groups[g]);
  model.begun_slices = std::move(lists.begun_slices);
}

void store(SolveChoice&& choice, Model& model) {
  model.solve = choice.kind;
  model.solve_keeps_vectors = choice.keeps_vectors;
  for (const std::size_t group : choice.checked_groups) model.groups[group].solve_checks_volume = true;
  model.checked = std::move(choice.checked);
}

void store(VisibleBodies&& visible, Model& model) {
  model.visible = std::move(visible.surface);
  for (std::size_t b = 0; b < model.bodies.size(); ++b) {
    static_cast<VisibleBody&>(model.bodies[b]) = std::move(visible.bodies[b]);
  }
  append(std::move(visible.findings), model.findings);
}

void store(VisibleSprings&& springs, Model& model) {
  append(std::move(springs.rows), model.visible.rows);
  append(std::move(springs.weights), model.visible.weights);
  model.attachments = std::move(springs.attachments);
}

}  // namespace

matrix::Layout make_layout(const mesh::Mesh& mesh, std::span<const Cluster> clusters, const PatchPolicy& policy) {
  const auto nodes = static_cast<std::uint32_t>(mesh.nodes.size());
  return matrix::make_layout(mesh.nodes, neighbours_of(mesh, clusters), policy.count(nodes), policy.storage_of(nodes));
}

Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress,
                      const SceneCuts& cuts) {
  Model model;
  TM_ASSIGN_OR_RETURN(settings, read_settings(scene));
  static_cast<Settings&>(model) = std::move(settings);
  TM_ASSIGN_OR_RETURN(whole, read_bodies(scene, progress));
  TM_ASSIGN_OR_RETURN(bodies, cut_apart(std::move(whole), cuts));
  BodyBoundaries boundaries(bodies.bodies);
  TM_ASSIGN_OR_RETURN(tools, read_tools(scene, bodies.merged.nodes, model.dt_s));
  TM_ASSIGN_OR_RETURN(links, read_links(scene, bodies, boundaries));
  TM_ASSIGN_OR_RETURN(blades, find_blades(scene, bodies, tools.tools));
  links.blades = std::move(blades);
  TM_ASSIGN_OR_RETURN(accepted, read_accepted(scene, bodies.bodies, tools.tools));
  TM_ASSIGN_OR_RETURN(damping, read_damping(scene));
  for (const ReadBody& body : bodies.bodies) model.bodies.push_back({body, {}, {}, 0});
  model.tools = std::move(tools.tools);
  model.tool_samples = std::move(tools.samples);
  model.body_contacts = links.contacts;
  model.accepted = std::move(accepted);
  append(std::move(bodies.findings), model.findings);
  append(std::move(tools.findings), model.findings);

  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kOrderNodes));
  Clusters clusters = make_clusters(bodies.bodies);
  append(std::move(clusters.findings), model.findings);
  model.layout = make_layout(bodies.merged, clusters.clusters, policy);

  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kBoundaryConditions));
  store(make_row_fields(bodies, damping, links, model, model.layout), model);
  TM_ASSIGN_OR_RETURN(boundary, make_boundary_conditions(scene, bodies, model, model.layout, model.row_mass));
  ValueTables values;
  values.loads = std::move(boundary.loads);
  store(std::move(boundary), model);

  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kElements));
  TM_ASSIGN_OR_RETURN(elements, group_elements(bodies, clusters.clusters, model.layout));
  TM_RETURN_IF_ERROR(check_integrator(model, elements.groups));
  TM_ASSIGN_OR_RETURN(lists, list_elements_of_rows(model, model.layout, elements));
  values.groups = std::move(elements.sources);
  values.linear = std::move(elements.linear);
  for (const ReadBody& body : bodies.bodies) {
    values.bodies.push_back({body.loaded_element_count, body.element_laws, body.element_materials});
  }
  model.value_tables = std::make_shared<const ValueTables>(std::move(values));
  store(std::move(elements), std::move(lists), model);
  store(choose_solve(model, links, model.layout, model.groups, policy), model);

  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kSurfaces));
  if (!model.tools.empty() || !links.contacts.empty()) {
    model.contact = make_contact_surface(bodies, model.layout);
    TM_RETURN_IF_ERROR(check_carried(model.contact));
    write_surface_moduli(model.layout, model.contact, model.bodies);
  }
  if (!links.empty()) {
    model.links = make_links(
        {.bodies = bodies, .links = links, .layout = model.layout, .contact = model.contact, .tools = model.tools});
  }
  model.aggregates = make_aggregates(model, bodies.merged, model.layout);
  const bool may_touch = !model.tools.empty() || !links.empty();
  if (may_touch && !model.iterates() && !model.quasi_static()) {  // else no step balances momentum
    model.free_bodies = find_free_bodies({.bodies = bodies,
                                          .layout = model.layout,
                                          .rest = model.rest,
                                          .prescribed_rows = model.prescribed_rows,
                                          .pressure = model.pressure,
                                          .contacts = links.contacts,
                                          .spring_rows = model.links.spring_rows});
  }
  if (model.frame_rate_hz > 0) {
    TM_ASSIGN_OR_RETURN(visible, make_visible_surface(scene, bodies, boundaries, model.layout));
    store(std::move(visible), model);
    store(make_visible_springs(links.attachments, model.layout), model);
    TM_RETURN_IF_ERROR(append_cut_vertices(scene, bodies, model.layout, model.visible));
  }

  append(find_loose_bodies(model, model.bodies), model.findings);
  const bool has_moving_tool =
      std::any_of(model.tools.begin(), model.tools.end(), [](const ToolModel& tool) { return !tool.fixed; });
  append(find_mistakes_of_bodies(bodies.bodies, has_moving_tool), model.findings);
  append(find_mistakes_of_tools({.settings = model,
                                 .bodies = model.bodies,
                                 .damping = damping,
                                 .attachments = links.attachments,
                                 .tools = model.tools,
                                 .tool_samples = model.tool_samples,
                                 .layout = model.layout,
                                 .contact = model.contact,
                                 .rest = model.rest,
                                 .initial_displacement = model.initial_displacement,
                                 .initial_velocity = model.initial_velocity}),
         model.findings);
  append(find_overlaps({.bodies = bodies,
                        .boundaries = boundaries,
                        .contacts = links.contacts,
                        .layout = model.layout,
                        .contact = model.contact}),
         model.findings);
  finish_findings(model.accepted, model.findings);
  if (model.editing && !scene.editing().has_cutting())
    TM_RETURN_IF_ERROR(make_editable({.bodies = bodies, .clusters = clusters.clusters}, model));
  check_model(model);
  return model;
}

std::uint32_t PatchPolicy::count(std::uint32_t node_count) const {
  TM_ASSERT(node_count > 0 && max_nodes_per_patch > 0, "a scene has nodes, and a patch has room for some");
  const std::uint32_t most = node_count / std::max(min_nodes_per_patch, 1u);
  const std::uint32_t least = (node_count - 1) / max_nodes_per_patch + 1;
  return std::clamp(std::max(std::min(most, usual_patches), least), 1u, std::max(max_patches, 1u));
}

matrix::Storage PatchPolicy::storage_of(std::uint32_t node_count) const {
  const bool tiles = storage == matrix::Storage::kRows && (node_count - 1) / count(node_count) >= tiles_beyond_nodes;
  return tiles ? matrix::Storage::kTiles : storage;
}

std::uint32_t requested_cpu_threads(const v1::Scene& scene) {
  return scene.solver().has_cpu_threads() ? scene.solver().cpu_threads() : 0;
}

}  // namespace tensormass::model
