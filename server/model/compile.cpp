#include "model/compile.h"

#include <algorithm>
#include <cmath>
#include <set>

#include <fmt/format.h>

#include "core/limits.h"
#include "mesh/admission.h"
#include "mesh/shapes.h"
#include "model/compile_parts.h"
#include "model/scene_input.h"
#include "model/wedge_pairs.h"

namespace tensormass::model {

namespace {

/// Compiles one scene; the model grows step by step.
class Compiler {
 public:
  Compiler(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress)
      : c_{scene, {}, {}, {}, {}, {}}, policy_(policy), progress_(progress) {}

  Result<Model> run() {
    TM_RETURN_IF_ERROR(read_header());
    TM_RETURN_IF_ERROR(read_bodies());
    TM_RETURN_IF_ERROR(read_tools());
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kOrderNodes));
    make_wedge_pairs(c_);
    make_layout();
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kBoundaryConditions));
    TM_RETURN_IF_ERROR(fill_row_fields(c_));
    TM_RETURN_IF_ERROR(fill_boundary_conditions(c_));
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kElements));
    TM_RETURN_IF_ERROR(group_elements(c_));
    TM_RETURN_IF_ERROR(list_elements_of_rows(c_));
    equip_solve(c_, policy_);
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kSurfaces));
    if (!model_.tools.empty()) make_contact_surface(c_);
    if (model_.frame_rate_hz > 0) {
      TM_RETURN_IF_ERROR(make_visible_surface(c_));
    }
    warn_of_loose_bodies();
    return std::move(model_);
  }

 private:
  /// The pairs count as elements here only: the matrix couples all nodes of a pair.
  void make_layout() {
    merged_.blocks.push_back(wedge_pair_block(c_));
    const auto nodes = static_cast<std::uint32_t>(merged_.nodes.size());
    model_.layout = matrix::make_layout(merged_, policy_.count(nodes), policy_.storage_of(nodes));
    merged_.blocks.pop_back();
  }

  Result<void> read_header() {
    TM_RETURN_IF_ERROR(check_name(scene_.name(), "scene.name"));
    model_.name = scene_.name();
    const v1::Stepping& stepping = scene_.stepping();
    TM_ASSIGN_OR_RETURN(dt, read_number(stepping.has_dt_s() ? stepping.dt_s() : 1.0 / 60, limits::kMinTimeStepS,
                                        limits::kMaxTimeStepS, "scene.stepping.dt_s"));
    model_.dt_s = dt;
    TM_ASSIGN_OR_RETURN(rate,
                        read_number(stepping.has_rate_hz() ? stepping.rate_hz() : std::min(1 / dt, limits::kMaxRateHz),
                                    limits::kMinRateHz, limits::kMaxRateHz, "scene.stepping.rate_hz"));
    model_.rate_hz = rate;
    model_.lockstep = stepping.lockstep();

    const v1::Solver& solver = scene_.solver();
    switch (solver.precision()) {
      case v1::Solver::PRECISION_UNSPECIFIED:
      case v1::Solver::PRECISION_FLOAT:
        break;
      case v1::Solver::PRECISION_DOUBLE:
        model_.double_precision = true;
        break;
      default:
        return invalid(fmt::format("scene.solver.precision: {} is unknown", static_cast<int>(solver.precision())));
    }
    TM_RETURN_IF_ERROR(read_integrator(solver));
    // Without inertia the matrix is far worse conditioned, and nobody waits for a step by the clock.
    const bool quasi_static = model_.integrator == Integrator::kQuasiStatic;
    TM_ASSIGN_OR_RETURN(iterations, read_number(solver.has_cg_max_iterations() ? solver.cg_max_iterations()
                                                : quasi_static                 ? 10'000
                                                                               : 100,
                                                1, limits::kMaxCgIterations, "scene.solver.cg_max_iterations"));
    model_.cg_max_iterations = static_cast<std::uint32_t>(iterations);
    TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_cg_tolerance() ? solver.cg_tolerance() : 1e-3, 0, 0.5,
                                               "scene.solver.cg_tolerance"));
    model_.cg_tolerance = tolerance;
    TM_RETURN_IF_ERROR(read_budget(solver));
    if (solver.has_cpu_threads()) {
      TM_RETURN_IF_ERROR(read_number(solver.cpu_threads(), 1, limits::kMaxCpuThreads, "scene.solver.cpu_threads"));
    }

    const v1::Streams& streams = scene_.streams();
    TM_ASSIGN_OR_RETURN(
        frames, read_rate(streams.has_frame_rate_hz() ? streams.frame_rate_hz() : 60, "scene.streams.frame_rate_hz"));
    model_.frame_rate_hz = frames;
    TM_ASSIGN_OR_RETURN(
        status, read_rate(streams.has_status_rate_hz() ? streams.status_rate_hz() : 4, "scene.streams.status_rate_hz"));
    model_.status_rate_hz = status;

    TM_ASSIGN_OR_RETURN(gravity, read_vector(scene_.gravity_m_per_s2(), "scene.gravity_m_per_s2"));
    model_.gravity_m_per_s2 = gravity;
    model_.has_gravity = gravity.squaredNorm() > 0;
    return {};
  }

  /// What a step may take and what it must not fall below: an accuracy is given up only down to a stated floor.
  Result<void> read_budget(const v1::Solver& solver) {
    if (solver.has_floor_tolerance()) {
      TM_ASSIGN_OR_RETURN(floor, read_number(solver.floor_tolerance(), 1e-12, 0.5, "scene.solver.floor_tolerance"));
      if (floor < model_.cg_tolerance) {
        return invalid(
            fmt::format("scene.solver.floor_tolerance: {} is below cg_tolerance = {}, at which the solve "
                        "stops; lower cg_tolerance",
                        floor, model_.cg_tolerance));
      }
      model_.floor_tolerance = floor;
    }
    if (!solver.has_budget_s()) {
      if (!solver.has_floor_cg_iterations()) return {};
      return invalid("scene.solver.floor_cg_iterations: nothing lowers the iterations; give budget_s too");
    }
    TM_ASSIGN_OR_RETURN(
        budget, read_number(solver.budget_s(), limits::kMinBudgetS, limits::kMaxBudgetS, "scene.solver.budget_s"));
    if (!solver.has_floor_cg_iterations() && !solver.has_floor_tolerance()) {
      return invalid(
          "scene.solver.budget_s: say how far accuracy may go down for it: give floor_cg_iterations, floor_tolerance "
          "or both");
    }
    const double fewest = solver.has_floor_cg_iterations() ? solver.floor_cg_iterations() : 1;
    TM_ASSIGN_OR_RETURN(floor, read_number(fewest, 1, model_.cg_max_iterations, "scene.solver.floor_cg_iterations"));
    model_.budget_s = budget;
    model_.floor_cg_iterations = static_cast<std::uint32_t>(floor);
    return {};
  }

  Result<void> read_integrator(const v1::Solver& solver) {
    switch (solver.integrator()) {
      case v1::Solver::INTEGRATOR_UNSPECIFIED:
      case v1::Solver::INTEGRATOR_IMPLICIT_EULER:
        model_.integrator = Integrator::kImplicitEuler;
        break;
      case v1::Solver::INTEGRATOR_BDF2:
        model_.integrator = Integrator::kBdf2;
        break;
      case v1::Solver::INTEGRATOR_QUASI_STATIC:
        model_.integrator = Integrator::kQuasiStatic;
        break;
      default:
        return invalid(fmt::format("scene.solver.integrator: {} is unknown", static_cast<int>(solver.integrator())));
    }
    const std::uint32_t otherwise = model_.integrator == Integrator::kQuasiStatic ? 50 : 1;
    TM_ASSIGN_OR_RETURN(iterations,
                        read_number(solver.has_newton_max_iterations() ? solver.newton_max_iterations() : otherwise, 1,
                                    limits::kMaxNewtonIterations, "scene.solver.newton_max_iterations"));
    model_.newton_max_iterations = static_cast<std::uint32_t>(iterations);
    TM_ASSIGN_OR_RETURN(tolerance, read_number(solver.has_newton_tolerance() ? solver.newton_tolerance()
                                               : model_.double_precision     ? 1e-6
                                                                             : 1e-3,
                                               0, 0.5, "scene.solver.newton_tolerance"));
    model_.newton_tolerance = tolerance;
    return {};
  }

  Result<void> read_bodies() {
    if (scene_.bodies().empty()) return invalid("scene.bodies: a scene needs at least one body");
    if (static_cast<std::size_t>(scene_.bodies_size()) > limits::kMaxBodies) {
      return fail(ErrorCode::kResourceExhausted, fmt::format("scene.bodies: {} exceed limits::kMaxBodies = {}",
                                                             scene_.bodies_size(), limits::kMaxBodies));
    }
    std::set<std::string> names;
    for (int i = 0; i < scene_.bodies_size(); ++i) {
      const v1::Body& body = scene_.bodies(i);
      TM_RETURN_IF_ERROR(check_name(body.name(), fmt::format("scene.bodies[{}].name", i)));
      if (!names.insert(body.name()).second) {
        return invalid(fmt::format("scene.bodies[{}]: the name '{}' is taken by another body", i, body.name()));
      }
      TM_RETURN_IF_ERROR(read_body(body, static_cast<std::size_t>(i)));
    }
    return {};
  }

  Result<void> read_body(const v1::Body& body, std::size_t index) {
    const auto body_count = static_cast<std::size_t>(scene_.bodies_size());
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kReadMesh, index, body_count));
    const std::string where = fmt::format("body '{}'", body.name());
    TM_RETURN_IF_ERROR(check_counts(body, where));
    TM_ASSIGN_OR_RETURN(mesh, read_mesh(body, where));
    const std::uint64_t nodes = merged_.nodes.size() + mesh.nodes.size();
    const std::uint64_t elements = std::uint64_t{mesh::element_count(merged_)} + mesh::element_count(mesh);
    if (nodes > limits::kMaxNodes || elements > limits::kMaxElements) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("{}: the scene would have {} nodes and {} elements; limits::kMaxNodes = {}, "
                              "limits::kMaxElements = {}",
                              where, nodes, elements, limits::kMaxNodes, limits::kMaxElements));
    }
    TM_RETURN_IF_ERROR(progress_.begin(LoadPart::kCheckMesh, index, body_count));
    TM_ASSIGN_OR_RETURN(report, mesh::admit(mesh, body.name()));
    TM_ASSIGN_OR_RETURN(density, read_number(body.density_kg_per_m3(), 1e-3, 1e6, where + ".density_kg_per_m3"));

    BodyModel out;
    out.name = body.name();
    out.node_begin = static_cast<std::uint32_t>(merged_.nodes.size());
    out.node_count = report.node_count;
    out.element_begin = mesh::element_count(merged_);
    out.element_count = report.element_count;
    out.component_count = report.component_count;
    out.volume_m3 = report.volume_m3;
    out.mass_kg = report.volume_m3 * density;
    out.min_dihedral_angle_deg = report.min_dihedral_angle_deg;
    model_.warnings.insert(model_.warnings.end(), report.warnings.begin(), report.warnings.end());
    if (body.has_color_srgb()) {
      const v1::Vector3& color = body.color_srgb();
      for (const double component : {color.x(), color.y(), color.z()}) {
        TM_RETURN_IF_ERROR(read_number(component, 0, 1, where + ".color_srgb"));
      }
      out.has_color = true;
      out.color_srgb = {color.x(), color.y(), color.z()};
    }

    merged_.nodes.insert(merged_.nodes.end(), mesh.nodes.begin(), mesh.nodes.end());
    for (const mesh::ElementBlock& block : mesh.blocks) {
      mesh::ElementBlock shifted = block;
      for (std::uint32_t& node : shifted.nodes) node += out.node_begin;
      merged_.blocks.push_back(std::move(shifted));
      c_.block_bodies.push_back(bodies_.size());
    }
    model_.bodies.push_back(std::move(out));

    ReadBody read;
    read.mesh = std::move(mesh);
    read.density_kg_per_m3 = density;
    TM_RETURN_IF_ERROR(read_quadrature(body, read, where));
    TM_RETURN_IF_ERROR(read_materials(body, read, where));
    bodies_.push_back(std::move(read));
    return {};
  }

  static Result<void> check_counts(const v1::Body& body, std::string_view where) {
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

  Result<void> read_quadrature(const v1::Body& body, ReadBody& out, std::string_view where) {
    switch (body.quadrature()) {
      case v1::QUADRATURE_UNSPECIFIED:
      case v1::QUADRATURE_FULL:
        break;
      case v1::QUADRATURE_REDUCED:
        out.quadrature = physics::Quadrature::kReduced;
        model_.warnings.push_back(fmt::format(
            "{}: reduced quadrature is blind to the bending modes of an element; a mesh may move in zigzag at no cost",
            where));
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

  /// The stiffest material of the scene, which contact must not give way to.
  const Material& stiffest() const {
    const Material* found = &bodies_.front().materials.front();
    for (const ReadBody& body : bodies_) {
      for (const Material& material : body.materials) {
        if (material.young_modulus_pa > found->young_modulus_pa) found = &material;
      }
    }
    return *found;
  }

  Result<void> read_tools() {
    if (static_cast<std::size_t>(scene_.tools_size()) > limits::kMaxTools) {
      return fail(ErrorCode::kResourceExhausted,
                  fmt::format("scene.tools: {} exceed limits::kMaxTools = {}", scene_.tools_size(), limits::kMaxTools));
    }
    const Material& stiffest = this->stiffest();
    std::set<std::string> names;
    for (int i = 0; i < scene_.tools_size(); ++i) {
      const v1::Tool& tool = scene_.tools(i);
      TM_RETURN_IF_ERROR(check_name(tool.name(), fmt::format("scene.tools[{}].name", i)));
      if (!names.insert(tool.name()).second) {
        return invalid(fmt::format("scene.tools[{}]: the name '{}' is taken by another tool", i, tool.name()));
      }
      const std::string where = fmt::format("tool '{}'", tool.name());
      if (tool.kind_case() != v1::Tool::kSphericalProbe) {
        return invalid(fmt::format("{}: no kind that this server knows; give spherical_probe", where));
      }
      const v1::SphericalProbe& probe = tool.spherical_probe();
      ToolModel out;
      out.name = tool.name();
      TM_ASSIGN_OR_RETURN(radius, read_number(probe.radius_m(), 1e-6, 1e3, where + ".spherical_probe.radius_m"));
      out.radius_m = radius;
      TM_ASSIGN_OR_RETURN(tip, read_vector(probe.tip_offset_m(), where + ".spherical_probe.tip_offset_m"));
      out.tip_offset_m = tip;
      const double default_penalty = 20 * stiffest.young_modulus_pa / radius;
      TM_ASSIGN_OR_RETURN(
          penalty,
          read_number(probe.has_penalty_stiffness_pa_per_m() ? probe.penalty_stiffness_pa_per_m() : default_penalty,
                      1e-3, 1e18, where + ".spherical_probe.penalty_stiffness_pa_per_m"));
      out.penalty_pa_per_m = penalty;
      TM_ASSIGN_OR_RETURN(speed, read_number(tool.has_max_speed_m_per_s() ? tool.max_speed_m_per_s() : 0.5, 1e-6, 1e3,
                                             where + ".max_speed_m_per_s"));
      out.max_speed_m_per_s = speed;
      out.plane_strain_modulus_pa = stiffest.young_modulus_pa / (1 - stiffest.poisson_ratio * stiffest.poisson_ratio);
      TM_ASSIGN_OR_RETURN(position, read_vector(tool.position_m(), where + ".position_m"));
      out.initial_position_m = position;
      TM_ASSIGN_OR_RETURN(orientation, read_orientation(tool.orientation(), where + ".orientation"));
      out.initial_orientation = orientation;
      model_.tools.push_back(std::move(out));
    }
    return {};
  }

  /// An equilibrium of a body that nothing holds is one of many, or none.
  void warn_of_loose_bodies() {
    if (model_.integrator != Integrator::kQuasiStatic) return;
    for (const BodyModel& body : model_.bodies) {
      if (body.fixed_node_count > 0) continue;
      model_.warnings.push_back(fmt::format(
          "body '{}': nothing holds it, and a quasi-static step knows no inertia; give fixed or prescribed nodes",
          body.name));
    }
  }

  Compilation c_;
  const PatchPolicy policy_;
  const Progress& progress_;
  const v1::Scene& scene_ = c_.scene;
  Model& model_ = c_.model;
  mesh::Mesh& merged_ = c_.merged;
  std::vector<ReadBody>& bodies_ = c_.bodies;
};

}  // namespace

std::uint32_t PatchPolicy::count(std::uint32_t node_count) const {
  const std::uint32_t most = node_count / std::max(min_nodes_per_patch, 1u);
  const std::uint32_t least = (node_count - 1) / max_nodes_per_patch + 1;
  return std::clamp(std::max(std::min(most, usual_patches), least), 1u, std::max(max_patches, 1u));
}

matrix::Storage PatchPolicy::storage_of(std::uint32_t node_count) const {
  const bool tiles = storage == matrix::Storage::kRows && (node_count - 1) / count(node_count) >= tiles_beyond_nodes;
  return tiles ? matrix::Storage::kTiles : storage;
}

Result<Model> compile(const v1::Scene& scene, const PatchPolicy& policy, const Progress& progress) {
  return Compiler(scene, policy, progress).run();
}

std::uint32_t requested_cpu_threads(const v1::Scene& scene, std::uint32_t otherwise) {
  return scene.solver().has_cpu_threads() ? scene.solver().cpu_threads() : otherwise;
}

}  // namespace tensormass::model
