#include <cmath>
#include <functional>
#include <limits>
#include <string>
#include <vector>

#include <gtest/gtest.h>

#include "core/limits.h"
#include "model/refusals.h"

/// Everything that a scene can be refused for, one by one: the code, the place by name, and what is said of it.
namespace tensormass::model {
namespace {

v1::Body& body(v1::Scene& scene) { return *scene.mutable_bodies(0); }
void lag(v1::Scene& scene, std::uint32_t steps, double strain) {
  scene.mutable_solver()->set_tangent_lag_steps(steps), scene.mutable_solver()->set_tangent_lag_strain(strain);
}
v1::Grid& grid(v1::Scene& scene) { return *body(scene).mutable_mesh()->mutable_grid(); }
v1::Tool& tool(v1::Scene& scene) { return *scene.mutable_tools(0); }
v1::SphericalProbe& probe(v1::Scene& scene) { return *tool(scene).mutable_spherical_probe(); }
v1::IsotropicElastic& stvk(v1::Scene& scene) { return *body(scene).mutable_law()->mutable_st_venant_kirchhoff(); }

template <class Item>
std::string bytes(const std::vector<Item>& items) {
  return {reinterpret_cast<const char*>(items.data()), items.size() * sizeof(Item)};
}

/// One tetrahedron over the corner of a 1 m cube, with these node indices.
void pack(v1::Scene& scene, const std::vector<std::uint32_t>& tetrahedra,
          const std::vector<double>& nodes = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1}) {
  v1::PackedMesh& packed = *body(scene).mutable_mesh()->mutable_packed();
  packed.set_node_positions(bytes(nodes));
  packed.add_elements()->set_nodes(bytes(tetrahedra));
}

void skin(v1::Scene& scene, const std::vector<double>& vertices, const std::vector<std::uint32_t>& triangles) {
  v1::PackedTriangles& packed = *body(scene).mutable_skin()->mutable_packed();
  packed.set_vertex_positions(bytes(vertices));
  packed.set_triangles(bytes(triangles));
}

std::vector<Refusal> header_refusals() {
  return {
      {"EmptyName", [](auto& s) { s.set_name(""); }, {"scene.name", "1 to 64 characters"}},
      {"LongName", [](auto& s) { s.set_name(std::string(65, 'a')); }, {"scene.name", "64"}},
      {"NameThatBreaksKeys", [](auto& s) { s.set_name("a/b"); }, {"scene.name", "[A-Za-z0-9_-]"}},
      {"ZeroTimeStep", [](auto& s) { s.mutable_stepping()->set_dt_s(0); }, {"scene.stepping.dt_s", "1e-06", "10"}},
      {"NanTimeStep", [](auto& s) { s.mutable_stepping()->set_dt_s(kNan); }, {"scene.stepping.dt_s", "nan"}},
      {"LongTimeStep", [](auto& s) { s.mutable_stepping()->set_dt_s(11); }, {"scene.stepping.dt_s", "11"}},
      {"NoRate", [](auto& s) { s.mutable_stepping()->set_rate_hz(0); }, {"scene.stepping.rate_hz"}},
      {"AbsurdRate", [](auto& s) { s.mutable_stepping()->set_rate_hz(1e6); }, {"scene.stepping.rate_hz", "20000"}},
      {"UnknownPrecision",
       [](auto& s) { s.mutable_solver()->set_precision(static_cast<v1::Solver::Precision>(9)); },
       {"scene.solver.precision", "9", "unknown"}},
      {"NoIterations",
       [](auto& s) { s.mutable_solver()->set_cg_max_iterations(0); },
       {"scene.solver.cg_max_iterations"}},
      {"TooManyIterations",
       [](auto& s) { s.mutable_solver()->set_cg_max_iterations(1'000'000); },
       {"scene.solver.cg_max_iterations", "100000"}},
      {"NegativeTolerance", [](auto& s) { s.mutable_solver()->set_cg_tolerance(-1); }, {"scene.solver.cg_tolerance"}},
      {"NanTolerance", [](auto& s) { s.mutable_solver()->set_cg_tolerance(kNan); }, {"scene.solver.cg_tolerance"}},
      {"BudgetWithoutAFloor",
       [](auto& s) { s.mutable_solver()->set_budget_s(0.01); },
       {"scene.solver.budget_s", "floor_cg_iterations", "floor_tolerance"}},
      {"NoBudget",
       [](auto& s) {
         s.mutable_solver()->set_budget_s(0);
         s.mutable_solver()->set_floor_cg_iterations(1);
       },
       {"scene.solver.budget_s", "1e-06"}},
      {"FloorWithoutABudget",
       [](auto& s) { s.mutable_solver()->set_floor_cg_iterations(5); },
       {"scene.solver.floor_cg_iterations", "budget_s"}},
      {"FloorAboveTheCeiling",
       [](auto& s) {
         s.mutable_solver()->set_cg_max_iterations(50);
         s.mutable_solver()->set_budget_s(0.01);
         s.mutable_solver()->set_floor_cg_iterations(51);
       },
       {"scene.solver.floor_cg_iterations", "50"}},
      {"FloorBelowWhereTheSolveStops",
       [](auto& s) {
         s.mutable_solver()->set_cg_tolerance(1e-3);
         s.mutable_solver()->set_floor_tolerance(1e-4);
       },
       {"scene.solver.floor_tolerance", "cg_tolerance"}},
      {"NanFloor", [](auto& s) { s.mutable_solver()->set_floor_tolerance(kNan); }, {"scene.solver.floor_tolerance"}},
      {"NoThreads", [](auto& s) { s.mutable_solver()->set_cpu_threads(0); }, {"scene.solver.cpu_threads", "256"}},
      {"TooManyThreads", [](auto& s) { s.mutable_solver()->set_cpu_threads(257); }, {"scene.solver.cpu_threads"}},
      {"NegativeFrameRate",
       [](auto& s) { s.mutable_streams()->set_frame_rate_hz(-1); },
       {"scene.streams.frame_rate_hz"}},
      {"StatusOnceInAges",
       [](auto& s) { s.mutable_streams()->set_status_rate_hz(1e-12); },
       {"scene.streams.status_rate_hz", "neither 0 nor"}},
      {"NanStatusRate",
       [](auto& s) { s.mutable_streams()->set_status_rate_hz(kNan); },
       {"scene.streams.status_rate_hz"}},
      {"InfiniteGravity",
       [](auto& s) { s.mutable_gravity_m_per_s2()->set_y(-kInfinity); },
       {"scene.gravity_m_per_s2", "not finite"}},
  };
}

std::vector<Refusal> body_refusals() {
  return {
      {"NoBody", [](auto& s) { s.clear_bodies(); }, {"scene.bodies", "at least one"}},
      {"TooManyBodies",
       [](auto& s) {
         while (s.bodies_size() <= static_cast<int>(limits::kMaxBodies)) *s.add_bodies() = s.bodies(0);
       },
       {"scene.bodies", "kMaxBodies"},
       ErrorCode::kResourceExhausted},
      {"BodyName", [](auto& s) { body(s).set_name("left kidney"); }, {"scene.bodies[0].name"}},
      {"TwoBodiesOfOneName", [](auto& s) { *s.add_bodies() = s.bodies(0); }, {"scene.bodies[1]", "'beam'", "taken"}},
      {"NoDensity", [](auto& s) { body(s).clear_density_kg_per_m3(); }, {"body 'beam'.density_kg_per_m3", "not given"}},
      {"NanDensity", [](auto& s) { body(s).set_density_kg_per_m3(kNan); }, {"body 'beam'.density_kg_per_m3"}},
      {"NegativeDamping", [](auto& s) { body(s).set_rayleigh_mass_per_s(-1); }, {"body 'beam'.rayleigh_mass_per_s"}},
      {"NanDamping", [](auto& s) { body(s).set_rayleigh_stiffness_s(kNan); }, {"body 'beam'.rayleigh_stiffness_s"}},
      {"NanColor", [](auto& s) { body(s).mutable_color_srgb()->set_y(kNan); }, {"body 'beam'.color_srgb"}},
      {"ColorBeyondOne",
       [](auto& s) { body(s).mutable_color_srgb()->set_y(128); },
       {"body 'beam'.color_srgb", "128", "[0, 1]"}},
      {"NoLaw", [](auto& s) { body(s).clear_law(); }, {"body 'beam'.law", "hooke", "st_venant_kirchhoff"}},
      {"NoStiffness",
       [](auto& s) { stvk(s).set_young_modulus_pa(0); },
       {"body 'beam'.law.st_venant_kirchhoff.young_modulus_pa"}},
      {"NanStiffness",
       [](auto& s) { stvk(s).set_young_modulus_pa(kNan); },
       {"body 'beam'.law.st_venant_kirchhoff.young_modulus_pa", "nan"}},
      {"Incompressible",
       [](auto& s) { stvk(s).set_poisson_ratio(0.5); },
       {"body 'beam'.law.st_venant_kirchhoff.poisson_ratio", "0.5"}},
      {"HookePoisson",
       [](auto& s) {
         body(s).mutable_law()->mutable_hooke()->set_young_modulus_pa(1);
         body(s).mutable_law()->mutable_hooke()->set_poisson_ratio(-1);
       },
       {"body 'beam'.law.hooke.poisson_ratio"}},
  };
}

std::vector<Refusal> mesh_refusals() {
  return {
      {"NoMesh", [](auto& s) { body(s).clear_mesh(); }, {"body 'beam'.mesh", "packed or grid"}},
      {"MeshFile",
       [](auto& s) { body(s).mutable_mesh()->set_file("liver.msh"); },
       {"body 'beam'.mesh.file", "reads no files"}},
      {"NoCells", [](auto& s) { grid(s).set_cells_y(0); }, {"body 'beam'.mesh.grid", "cells_y"}},
      {"FlatGrid", [](auto& s) { grid(s).mutable_size_m()->set_z(0); }, {"body 'beam'.mesh.grid", "size_m.z"}},
      {"NanGrid", [](auto& s) { grid(s).mutable_size_m()->set_z(kNan); }, {"body 'beam'.mesh.grid.size_m"}},
      {"FarGrid", [](auto& s) { grid(s).mutable_origin_m()->set_z(1e9); }, {"body 'beam'.mesh.grid.origin_m"}},
      {"HugeGrid",
       [](auto& s) {
         grid(s).set_cells_x(4'000'000'000u);
         grid(s).set_cells_y(4'000'000'000u);
       },
       {"body 'beam'.mesh.grid", "kMaxElements"},
       ErrorCode::kResourceExhausted},
      {"ZeroScale", [](auto& s) { body(s).mutable_mesh()->set_scale(0); }, {"body 'beam'.mesh.scale"}},
      {"NanTranslation",
       [](auto& s) { body(s).mutable_mesh()->mutable_translation_m()->set_x(kNan); },
       {"body 'beam'.mesh.translation_m"}},
      {"NodesCutShort",
       [](auto& s) {
         pack(s, {0, 1, 2, 3});
         body(s).mutable_mesh()->mutable_packed()->mutable_node_positions()->pop_back();
       },
       {"body 'beam'.mesh.packed.node_positions", "95 bytes", "multiple of 24"}},
      {"ElementsCutShort",
       [](auto& s) {
         pack(s, {0, 1, 2});
       },
       {"body 'beam'.mesh.packed.elements[0].nodes", "12 bytes"}},
      {"NoElements", [](auto& s) { pack(s, {}); }, {"body 'beam'.mesh.packed.elements[0].nodes", "0 bytes"}},
      {"IndexOutOfRange",
       [](auto& s) {
         pack(s, {0, 1, 2, 4});
       },
       {"element 0 of body 'beam'", "node 4", "4 nodes"}},
      {"InvertedElement",
       [](auto& s) {
         pack(s, {0, 2, 1, 3});
       },
       {"element 0 of body 'beam'", "inverted"}},
      {"FlatElement",
       [](auto& s) {
         pack(s, {0, 1, 2, 3}, {0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0});
       },
       {"element 0 of body 'beam'", "flat"}},
      {"NanNode",
       [](auto& s) {
         pack(s, {0, 1, 2, 3}, {0, 0, 0, 1, 0, 0, 0, kNan, 0, 0, 0, 1});
       },
       {"node 2 of body 'beam'", "nan"}},
      {"InvertedElementToMakeQuadratic",
       [](auto& s) {
         pack(s, {0, 2, 1, 3});
         body(s).set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
       },
       {"element 0 of body 'beam' (nodes 0, 2, 1, 3) is inverted"}},
      {"QuadraticHexahedra",
       [](auto& s) {
         grid(s).set_shape(v1::SHAPE_HEXAHEDRON);
         body(s).set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
       },
       {"body 'beam'.element_order", "element 0 is of shape hexahedron", "32 of this kind",
        "mesh the body with tetra"}},
      {"NodeWithoutElement",
       [](auto& s) {
         pack(s, {0, 1, 2, 3}, {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 5, 5, 5});
       },
       {"node 4 of body 'beam'", "no element"}},
      {"SkinFile",
       [](auto& s) { body(s).mutable_skin()->set_file("liver.obj"); },
       {"body 'beam'.skin", "packed triangles"}},
      {"SkinOfBrokenBytes",
       [](auto& s) {
         skin(s, {0, 0, 0, 1, 0, 0, 0, 1, 0}, {0, 1, 2});
         body(s).mutable_skin()->mutable_packed()->mutable_triangles()->pop_back();
       },
       {"body 'beam'.skin.packed.triangles", "11 bytes"}},
      {"SkinIndexOutOfRange",
       [](auto& s) {
         skin(s, {0, 0, 0, 1, 0, 0, 0, 1, 0}, {0, 1, 3});
       },
       {"skin triangle 0 of body 'beam'", "vertex 3"}},
      {"SkinFarAway",
       [](auto& s) {
         skin(s, {0, 0, 0, 1, 0, 0, 0, 90, 0}, {0, 1, 2});
       },
       {"the skin of body 'beam'", "outside of the mesh"}},
  };
}

v1::Region& fixed(v1::Scene& scene) {
  body(scene).clear_fixed();
  return *body(scene).add_fixed();
}
v1::Load& load(v1::Scene& scene) {
  v1::Load& added = *body(scene).add_loads();
  added.mutable_region()->mutable_nodes()->add_indices(0);
  return added;
}

std::vector<Refusal> region_refusals() {
  return {
      {"RegionOfNoKind", [](auto& s) { fixed(s); }, {"body 'beam'.fixed[0]", "box, sphere, nodes or set"}},
      {"RegionWithoutNodes",
       [](auto& s) {
         tests::set(*fixed(s).mutable_box()->mutable_min_m(), 90, 90, 90);
         tests::set(*s.mutable_bodies(0)->mutable_fixed(0)->mutable_box()->mutable_max_m(), 91, 91, 91);
       },
       {"body 'beam'.fixed[0]", "no node", "metres"}},
      {"NanBox",
       [](auto& s) { fixed(s).mutable_box()->mutable_max_m()->set_x(kNan); },
       {"body 'beam'.fixed[0].box.max_m"}},
      {"NegativeRadius",
       [](auto& s) { fixed(s).mutable_sphere()->set_radius_m(-1); },
       {"body 'beam'.fixed[0].sphere.radius_m"}},
      {"UnknownNode",
       [](auto& s) { fixed(s).mutable_nodes()->add_indices(1'000'000); },
       {"body 'beam'.fixed[0].nodes", "1000000", "does not exist"}},
      {"LoadWithoutRegion", [](auto& s) { load(s).clear_region(); }, {"body 'beam'.loads[0].region"}},
      {"NanLoad", [](auto& s) { load(s).mutable_force_n()->set_z(kNan); }, {"body 'beam'.loads[0].force_n"}},
      {"SecondLoad",
       [](auto& s) {
         tests::set(*load(s).mutable_force_n(), 1, 0, 0);
         load(s).mutable_region()->mutable_nodes()->add_indices(1'000'000);
       },
       {"body 'beam'.loads[1].region.nodes"}},
  };
}

std::vector<Refusal> tool_refusals() {
  return {
      {"TooManyTools",
       [](auto& s) {
         while (s.tools_size() <= static_cast<int>(limits::kMaxTools)) *s.add_tools() = s.tools(0);
       },
       {"scene.tools", "kMaxTools"},
       ErrorCode::kResourceExhausted},
      {"ToolName", [](auto& s) { tool(s).set_name("probe/1"); }, {"scene.tools[0].name"}},
      {"TwoToolsOfOneName", [](auto& s) { *s.add_tools() = s.tools(0); }, {"scene.tools[1]", "'probe'", "taken"}},
      {"ToolOfNoKind", [](auto& s) { tool(s).clear_spherical_probe(); }, {"tool 'probe'", "spherical_probe, capsule"}},
      {"NoRadius", [](auto& s) { probe(s).set_radius_m(0); }, {"tool 'probe'.spherical_probe.radius_m"}},
      {"NoLength", [](auto& s) { tool(s).mutable_capsule()->set_radius_m(0.01); }, {"tool 'probe'.capsule.length_m"}},
      {"NanRadius", [](auto& s) { probe(s).set_radius_m(kNan); }, {"tool 'probe'.spherical_probe.radius_m", "nan"}},
      {"InfiniteTip",
       [](auto& s) { probe(s).mutable_tip_offset_m()->set_x(kInfinity); },
       {"tool 'probe'.spherical_probe.tip_offset_m"}},
      {"NegativePenalty",
       [](auto& s) { probe(s).set_penalty_stiffness_pa_per_m(-1); },
       {"tool 'probe'.spherical_probe.penalty_stiffness_pa_per_m"}},
      {"NoForce", [](auto& s) { tool(s).set_max_force_n(0); }, {"tool 'probe'.max_force_n", "0"}},
      {"NegativeForce", [](auto& s) { tool(s).set_max_force_n(-1); }, {"tool 'probe'.max_force_n", "-1"}},
      {"NanTorque", [](auto& s) { tool(s).set_max_torque_n_m(kNan); }, {"tool 'probe'.max_torque_n_m", "nan"}},
      {"InfiniteJointLoad", [](auto& s) { tool(s).set_max_joint_load(kInfinity); }, {"tool 'probe'.max_joint_load"}},
      {"FixedToolInAHand",
       [](auto& s) {
         tool(s).set_fixed(true);
         tool(s).set_max_force_n(10);
       },
       {"tool 'probe'", "fixed", "max_force_n"}},
      {"UnknownOnFault",
       [](auto& s) { s.mutable_guard()->set_on_fault(static_cast<v1::Guard::OnFault>(7)); },
       {"scene.guard.on_fault", "7"}},
      {"EquilibriumThatGoesOn",
       [](auto& s) {
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
         s.mutable_guard()->set_on_fault(v1::Guard::ON_FAULT_GO_ON);
       },
       {"scene.guard.on_fault", "equilibrium"}},
      {"NoSpeed", [](auto& s) { tool(s).set_max_speed_m_per_s(0); }, {"tool 'probe'.max_speed_m_per_s"}},
      {"FarTool", [](auto& s) { tool(s).mutable_position_m()->set_x(1e7); }, {"tool 'probe'.position_m", "1e+06"}},
      {"NoRotation",
       [](auto& s) { tool(s).mutable_orientation()->set_w(2); },
       {"tool 'probe'.orientation", "length 2", "normalize"}},
      {"NanRotation", [](auto& s) { tool(s).mutable_orientation()->set_w(kNan); }, {"tool 'probe'.orientation"}},
  };
}

v1::PronyTerm& prony(v1::Scene& scene, double share, double time_s) {
  v1::PronyTerm& term = *body(scene).mutable_law()->add_prony();
  term.set_share(share);
  term.set_relaxation_time_s(time_s);
  return term;
}
/// The top of the block.
void top(v1::Region& region) {
  tests::set(*region.mutable_box()->mutable_min_m(), -1, 0.05 - 1e-6, -1);
  tests::set(*region.mutable_box()->mutable_max_m(), 1, 1, 1);
}
v1::PrescribedDisplacement& drive_top(v1::Scene& scene, double y_m) {
  v1::PrescribedDisplacement& p = *body(scene).add_prescribed();
  top(*p.mutable_region());
  p.set_y_m(y_m);
  return p;
}

std::vector<Refusal> law_refusals() {
  const auto fields = [](std::size_t count, double value) { return bytes(std::vector<double>(count, value)); };
  return {
      {"NoLawNamesThoseThatAre", [](auto& s) { body(s).clear_law(); }, {"body 'beam'.law", "hooke", "hencky"}},
      {"MooneyWithoutShear",
       [](auto& s) { body(s).mutable_law()->mutable_mooney_rivlin()->set_bulk_modulus_pa(1e4); },
       {"law.mooney_rivlin.c10_pa + c01_pa"}},
      {"OgdenThatPushesApart",
       [](auto& s) {
         v1::Ogden& ogden = *body(s).mutable_law()->mutable_ogden();
         ogden.set_mu_pa(-100);
         ogden.set_alpha(3);
         ogden.set_bulk_modulus_pa(1e4);
       },
       {"law.ogden.mu_pa * alpha / 2"}},
      {"MooneyThatIsIncompressible",
       [](auto& s) {
         v1::MooneyRivlin& rubber = *body(s).mutable_law()->mutable_mooney_rivlin();
         rubber.set_c10_pa(500);
         rubber.set_bulk_modulus_pa(2.2e9);
       },
       {"body 'beam'.law.mooney_rivlin", "2.2e+09 Pa", "1000 Pa", "Poisson's ratio", "0.4999"}},
      {"OgdenOfAir",
       [](auto& s) {
         v1::Ogden& ogden = *body(s).mutable_law()->mutable_ogden();
         ogden.set_mu_pa(1000);
         ogden.set_alpha(2);
         ogden.set_bulk_modulus_pa(0.1);
       },
       {"body 'beam'.law.ogden", "Poisson's ratio", "-0.999"}},
      {"FibreWithoutDirection",
       [](auto& s) {
         v1::TransverselyIsotropic& fibres = *body(s).mutable_law()->mutable_transversely_isotropic();
         fibres.set_young_modulus_pa(1e4);
         fibres.set_fibre_modulus_pa(1e4);
       },
       {"law.transversely_isotropic.fibre_direction", "no length"}},
      {"PronyThatLeavesNothing",
       [](auto& s) {
         prony(s, 0.6, 1);
         prony(s, 0.4, 0.1);
       },
       {"body 'beam'.law.prony", "add up to 1"}},
      {"PronyWithoutTime", [](auto& s) { prony(s, 0.5, 0); }, {"law.prony[0].relaxation_time_s"}},
      {"FivePronyTerms",
       [](auto& s) {
         for (int i = 0; i < 5; ++i) prony(s, 0.1, 1);
       },
       {"law.prony", "kMaxPronyTerms is 4"}},
      {"LawOfNoElement",
       [](auto& s) {
         v1::LawRegion& part = *body(s).add_law_regions();
         part.mutable_region()->mutable_nodes()->add_indices(0);
         *part.mutable_law() = body(s).law();
       },
       {"body 'beam'.law_regions[0].region", "no element"}},
      {"LawOfARegion",
       [](auto& s) {
         v1::LawRegion& part = *body(s).add_law_regions();
         part.mutable_region()->mutable_sphere()->set_radius_m(10);
         part.mutable_law()->mutable_hooke()->set_young_modulus_pa(-1);
       },
       {"body 'beam'.law_regions[0].law.hooke.young_modulus_pa"}},
      {"FieldCutShort",
       [=](auto& s) { body(s).mutable_element_fields()->set_young_modulus_pa(fields(3, 1e4)); },
       {"body 'beam'.element_fields.young_modulus_pa", "3 values for 192 elements"}},
      {"NanField",
       [=](auto& s) { body(s).mutable_element_fields()->set_poisson_ratio(fields(192, kNan)); },
       {"body 'beam'.element_fields.poisson_ratio", "element 0", "not finite"}},
      {"FieldOutOfRange",
       [=](auto& s) { body(s).mutable_element_fields()->set_poisson_ratio(fields(192, 0.5)); },
       {"body 'beam'.element_fields, element 0", "poisson_ratio"}},
      {"NanModulusUnderAField",
       [=](auto& s) {
         body(s).mutable_law()->mutable_st_venant_kirchhoff()->set_young_modulus_pa(kNan);
         body(s).mutable_element_fields()->set_young_modulus_pa(fields(192, 1e4));
       },
       {"st_venant_kirchhoff.young_modulus_pa", "not finite"}},
      {"NanFibreUnderAField",
       [=](auto& s) {
         v1::TransverselyIsotropic& law = *body(s).mutable_law()->mutable_transversely_isotropic();
         law.set_young_modulus_pa(1e4);
         law.set_poisson_ratio(0.4);
         law.mutable_fibre_direction()->set_z(kNan);
         body(s).mutable_element_fields()->set_fibre_directions(fields(3 * 192, 1));
       },
       {"transversely_isotropic.fibre_direction", "not finite"}},
      {"FieldThatTheLawLacks",
       [=](auto& s) { body(s).mutable_element_fields()->set_fibre_directions(fields(3 * 192, 1)); },
       {"st_venant_kirchhoff", "no fibre_direction"}},
      {"UnknownQuadrature",
       [](auto& s) { body(s).set_quadrature(static_cast<v1::Quadrature>(9)); },
       {"body 'beam'.quadrature", "9"}},
      {"UnknownElementOrder",
       [](auto& s) { body(s).set_element_order(static_cast<v1::ElementOrder>(9)); },
       {"body 'beam'.element_order", "9", "unknown"}},
      {"UnknownMass", [](auto& s) { body(s).set_mass(static_cast<v1::Mass>(9)); }, {"body 'beam'.mass", "9"}},
      {"UnknownShape",
       [](auto& s) { grid(s).set_shape(static_cast<v1::Shape>(9)); },
       {"body 'beam'.mesh.grid.shape", "9"}},
  };
}

v1::Load& press_top(v1::Scene& scene, double pressure_pa) {
  v1::Load& load = *body(scene).add_loads();
  top(*load.mutable_region());
  load.set_pressure_pa(pressure_pa);
  return load;
}

std::vector<Refusal> support_refusals() {
  return {
      {"UnknownSet", [](auto& s) { body(s).add_fixed()->set_set("nobody"); }, {"body 'beam'.fixed[1].set", "nobody"}},
      {"TwoSetsOfOneName",
       [](auto& s) {
         for (int i = 0; i < 2; ++i) {
           v1::NamedSet& set = *body(s).add_sets();
           set.set_name("top");
           top(*set.add_regions());
         }
       },
       {"body 'beam'.sets[1]", "'top' is taken"}},
      {"SetOfTooManyRegions",
       [](auto& s) {
         v1::NamedSet& set = *body(s).add_sets();
         set.set_name("all");
         for (std::size_t i = 0; i <= limits::kMaxRegionsOfSet; ++i) set.add_regions()->mutable_nodes()->add_indices(0);
       },
       {"body 'beam'.sets[0].regions", "kMaxRegionsOfSet"},
       ErrorCode::kResourceExhausted},
      {"SetOfNothing", [](auto& s) { body(s).add_sets()->set_name("top"); }, {"body 'beam'.sets[0]", "no region"}},
      {"DrivenNowhere", [](auto& s) { drive_top(s, 0).clear_y_m(); }, {"body 'beam'.prescribed[0]", "x_m, y_m or z_m"}},
      {"DrivenToTwoPlaces",
       [](auto& s) {
         drive_top(s, 0.01);
         drive_top(s, 0.02);
       },
       {"body 'beam'.prescribed[1]", "two prescribed displacements in y"}},
      {"NanDrive", [](auto& s) { drive_top(s, kNan); }, {"body 'beam'.prescribed[0]", "nan"}},
      {"ScheduleOfUnequalLengths",
       [](auto& s) { drive_top(s, 0.01).mutable_schedule()->add_time_s(1); },
       {"body 'beam'.prescribed[0].schedule", "1 times and 0 factors"}},
      {"ScheduleThatGoesBack",
       [](auto& s) {
         v1::Schedule& schedule = *drive_top(s, 0.01).mutable_schedule();
         for (const double time : {1.0, 1.0}) {
           schedule.add_time_s(time);
           schedule.add_factor(1);
         }
       },
       {"body 'beam'.prescribed[0].schedule.time_s[1]", "does not come after"}},
      {"LoadScheduleOfUnequalLengths",
       [](auto& s) { press_top(s, 1).mutable_schedule()->add_factor(1); },
       {"body 'beam'.loads[0].schedule", "0 times and 1 factors"}},
      {"PressureScheduleThatGoesBack",
       [](auto& s) {
         v1::Schedule& schedule = *press_top(s, 1).mutable_schedule();
         for (const double time : {2.0, 1.0}) schedule.add_time_s(time);
         for (int i = 0; i < 2; ++i) schedule.add_factor(1);
       },
       {"body 'beam'.loads[0].schedule.time_s[1]", "1 does not come after 2"}},
      {"NanGravityFactor",
       [](auto& s) {
         s.mutable_gravity_schedule()->add_time_s(0);
         s.mutable_gravity_schedule()->add_factor(kNan);
       },
       {"scene.gravity_schedule.factor[0]", "nan"}},
      {"ScheduleWithoutGravity",
       [](auto& s) {
         s.clear_gravity_m_per_s2();
         s.mutable_gravity_schedule();
       },
       {"scene.gravity_schedule", "no gravity", "gravity_m_per_s2"}},
      {"TractionOnNoFace",
       [](auto& s) {
         v1::Load& load = *body(s).add_loads();
         load.mutable_region()->mutable_nodes()->add_indices(0);
         tests::set(*load.mutable_traction_pa(), 1, 0, 0);
       },
       {"body 'beam'.loads[0].region", "no whole face"}},
      {"NanPressure", [](auto& s) { press_top(s, kNan); }, {"body 'beam'.loads[0].pressure_pa", "nan"}},
      {"HugePressure", [](auto& s) { press_top(s, 1e13); }, {"body 'beam'.loads[0].pressure_pa", "1e+12"}},
      {"UnknownIntegrator",
       [](auto& s) { s.mutable_solver()->set_integrator(static_cast<v1::Solver::Integrator>(9)); },
       {"scene.solver.integrator", "9"}},
      {"NoNewtonIteration",
       [](auto& s) { s.mutable_solver()->set_newton_max_iterations(0); },
       {"scene.solver.newton_max_iterations"}},
      {"NoLagStep", [](auto& s) { lag(s, 0, 1); }, {"scene.solver.tangent_lag_steps", "[1, 64]"}},
      {"NanLagStrain", [](auto& s) { lag(s, 8, kNan); }, {"scene.solver.tangent_lag_strain", "nan"}},
      {"StrainWithoutLag", [](auto& s) { s.mutable_solver()->set_tangent_lag_strain(1); }, {"tangent_lag_steps"}},
      {"LagOfNewtonsMethod",
       [](auto& s) { lag(s, 8, 1), s.mutable_solver()->set_newton_max_iterations(2); },
       {"scene.solver.tangent_lag_steps", "newton_max_iterations: 1"}},
      {"NanNewtonTolerance",
       [](auto& s) { s.mutable_solver()->set_newton_tolerance(kNan); },
       {"scene.solver.newton_tolerance"}},
  };
}

/// The block has 5 × 3 × 5 nodes; node 0 is fixed.
std::vector<Refusal> start_refusals() {
  const auto start = [](std::size_t count, double value) { return bytes(std::vector<double>(count, value)); };
  return {
      {"StartCutShort",
       [=](auto& s) { body(s).set_initial_displacement_m(start(9, 0)); },
       {"body 'beam'.initial_displacement_m", "9 values for 75 nodes"}},
      {"StartInHalfABlock",
       [=](auto& s) { body(s).set_initial_velocity_m_per_s(std::string(25, 0)); },
       {"body 'beam'.initial_velocity_m_per_s", "25 bytes", "multiple of 24"}},
      {"NanStart",
       [=](auto& s) { body(s).set_initial_displacement_m(start(225, kNan)); },
       {"body 'beam'.initial_displacement_m, node 0", "nan"}},
      {"FarStart",
       [=](auto& s) { body(s).set_initial_velocity_m_per_s(start(225, 1e7)); },
       {"body 'beam'.initial_velocity_m_per_s, node 0", "1e+06"}},
      {"FixedNodeThatStartsElsewhere",
       [=](auto& s) { body(s).set_initial_velocity_m_per_s(start(225, 1)); },
       {"body 'beam'.initial_velocity_m_per_s, node 0", "is fixed"}},
      {"StartOfNeitherTheMeshNorItsQuadraticElements",
       [=](auto& s) {
         body(s).set_element_order(v1::ELEMENT_ORDER_QUADRATIC);
         body(s).set_initial_displacement_m(start(228, 0));
       },
       {"body 'beam'.initial_displacement_m", "228 values for 405 nodes", "the 75 of the mesh before element_order"}},
      {"VelocityWithoutInertia",
       [=](auto& s) {
         s.mutable_solver()->set_integrator(v1::Solver::INTEGRATOR_QUASI_STATIC);
         body(s).set_initial_velocity_m_per_s(start(225, 0));
       },
       {"body 'beam'.initial_velocity_m_per_s", "quasi-static"}},
  };
}

std::vector<Refusal> all_refusals() {
  std::vector<Refusal> all;
  for (auto refusals : {header_refusals(), body_refusals(), mesh_refusals(), region_refusals(), tool_refusals(),
                        law_refusals(), support_refusals(), start_refusals()}) {
    all.insert(all.end(), refusals.begin(), refusals.end());
  }
  return all;
}

class Refused : public testing::TestWithParam<Refusal> {};

TEST_P(Refused, WithItsPlaceAndItsReason) { expect_refused(GetParam()); }

INSTANTIATE_TEST_SUITE_P(Scenes, Refused, testing::ValuesIn(all_refusals()),
                         [](const auto& one) { return one.param.name; });

TEST(Admitted, TheSceneThatTheRefusalsSpoil) {
  const auto model = compile(admitted_scene(), {});
  EXPECT_TRUE(model) << model.error().message;
}

}  // namespace
}  // namespace tensormass::model
