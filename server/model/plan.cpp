#include "model/plan.h"

#include <algorithm>
#include <numeric>

#include <fmt/format.h>

#include "model/bind.h"
#include "physics/lists.h"
#include "tensor/packed_block.h"

namespace tensormass::model {

namespace {

/// An arena that only writes down what it is asked for.
class CountingArena {
 public:
  explicit CountingArena(v1::SceneReport& report) : report_(report) {}

  template <class T, class U>
  const T* constant(std::string_view name, const std::vector<U>& items) {
    return zeros<T>(name, items.size());
  }
  template <class T, class Fill>
  const T* generated(std::string_view name, std::size_t count, const Fill&) {
    return zeros<T>(name, count);
  }
  template <class T>
  T* zeros(std::string_view name, std::size_t count) {
    if (count == 0) return nullptr;
    v1::PlanBuffer& buffer = *report_.add_buffers();
    buffer.set_name(std::string(name));
    buffer.set_bytes(count * sizeof(T));
    report_.set_bytes_total(report_.bytes_total() + count * sizeof(T));
    return nullptr;
  }

 private:
  v1::SceneReport& report_;
};

struct Cost {
  double bytes = 0, operations = 0;
};

/// Counted from the stage's own loops: what it must move at least, and its floating-point operations.
Cost cost(const Model& m, const Stage& stage) {
  const double real = m.double_precision ? 8 : 4;
  const double rows = m.layout.row_count, slots = m.layout.slot_count();
  const double tools = static_cast<double>(m.tools.size()), triangles = m.contact.triangle_count();
  const double incidences = static_cast<double>(m.contact.incidence.size()) / 4;
  const bool constant = !m.constant_edges.empty(), edges = m.layout.storage == tensor::Storage::kEdges;
  switch (stage.kind) {
    case StageKind::kPredict:
      return {rows * 7 * 4 * real, rows * 12};
    case StageKind::kDrive: {
      const double driven = static_cast<double>(m.driven.driven.size()) / 3;
      return {driven * (12 + 9 * real), driven * 6};
    }
    case StageKind::kDetectContact:
    case StageKind::kRespondContact:
      return {tools * triangles * (12 + 3 * 8 * real), tools * triangles * 60};
    case StageKind::kElements: {
      const ElementGroup& g = m.groups[stage.group];
      const double history = static_cast<double>(g.history_reals());
      const double rest = (static_cast<double>(g.rest.size() + g.parameters.size()) + 2 * history) * real;
      // Of StVK: about 120 for the stress of a point and 60 for each node, then 60 for each block.
      const double nodes = static_cast<double>(g.rows.size()) / g.stride, points = g.stride * g.point_count;
      if (!edges) {  // every node's row evaluates the element and its own blocks; if caches hold, it is read once
        const double lists = static_cast<double>(g.row_lists.listed.size() + g.row_lists.places.size()) * 4;
        const double decompositions =
            physics::decomposes(g.law) ? 2 * points * tensor::kDecompositionReals * real : 0;  // written and read
        return {rest + lists + decompositions + slots * (9 * real + 4) + rows * (6 * 4 + 8) * real,
                nodes * points * (120 + 60 * nodes + 60 * (nodes - 1))};
      }
      const double elements =
          static_cast<double>(g.rows.size()) * (4 + 4 * real) + rest + static_cast<double>(g.pair_places.size()) * 4;
      // The matrix and the right-hand side are read and written, too.
      return {elements + (slots * 9 + rows * (8 + 4)) * 2 * real, points * (120 + 30 * nodes + 30 * nodes * nodes)};
    }
    case StageKind::kAssemble:
      if (edges)
        return {slots * 9 * real * (constant ? 2 : 1) + rows * (3 * 4 + 8) * real, slots * (constant ? 90 : 0)};
      return {slots * (9 * real * (constant ? 2 : 1) + 4) + rows * (4 * 4 + 8) * real,
              slots * (constant ? 54 : 36) + rows * 60};
    case StageKind::kExternalForces:
      return {rows * 12 * real, rows * 6};
    case StageKind::kPressure: {
      const double corners = static_cast<double>(m.pressure.pressed_corners.size()) / 2;
      return {corners * (36 + 4 * 8 * real), corners * 300};
    }
    case StageKind::kAssembleContact:
      return {tools * incidences * (16 + 9 * real), tools * incidences * 4};
    case StageKind::kMeasureResidual:
      return {rows * 4 * 4 * real, rows * 24};
    case StageKind::kFactorize:
      return {rows * 2 * 12 * real, rows * 60};
    case StageKind::kScaleEdges:
      return {slots * (2 * 9 * real + 4), slots * 90};
    case StageKind::kSolve: {
      const Cost whole{slots * (9 * real + 4) + rows * 9 * 4 * real, slots * (edges ? 36 : 18) + rows * 36};
      if (m.double_precision || m.layout.storage != tensor::Storage::kTiles) return whole;
      // Tiles stream in single precision: some blocks, packed, and beside each a column, mostly of 16 bits.
      const double slot = sizeof(tensor::PackedBlock) + sizeof(std::uint16_t), row = sizeof(tensor::PackedDiagonal);
      return {m.layout.read_slot_count() * slot + rows * (row + 9 * 4 * real), whole.operations};
    }
    case StageKind::kAdvance:
      return {rows * (edges && m.checks_volume() ? 11 : 9) * 4 * real, rows * 50};
    case StageKind::kBacktrack:
      return {rows * 5 * 4 * real, rows * 12};
    case StageKind::kMeasureContact:
      return {tools * triangles * real, tools * triangles};
    case StageKind::kCheckVolume: {
      const ElementGroup& g = m.groups[stage.group];
      // From where nodes are: one field where packs of elements are checked, two else.
      return {static_cast<double>(g.rows.size()) * (4 + (edges ? 4 : 8) * real),
              g.element_count * g.point_count * 80.0};
    }
    case StageKind::kWatch: {
      const ElementGroup& g = m.groups[stage.group];
      return {static_cast<double>(g.rows.size()) * (4 + 4 * real) + static_cast<double>(g.rest.size()) * real,
              g.element_count * g.point_count * 600.0};
    }
  }
  return {};
}

template <class Real>
void bind_all(const Model& model, CountingArena& arena) {
  bind<Real>(model, arena);
  for (std::size_t group = 0; group < model.groups.size(); ++group) bind<Real>(model, group, arena);
}

void list_not_modelled(const Model& m, v1::SceneReport& report) {
  if (m.tools.empty())
    report.add_not_modelled("contact with tools: the scene has none; no contact stage, no contact buffer");
  if (m.bodies.size() > 1) report.add_not_modelled("contact between bodies: they pass through each other");
  report.add_not_modelled("self-contact of a body");
  if (!m.tools.empty()) report.add_not_modelled("friction between tools and tissue");
  if (m.external.empty() && m.pressure.faces.empty())
    report.add_not_modelled("gravity and loads: the scene names none");
  bool damped = false;
  for (std::size_t row = 0; row < m.layout.row_count; ++row) {
    damped = damped || m.inertia[4 * row + 1] != 0 || m.inertia[4 * row + 2] != 0;
  }
  if (m.integrator == Integrator::kQuasiStatic) {
    report.add_not_modelled("inertia and damping: each step is an equilibrium");
  } else if (!damped) {
    report.add_not_modelled(fmt::format("Rayleigh damping: the scene names none; {} damps by itself",
                                        m.integrator == Integrator::kBdf2 ? "BDF2 hardly" : "implicit Euler"));
  }
  if (std::all_of(m.groups.begin(), m.groups.end(), [](const ElementGroup& g) { return g.prony.empty(); })) {
    report.add_not_modelled("viscosity: no law has prony terms");
  }
  if (!m.pressure.faces.empty()) {
    report.add_not_modelled("the stiffness of pressure: its forces follow the surface, its derivative is left out");
  }
  report.add_not_modelled("plasticity, cutting and tearing");
  if (m.frame_rate_hz == 0) report.add_not_modelled("frames: frame_rate_hz is 0; no surface is gathered");
}

}  // namespace

StageText text(StageKind kind) {
  switch (kind) {
    case StageKind::kPredict:
      return {"predict", "displacement, velocity", "base displacement and velocity"};
    case StageKind::kDrive:
      return {"drive", "prescribed displacements", "velocity of driven nodes"};
    case StageKind::kDetectContact:
      return {"detect contact", "displacement, tools", "closest triangle of each patch"};
    case StageKind::kRespondContact:
      return {"respond to contact", "displacement, tools, closest", "contacts"};
    case StageKind::kElements:
      return {"element tensors", "displacement, rest shapes", "forces and tensors of each element"};
    case StageKind::kAssemble:
      return {"assemble", "element and constant tensors, velocity", "matrix, right-hand side"};
    case StageKind::kExternalForces:
      return {"external forces", "gravity and loads", "right-hand side"};
    case StageKind::kPressure:
      return {"pressure", "displacement, pressure faces", "right-hand side"};
    case StageKind::kAssembleContact:
      return {"assemble contact", "contacts, velocity", "matrix, right-hand side"};
    case StageKind::kMeasureResidual:
      return {"measure imbalance", "right-hand side, forces", "imbalance of each patch"};
    case StageKind::kFactorize:
      return {"factorize diagonal", "matrix diagonal", "inverse Cholesky factors, right-hand side"};
    case StageKind::kScaleEdges:
      return {"scale matrix", "matrix, inverse factors", "matrix"};
    case StageKind::kSolve:
      return {"conjugate gradients", "matrix, right-hand side", "solution"};
    case StageKind::kAdvance:
      return {"advance", "solution", "velocity, displacement, kept state, what guards look at"};
    case StageKind::kBacktrack:
      return {"backtrack", "increment", "velocity, displacement"};
    case StageKind::kMeasureContact:
      return {"measure contact", "contacts, velocity", "force on each tool"};
    case StageKind::kCheckVolume:
      return {"check volume", "positions", "smallest det F of what is inside out"};
    case StageKind::kWatch:
      return {"watch elements", "displacement, rest shapes", "smallest det F, strain, rotation, elastic energy"};
  }
  return {};
}

v1::SceneReport make_report(const Model& model, const MachineRates& machine) {
  v1::SceneReport report;
  report.set_scene(model.name);
  for (const BodyModel& body : model.bodies) {
    v1::BodyReport& out = *report.add_bodies();
    out.set_name(body.name);
    out.set_node_count(body.node_count);
    out.set_element_count(body.element_count);
    out.set_fixed_node_count(body.fixed_node_count);
    out.set_component_count(body.component_count);
    out.set_volume_m3(body.volume_m3);
    out.set_mass_kg(body.mass_kg);
    out.set_min_dihedral_angle_deg(body.min_dihedral_angle_deg);
    out.set_surface_vertex_count(body.vertex_count);
    out.set_surface_triangle_count(static_cast<std::uint32_t>(body.triangles.size()));
  }

  double step_s = 0;
  for (const Stage& stage : model.stages) {
    const StageText words = text(stage.kind);
    const Cost one = cost(model, stage);
    v1::PlanStage& out = *report.add_stages();
    out.set_name(std::string(words.name));
    if (stage.kind == StageKind::kElements || stage.kind == StageKind::kCheckVolume ||
        stage.kind == StageKind::kWatch) {
      const ElementGroup& group = model.groups[stage.group];
      physics::with_shape_and_law(group.shape, group.law, [&](auto shape, auto law) {
        out.set_name(fmt::format("{}: {}, {}", words.name,
                                 group.is_wedge_pairs() ? "volume of wedge pairs" : decltype(shape)::Type::kName,
                                 decltype(law)::Type::kName));
      });
    }
    out.set_reads(std::string(words.reads));
    out.set_writes(std::string(words.writes));
    out.set_bytes(static_cast<std::uint64_t>(one.bytes));
    out.set_operations(static_cast<std::uint64_t>(one.operations));
    const double once_s = std::max(one.bytes / machine.bytes_per_s, one.operations / machine.operations_per_s);
    // A tolerance ends most solves early; half of the iterations is a guess, and the report says that it is one.
    const double iterations = model.cg_tolerance > 0 ? 0.5 * model.cg_max_iterations : model.cg_max_iterations;
    if (stage.phase == Phase::kWatch || stage.phase == Phase::kBacktrack) continue;  // now and then
    const bool repeats = stage.phase == Phase::kEvaluate || stage.phase == Phase::kSolve;
    // Newton converges quadratically: a handful of iterations, whatever the limit.
    const double solves = repeats ? std::min(model.newton_max_iterations, 5u) : 1;
    step_s +=
        solves * (machine.stage_latency_s +
                  (stage.kind == StageKind::kSolve ? iterations * (once_s + machine.iteration_latency_s) : once_s));
  }
  report.set_expected_rate_hz(1 / step_s);

  CountingArena arena(report);
  if (model.double_precision) {
    bind_all<double>(model, arena);
  } else {
    bind_all<float>(model, arena);
  }
  list_not_modelled(model, report);
  for (const std::string& warning : model.warnings) report.add_warnings(warning);
  return report;
}

}  // namespace tensormass::model
