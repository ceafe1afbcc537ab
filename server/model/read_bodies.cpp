#include <set>

#include <fmt/format.h>

#include "core/limits.h"
#include "mesh/admission.h"
#include "mesh/curve.h"
#include "mesh/elevate.h"
#include "mesh/shapes.h"
#include "model/coagulation.h"
#include "model/cut_bodies.h"
#include "model/read_parts.h"
#include "model/scene_input.h"
#include "tensormass/v1/scene.pb.h"

/// Reads the bodies of a scene: their meshes, densities, colours, quadrature and materials.
namespace tensormass::model {

namespace {

/// From 37 to 100 °C soft tissue takes 0.24 J/mm³, and the 70 % of it that are water 1.6 J/mm³ to boil off.
constexpr double kDefaultAblationJPerM3 = 2e9;
/// Liver under a blade, 187 to 225 J/m² (docs/decisions/blades.md).
constexpr double kDefaultToughnessJPerM2 = 200;

/// Refuses lists that are longer than the limits of the server.
Result<void> check_counts(const v1::Body& body, std::string_view where) {
  const struct {
    const char* name;
    int count;
    std::size_t most;
    const char* limit;
  } lists[] = {
      {"sets", body.sets_size(), limits::kMaxSets, "kMaxSets"},
      {"law_regions", body.law_regions_size(), limits::kMaxLawRegions, "kMaxLawRegions"},
      {"fixed", body.fixed_size(), limits::kMaxBoundaryConditions, "kMaxBoundaryConditions"},
      {"prescribed", body.prescribed_size(), limits::kMaxBoundaryConditions, "kMaxBoundaryConditions"},
      {"loads", body.loads_size(), limits::kMaxBoundaryConditions, "kMaxBoundaryConditions"},
  };
  for (const auto& list : lists) {
    if (static_cast<std::size_t>(list.count) <= list.most) continue;
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{}.{}: {} exceed limits::{} = {}", where, list.name, list.count, list.limit, list.most));
  }
  return {};
}

Result<void> read_quadrature(const v1::Body& body, ReadBody& out, std::vector<Finding>& findings,
                             std::string_view where) {
  switch (body.quadrature()) {
    case v1::QUADRATURE_UNSPECIFIED:
    case v1::QUADRATURE_FULL:
      break;
    case v1::QUADRATURE_REDUCED:
      out.quadrature = physics::Quadrature::kReduced;
      findings.push_back(
          {.code = FindingCode::kReducedQuadrature,
           .value = 1,
           .place = fmt::format("{}.quadrature", where),
           .body = body.name(),
           .message = fmt::format("{}: reduced quadrature does not see the bending modes of an element", where),
           .remedy = "the mesh may fold in zigzag without resistance (one of quadratic hexahedra only where elements "
                     "stand in a single row)"});
      break;
    case v1::QUADRATURE_SELECTIVE:
      out.quadrature = physics::Quadrature::kSelective;
      break;
    default:
      return invalid(fmt::format("{}.quadrature: {} is unknown", where, static_cast<int>(body.quadrature())));
  }
  switch (body.mass()) {
    case v1::MASS_UNSPECIFIED:
    case v1::MASS_LUMPED:
      return {};
    case v1::MASS_CONSISTENT:
      out.consistent_mass = true;
      return {};
    default:
      return invalid(fmt::format("{}.mass: {} is unknown", where, static_cast<int>(body.mass())));
  }
}

Result<bool> read_makes_quadratic(const v1::Body& body, std::string_view where) {
  switch (body.element_order()) {
    case v1::ELEMENT_ORDER_UNSPECIFIED:
    case v1::ELEMENT_ORDER_AS_GIVEN:
      return false;
    case v1::ELEMENT_ORDER_QUADRATIC:
      return true;
    default:
      return invalid(fmt::format("{}.element_order: {} is unknown", where, static_cast<int>(body.element_order())));
  }
}

/// Refuses a mesh with which the scene would exceed the limits.
Result<void> check_scene_size(const mesh::Mesh& merged, const mesh::Mesh& mesh, std::string_view where) {
  const std::uint64_t nodes = merged.nodes.size() + mesh.nodes.size();
  const std::uint64_t elements = std::uint64_t{mesh::element_count(merged)} + mesh::element_count(mesh);
  if (nodes <= limits::kMaxNodes && elements <= limits::kMaxElements) return {};
  return fail(ErrorCode::kResourceExhausted,
              fmt::format("{}: the scene would have {} nodes and {} elements; limits::kMaxNodes = {}, "
                          "limits::kMaxElements = {}",
                          where, nodes, elements, limits::kMaxNodes, limits::kMaxElements));
}

/// Reads one body, checks its mesh, and appends it to those of the scene.
Result<void> read_body(const v1::Scene& scene, const Progress& progress, ReadBodies& all) {
  const std::size_t index = all.bodies.size();
  const v1::Body& body = scene.bodies(static_cast<int>(index));
  const auto body_count = static_cast<std::size_t>(scene.bodies_size());
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kReadMesh, index, body_count));
  const std::string where = fmt::format("body '{}'", body.name());
  TM_RETURN_IF_ERROR(check_counts(body, where));
  TM_ASSIGN_OR_RETURN(makes_quadratic, read_makes_quadratic(body, where));
  TM_ASSIGN_OR_RETURN(mesh, read_mesh(body, where));
  TM_RETURN_IF_ERROR(check_scene_size(all.merged, mesh, where));
  TM_RETURN_IF_ERROR(progress.begin(LoadPart::kCheckMesh, index, body_count));
  TM_ASSIGN_OR_RETURN(report, mesh::admit(mesh, body.name()));
  std::vector<mesh::EdgeEnds> middle_of;
  if (makes_quadratic) {
    // The mesh as given is admitted first, so that messages name its own elements and nodes.
    TM_ASSIGN_OR_RETURN(elevated, mesh::elevate(std::move(mesh), where + ".element_order"));
    if (body.has_skin()) {
      TM_ASSIGN_OR_RETURN(skin, read_skin(body, where));
      TM_ASSIGN_OR_RETURN(skin_report, mesh::admit_skin(skin.vertices, skin.triangles, where));
      (void)skin_report;  // make_visible_surface adds its findings
      mesh::curve(elevated, skin.vertices, skin.triangles);
    }
    mesh = std::move(elevated.mesh);
    middle_of = std::move(elevated.middle_of);
    TM_RETURN_IF_ERROR(check_scene_size(all.merged, mesh, where));
    TM_ASSIGN_OR_RETURN(report_of_quadratic, mesh::admit(mesh, body.name()));
    report = std::move(report_of_quadratic);
  }
  if (body.density_kg_per_m3() == 0) {
    return invalid(fmt::format("{}.density_kg_per_m3: not given, or zero; soft tissue has about 1000", where));
  }
  TM_ASSIGN_OR_RETURN(density, read_number(body.density_kg_per_m3(), 1e-3, 1e6, where + ".density_kg_per_m3"));
  const double ablation = body.has_ablation_j_per_m3() ? body.ablation_j_per_m3() : kDefaultAblationJPerM3;
  TM_ASSIGN_OR_RETURN(ablation_j_per_m3, read_number(ablation, 1e3, 1e12, where + ".ablation_j_per_m3"));
  const double toughness =
      body.has_fracture_toughness_j_per_m2() ? body.fracture_toughness_j_per_m2() : kDefaultToughnessJPerM2;
  TM_ASSIGN_OR_RETURN(toughness_j_per_m2, read_number(toughness, 1e-2, 1e6, where + ".fracture_toughness_j_per_m2"));

  const double coagulated = body.has_coagulated_stiffness_factor() ? body.coagulated_stiffness_factor() : 1;
  TM_ASSIGN_OR_RETURN(stiffness_factor,
                      read_number(coagulated, 1, kMaxCoagulatedStiffness, where + ".coagulated_stiffness_factor"));

  ReadBody out;
  out.name = body.name();
  out.coagulated_stiffness_factor = stiffness_factor;
  out.ablation_j_per_m3 = ablation_j_per_m3;
  out.fracture_toughness_j_per_m2 = toughness_j_per_m2;
  out.node_count = out.loaded_node_count = report.node_count;
  out.element_count = out.loaded_element_count = report.element_count;
  out.component_count = report.component_count;
  out.volume_m3 = report.volume_m3;
  out.mass_kg = report.volume_m3 * density;
  out.min_dihedral_angle_deg = report.min_dihedral_angle_deg;
  all.findings.insert(all.findings.end(), report.findings.begin(), report.findings.end());
  if (body.has_color_srgb()) {
    const v1::Vector3& color = body.color_srgb();
    for (const double component : {color.x(), color.y(), color.z()}) {
      TM_RETURN_IF_ERROR(read_number(component, 0, 1, where + ".color_srgb"));
    }
    out.has_color = true;
    out.color_srgb = {color.x(), color.y(), color.z()};
  }

  out.mesh = std::move(mesh);
  append_mesh(index, out, all);
  out.middle_of = std::move(middle_of);
  out.density_kg_per_m3 = density;
  TM_RETURN_IF_ERROR(read_quadrature(body, out, all.findings, where));
  TM_RETURN_IF_ERROR(read_materials(body, out, where));
  all.bodies.push_back(std::move(out));
  return {};
}

}  // namespace

void append_mesh(std::size_t body_index, ReadBody& body, ReadBodies& all) {
  body.node_begin = static_cast<std::uint32_t>(all.merged.nodes.size());
  body.element_begin = mesh::element_count(all.merged);
  all.merged.nodes.insert(all.merged.nodes.end(), body.mesh.nodes.begin(), body.mesh.nodes.end());
  for (const mesh::ElementBlock& block : body.mesh.blocks) {
    mesh::ElementBlock shifted = block;
    for (std::uint32_t& node : shifted.nodes) node += body.node_begin;
    all.merged.blocks.push_back(std::move(shifted));
    all.block_bodies.push_back(body_index);
  }
}

const mesh::Surface& BodyBoundaries::of(std::size_t body) {
  if (!surfaces_[body]) {
    surfaces_[body] = mesh::surface_of(bodies_[body].mesh, uncut_boundary_faces(bodies_[body]));
  }
  return *surfaces_[body];
}

Result<ReadBodies> read_bodies(const v1::Scene& scene, const Progress& progress) {
  if (scene.bodies().empty()) return invalid("scene.bodies: a scene needs at least one body");
  if (static_cast<std::size_t>(scene.bodies_size()) > limits::kMaxBodies) {
    return fail(ErrorCode::kResourceExhausted, fmt::format("scene.bodies: {} exceed limits::kMaxBodies = {}",
                                                           scene.bodies_size(), limits::kMaxBodies));
  }
  ReadBodies all;
  std::set<std::string> names;
  for (int i = 0; i < scene.bodies_size(); ++i) {
    const v1::Body& body = scene.bodies(i);
    TM_RETURN_IF_ERROR(check_name(body.name(), fmt::format("scene.bodies[{}].name", i)));
    if (!names.insert(body.name()).second) {
      return invalid(fmt::format("scene.bodies[{}]: the name '{}' is taken by another body", i, body.name()));
    }
    TM_RETURN_IF_ERROR(read_body(scene, progress, all));
  }
  return all;
}

}  // namespace tensormass::model
