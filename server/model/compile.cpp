#include "model/compile.h"

#include <algorithm>
#include <utility>

#include <fmt/format.h>

#include "core/assert.h"
#include "model/check.h"
#include "model/clusters.h"
#include "model/compile_parts.h"
#include "tensormass/v1/scene.pb.h"

/// Compiles a scene, a message of untrusted input, to a Model, which a step can trust.
///
///   scene --read--> bodies, tools, ties --merge--> one mesh --make_layout--> rows --fill--> masses, loads, prescribed
///   rows
///                                                                          --group--> elements by (shape, law)
///                                                                          --make---> surfaces for contact and clients
///                                                                          --find---> what is probably a mistake
///
/// Reading may fail: each error names the place in the scene and the remedy. What follows works on checked values, and
/// check_model asserts at the end what the kernels rely on.
namespace tensormass::model {

namespace {

/// Makes the layout of the merged mesh. Clusters count as elements here only, because the matrix couples all nodes of
/// a cluster.
void make_layout(Compilation& c, const PatchPolicy& policy) {
  c.merged.blocks.push_back(cluster_block(c));
  const auto nodes = static_cast<std::uint32_t>(c.merged.nodes.size());
  c.model.layout = matrix::make_layout(c.merged, policy.count(nodes), policy.storage_of(nodes));
  c.merged.blocks.pop_back();
}

/// Finds free bodies in a quasi-static scene: without fixed nodes and inertia their position is not determined.
void find_loose_bodies(Model& model) {
  if (!model.quasi_static()) return;
  for (const BodyModel& body : model.bodies) {
    if (body.fixed_node_count > 0) continue;
    model.findings.push_back(
        {.code = FindingCode::kLooseBody,
         .value = 1,
         .place = fmt::format("body '{}'.fixed", body.name),
         .body = body.name,
         .message = fmt::format("body '{}': no node is fixed or prescribed, and a quasi-static step has no inertia, so "
                                "the position of the body is not determined",
                                body.name),
         .remedy = "give fixed or prescribed nodes"});
  }
}

/// Refuses what the integrator cannot compute.
Result<void> check_integrator(const Model& model) {
  if (!model.extrapolates()) return {};
  for (const ElementGroup& group : model.groups) {
    if (group.prony.empty()) continue;
    return invalid(
        "scene.solver.integrator: the implicit midpoint rule does not advance viscoelastic stress; take bdf2, or laws "
        "without prony terms");
  }
  return {};
}

}  // namespace

Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress) {
  Compilation c{scene, {}, {}, {}, {}, {}, {}, {}};
  TM_RETURN_IF_ERROR(read_header(c));
  TM_RETURN_IF_ERROR(read_bodies(c, progress));
  TM_RETURN_IF_ERROR(read_tools(c));
  TM_RETURN_IF_ERROR(read_ties(c));
  TM_RETURN_IF_ERROR(read_accepted(c));
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kOrderNodes));
  make_clusters(c);
  make_layout(c, policy);
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kBoundaryConditions));
  TM_RETURN_IF_ERROR(fill_row_fields(c));
  TM_RETURN_IF_ERROR(fill_boundary_conditions(c));
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kElements));
  TM_RETURN_IF_ERROR(group_elements(c));
  TM_RETURN_IF_ERROR(check_integrator(c.model));
  TM_RETURN_IF_ERROR(list_elements_of_rows(c));
  equip_solve(c, policy);
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kSurfaces));
  if (!c.model.tools.empty() || !c.model.body_contacts.empty()) make_contact_surface(c);
  if (c.has_ties()) make_ties(c);
  find_free_bodies(c);
  if (c.model.frame_rate_hz > 0) {
    TM_RETURN_IF_ERROR(make_visible_surface(c));
    make_visible_attachments(c);
  }
  find_loose_bodies(c.model);
  find_mistakes(c);
  check_model(c.model);
  return std::move(c.model);
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
