#pragma once

#include <cstdint>
#include <string_view>
#include <vector>

#include "matrix/packed_block.h"
#include "model/model.h"
#include "physics/lists.h"
#include "view/coarse.h"

/// The table of stages: all stages that a step can have, in the order in which they run.
///
///   begin ──> evaluate ──> solve ──> end ──> (frame)
///                ^           │
///                └───────────┘             Newton's method repeats these, and backtracks (solver/newton.h)
///
/// 1. The table is the only list. list_stages selects from it the stages that a model needs. The plan prints those, and
///    both backends run them. docs/architecture.md shows the table, and tests/step checks the document.
/// 2. A scene pays only for what it names: a stage whose condition is false is not launched and has no buffers.
/// 3. Stages that a GPU fuses into one kernel are one stage of their own (resident and streamed solve). The plan then
///    shows what runs.
///
/// run.h says which function each stage calls.
namespace tensormass::step {

enum class StageKind : std::uint8_t {
  kPredict,
  kPrescribe,
  kBeginBalance,
  kQueryClosest,
  kGenerateContacts,
  kBeginLinks,
  kFindLinks,
  kLaggedElements,
  kBeginEdges,
  kInternalVariables,
  kDecompose,
  kElements,
  kGatherKept,
  kFinishRows,
  kRowErrors,
  kExternalForces,
  kPressure,
  kAssembleContact,
  kAssembleLinks,
  kMeasureResidual,
  kCoarseLevel,
  kFactorize,
  kScaleEdges,
  kSolve,
  kAdvance,
  kResidentSolve,
  kStreamedSolve,
  kBacktrack,
  kMeasureBalance,
  kSolveBalance,
  kApplyBalance,
  kMeasureContact,
  kMeasureLinks,
  kExtrapolate,
  kCheckInversion,
  kDiagnostics,
  kGatherSurface,
};

enum class Phase : std::uint8_t {
  kBegin,        ///< once a step
  kEvaluate,     ///< forces and matrix at the present state
  kSolve,        ///< the linear solve, and moving the rows by its full increment
  kBacktrack,    ///< moving them by a fraction of the increment instead
  kEnd,          ///< once a step
  kDiagnostics,  ///< now and then, for the status
  kFrame,        ///< when a frame is due
};
inline constexpr int kPhases = 7;

/// How often a stage runs in its phase, and the types for which its code is compiled.
enum class Scope : std::uint8_t {
  kScene,         ///< once
  kShape,         ///< once for each group; compiled for each shape
  kShapeAndLaw,   ///< once for each group; compiled for each shape and law, in files of their own
  kFusedOnDevice  ///< once; a GPU has a kernel of its own, other backends never run it
};

/// How the threads and patches of a stage communicate.
enum class Communication : std::uint8_t {
  kNone,
  kReduces,         ///< a patch reduces over its own items
  kReducesInParts,  ///< likewise, once for each part of a patch that the team has
  kExchanges,       ///< patches exchange data while they run
};

/// Bytes that a stage must move at least, and its floating-point operations, counted from its loops.
struct Cost {
  double bytes = 0, operations = 0;
};

/// Sizes from which conditions and costs follow.
struct StageSizes {
  const model::Model& m;
  const model::ElementGroup* group;  ///< the group of a stage of a group; else nullptr
  double real, rows, slots, tools, core_points, contacts, triangles;
  bool edges;  ///< the matrix stores edges

  StageSizes(const model::Model& model, const model::ElementGroup* of_group)
      : m(model),
        group(of_group),
        real(model.double_precision ? 8 : 4),
        rows(model.layout.row_count),
        slots(model.layout.slot_count()),
        tools(static_cast<double>(model.tools.size())),
        core_points(model.core_points()),
        contacts(static_cast<double>(model.contact_points()) * model.contact.triangle_count()),
        triangles(model.contact.triangle_count()),
        edges(model.layout.storage == matrix::Storage::kEdges) {}

  bool has_tools() const { return !m.tools.empty(); }
  bool has_links() const { return m.links.count() > 0; }
  bool balances() const { return m.free_bodies.count() > 0; }
  bool fused() const { return m.solve != model::SolveKind::kStages; }
  double nodes_of_element() const { return static_cast<double>(group->rows.size()) / group->stride; }
  double points() const { return static_cast<double>(group->stride) * group->point_count; }
  double internal_variable_bytes() const { return 2 * static_cast<double>(group->internal_variable_reals()) * real; }
  double rest_bytes() const { return static_cast<double>(group->rest.size() + group->parameters.size()) * real; }
  bool decomposes() const {
    return !edges && !group->is_constant && !m.lags(*group) && physics::decomposes(group->law);
  }
  double decomposition_bytes() const { return decomposes() ? points() * view::kDecompositionReals * real : 0; }

  /// A pass over the triangles for each core point, and one for each segment between two of them.
  Cost query_tools() const {
    const auto thin = std::count_if(m.tools.begin(), m.tools.end(),
                                    [](const model::ToolModel& tool) { return tool.core_points > 0; });
    const double passes = (2 * core_points - static_cast<double>(thin)) * triangles;
    return {passes * (12 + 3 * 8 * real), passes * 60};
  }
  Cost generate_contacts() const { return {tools * triangles * (12 + 3 * 8 * real) + contacts * real, contacts * 60}; }
  /// A pass over the groups of boxes for each candidate, and over a leaf with its triangles. Deeper searches cost more.
  Cost find_links() const {
    const double leaves = m.links.leaf_triangles.size() / view::kLeafTriangles;
    const double boxes = leaves / view::kGroupLeaves + view::kGroupLeaves, candidates = m.links.candidate_count();
    const double searching = candidates + m.links.edge_candidate_count();
    const double near = searching * view::kLeafTriangles;
    return {leaves * 6 * real + near * (4 + 12 + 9 * real) + m.links.count() * 15 * real,
            searching * boxes * 15 + near * 60};
  }
  Cost solve() const {  // one iteration
    const double linked = 4 * m.links.count();
    const Cost whole{slots * (9 * real + 4) + rows * 9 * 4 * real + linked * 20 * real,
                     slots * (edges ? 36 : 18) + rows * 36 + linked * 150};
    if (m.double_precision || m.layout.storage != matrix::Storage::kTiles) return whole;
    // Tiles stream in single precision: packed blocks, and beside each a column, mostly of 16 bits.
    const double slot = sizeof(matrix::PackedBlock) + sizeof(std::uint16_t), row = sizeof(matrix::PackedDiagonal);
    return {m.layout.read_slot_count() * slot + rows * (row + 9 * 4 * real), whole.operations};
  }
};

struct StageInfo {
  StageKind kind;
  Phase phase;
  Scope scope;
  Communication communication;
  std::string_view name, reads, writes, when;
  bool (*needed)(const StageSizes&);
  Cost (*cost)(const StageSizes&);  ///< cost of one run; for solves, of one iteration
};

/// Returns whether the cost of a stage is that of one iteration of conjugate gradients.
constexpr bool costs_an_iteration(const StageInfo& info) {
  return info.kind == StageKind::kSolve || info.scope == Scope::kFusedOnDevice;
}
/// Returns whether a stage is part of every step; the others run now and then.
constexpr bool runs_every_step(const StageInfo& info) {
  return info.kind != StageKind::kRowErrors && info.kind != StageKind::kCoarseLevel &&
         info.phase != Phase::kBacktrack && info.phase != Phase::kDiagnostics && info.phase != Phase::kFrame;
}

// clang-format off
inline constexpr StageInfo kStages[] = {
  {StageKind::kPredict, Phase::kBegin, Scope::kScene, Communication::kNone,
   "predict", "displacement, velocity", "base displacement and velocity, checkpoint",
   "the step is not implicit Euler linearized once, or displacements are prescribed",
   [](const StageSizes& s) { return !s.m.is_plain(); },
   [](const StageSizes& s) { return Cost{s.rows * 7 * 4 * s.real, s.rows * 12}; }},
  {StageKind::kPrescribe, Phase::kBegin, Scope::kScene, Communication::kNone,
   "prescribe", "prescribed displacements", "velocity of prescribed nodes",
   "the scene prescribes displacements that are not zero",
   [](const StageSizes& s) { return !s.m.prescribed_rows.rows.empty(); },
   [](const StageSizes& s) {
     const double entries = static_cast<double>(s.m.prescribed_rows.rows.size()) / 3;
     return Cost{entries * (12 + 9 * s.real), entries * 6};
   }},
  {StageKind::kBeginBalance, Phase::kBegin, Scope::kScene, Communication::kNone,
   "begin balance", "velocity", "velocity of free bodies before the solve",
   "a free body can touch something, and a step is linearized once",
   [](const StageSizes& s) { return s.balances(); },
   [](const StageSizes& s) { return Cost{s.rows * (4 + 8 * s.real), 0}; }},
  {StageKind::kQueryClosest, Phase::kEvaluate, Scope::kScene, Communication::kReduces,
   "closest-point query", "displacement, tools", "closest triangle of each patch", "the scene has thin tools",
   [](const StageSizes& s) { return s.core_points > 0; },
   [](const StageSizes& s) { return s.query_tools(); }},
  {StageKind::kGenerateContacts, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "contact generation", "displacement, tools, closest, friction slips", "contacts, friction", "the scene has tools",
   [](const StageSizes& s) { return s.has_tools(); },
   [](const StageSizes& s) { return s.generate_contacts(); }},
  {StageKind::kBeginLinks, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "begin links", "displacement", "empty lists of links, boxes around surfaces",
   "bodies touch or are attached to each other, or a blade cuts",
   [](const StageSizes& s) { return s.has_links(); },
   [](const StageSizes& s) {
     const double places = static_cast<double>(s.m.links.leaf_triangles.size());  // leaves and groups both read them
     return Cost{places * 2 * (4 + 12 + 3 * 8 * s.real), places * 2 * 18};
   }},
  {StageKind::kFindLinks, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "find links", "displacement, velocity, boxes, friction slips, broken springs", "links, their lists",
   "bodies touch or are attached to each other, or a blade cuts",
   [](const StageSizes& s) { return s.has_links(); },
   [](const StageSizes& s) { return s.find_links(); }},
  {StageKind::kLaggedElements, Phase::kEvaluate, Scope::kShapeAndLaw, Communication::kNone,
   "lagged element tensors", "displacement, rest shapes, kept tensors", "kept tensors",
   "for groups with lagged tangents",
   [](const StageSizes& s) { return s.m.lags(*s.group); },
   [](const StageSizes& s) {
     // Each element's moves are compared; one in lag_steps is evaluated, and its tensors are read and written.
     const double nodes = s.nodes_of_element(), stride = s.group->stride, turns = s.m.lag_steps;
     const double kept = 3 * (2 * nodes - 1) + 9 * nodes * (nodes - 1) / 2;
     return Cost{static_cast<double>(s.group->rows.size()) * (4 + 4 * s.real) + s.rest_bytes() +
                     stride * (3 * (nodes - 1) + 2 * kept / turns) * s.real,
                 s.points() * (30 * nodes + (120 + 30 * nodes + 30 * nodes * nodes) / turns)};
   }},
  {StageKind::kBeginEdges, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "assemble constant part", "constant and kept tensors, velocity", "matrix, right-hand side",
   "the matrix stores edges (CPU); element passes then add to it",
   [](const StageSizes& s) { return s.edges; },
   [](const StageSizes& s) {
     const bool constant = !s.m.constant_edges.empty() || s.m.lags();
     return Cost{s.slots * 9 * s.real * (constant ? 2 : 1) + s.rows * (3 * 4 + 8) * s.real,
                 s.slots * (constant ? 90 : 0)};
   }},
  {StageKind::kInternalVariables, Phase::kEvaluate, Scope::kShapeAndLaw, Communication::kNone,
   "advance internal variables", "displacement, internal variables", "internal variables",
   "on a GPU, for groups with Prony terms; a CPU does this within the element pass",
   [](const StageSizes& s) { return !s.edges && !s.group->is_constant && !s.group->prony.empty(); },
   [](const StageSizes& s) { return Cost{s.rest_bytes() + s.internal_variable_bytes(), s.points() * 150}; }},
  {StageKind::kDecompose, Phase::kEvaluate, Scope::kShape, Communication::kNone,
   "decompose", "displacement, rest shapes", "F = U S V^T of each quadrature point",
   "on a GPU, for laws of the principal stretches",
   [](const StageSizes& s) { return s.decomposes(); },
   [](const StageSizes& s) { return Cost{s.rest_bytes() + s.decomposition_bytes(), s.points() * 600}; }},
  {StageKind::kElements, Phase::kEvaluate, Scope::kShapeAndLaw, Communication::kNone,
   "element tensors", "displacement, rest shapes; on a GPU decompositions", "matrix, right-hand side",
   "for each group whose law is not linear, unless its tangents lag; on a GPU the last one forms the rows of A and b",
   [](const StageSizes& s) { return !s.group->is_constant && !s.m.lags(*s.group); },
   [](const StageSizes& s) {
     // Counted for StVK: about 120 for the stress of a point, 60 for each node, then 60 for each block.
     const double nodes = s.nodes_of_element(), points = s.points(), rest = s.rest_bytes() + s.internal_variable_bytes();
     if (!s.edges) {  // each node's row evaluates the element and its own blocks; if caches hold, it is read once
       const auto& row_lists = s.group->row_lists;
       const double lists = static_cast<double>(row_lists.listed.size() + row_lists.places.size()) * 4;
       return Cost{rest + lists + s.decomposition_bytes() + s.slots * (9 * s.real + 4) + s.rows * (6 * 4 + 8) * s.real,
                   nodes * points * (120 + 60 * nodes + 60 * (nodes - 1))};
     }
     const double elements = static_cast<double>(s.group->rows.size()) * (4 + 4 * s.real) + rest +
                             static_cast<double>(s.group->pair_places.size()) * 4;
     // The matrix and the right-hand side are read and written, too.
     return Cost{elements + (s.slots * 9 + s.rows * (8 + 4)) * 2 * s.real,
                 points * (120 + 30 * nodes + 30 * nodes * nodes)};
   }},
  {StageKind::kGatherKept, Phase::kEvaluate, Scope::kShapeAndLaw, Communication::kNone,
   "gather kept tensors", "kept tensors of elements", "kept tensors of rows",
   "on a GPU, for groups with lagged tangents: for rows whose elements were evaluated",
   [](const StageSizes& s) { return !s.edges && s.m.lags(*s.group); },
   [](const StageSizes& s) {
     const auto& row_lists = s.group->row_lists;
     const double nodes = s.nodes_of_element(), turns = s.m.lag_steps;
     const double lists = static_cast<double>(row_lists.listed.size() + row_lists.places.size()) * 4;
     const double blocks = static_cast<double>(s.group->rows.size()) * (nodes - 1);
     return Cost{(lists + blocks * 9 * s.real + s.slots * 9 * s.real) / turns, blocks * 9 / turns};
   }},
  {StageKind::kFinishRows, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "finish rows", "constant tensors, sums of the elements, velocity", "matrix, right-hand side",
   "on a GPU, if there are constant or kept tensors; otherwise the last element pass finishes rows",
   [](const StageSizes& s) { return !s.m.begun_slices.empty(); },
   [](const StageSizes& s) {
     return Cost{s.slots * (9 * s.real * 2 + 4) + s.rows * (4 * 4 + 8) * s.real, s.slots * 54 + s.rows * 60};
   }},
  {StageKind::kRowErrors, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "measure row errors", "matrix", "what rounding adds to the sum of each row", "as for the coarse level",
   [](const StageSizes& s) { return s.m.aggregates.count() > 0; },
   [](const StageSizes& s) { return Cost{s.slots * (9 * s.real + 4) + s.rows * 9 * (8 + s.real), s.slots * 18}; }},
  {StageKind::kExternalForces, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "external forces", "gravity and loads", "right-hand side",
   "on a CPU, if the scene has gravity or loads; on a GPU finished rows have them",
   [](const StageSizes& s) { return s.edges && !s.m.external.empty(); },
   [](const StageSizes& s) { return Cost{s.rows * 12 * s.real, s.rows * 6}; }},
  {StageKind::kPressure, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "pressure", "displacement, velocity, pressure faces", "matrix, right-hand side",
   "the scene has faces under pressure",
   [](const StageSizes& s) { return !s.m.pressure.faces.empty(); },
   [](const StageSizes& s) {
     const double corners = static_cast<double>(s.m.pressure.corners.size()) / 2;
     // For four nodes a face: positions, velocities, and three blocks of the matrix.
     return Cost{corners * (68 + (4 * 12 + 3 * 2 * 9) * s.real), corners * 4 * 500};
   }},
  {StageKind::kAssembleContact, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "assemble contact", "contacts, friction, velocity", "matrix, right-hand side", "the scene has tools",
   [](const StageSizes& s) { return s.has_tools(); },
   [](const StageSizes& s) {
     const double incidences = static_cast<double>(s.m.contact.incidence.size()) / 4;
     const double points = s.m.contact_points();
     return Cost{incidences * (16 * s.tools + 9 * s.real * points), points * incidences * 4};
   }},
  {StageKind::kAssembleLinks, Phase::kEvaluate, Scope::kScene, Communication::kNone,
   "assemble links", "links, velocity", "matrix diagonal, right-hand side",
   "bodies touch or are attached to each other, or a blade cuts",
   [](const StageSizes& s) { return s.has_links(); },
   [](const StageSizes& s) {
     const double links = s.m.links.count();
     return Cost{links * (4 * 4 + 4 * (4 + 15 * s.real)), links * 4 * 100};
   }},
  {StageKind::kMeasureResidual, Phase::kEvaluate, Scope::kScene, Communication::kReduces,
   "measure residual", "right-hand side, forces", "residual of each patch", "the scene solves more than once a step",
   [](const StageSizes& s) { return s.m.iterates(); },
   [](const StageSizes& s) { return Cost{s.rows * 4 * 4 * s.real, s.rows * 24}; }},
  {StageKind::kCoarseLevel, Phase::kSolve, Scope::kScene, Communication::kNone,
   "coarse level", "matrix, displacement", "sums of rows, factor of the coarse matrix",
   "once a solve has taken more than 80 iterations, or if the scene asks for it; not before a streamed solve",
   [](const StageSizes& s) { return s.m.aggregates.count() > 0; },
   [](const StageSizes& s) {
     const double n = view::kRigidModes * static_cast<double>(s.m.aggregates.count());
     return Cost{s.slots * (9 * s.real + 4) + 4 * n * n * 8, s.slots * 60 + n * n * n / 3};
   }},
  {StageKind::kFactorize, Phase::kSolve, Scope::kScene, Communication::kNone,
   "factorize diagonal", "matrix diagonal", "inverse Cholesky factors, right-hand side",
   "always, unless the resident solve does it",
   [](const StageSizes& s) { return s.m.solve != model::SolveKind::kResident; },
   [](const StageSizes& s) { return Cost{s.rows * 2 * 12 * s.real, s.rows * 60}; }},
  {StageKind::kScaleEdges, Phase::kSolve, Scope::kScene, Communication::kNone,
   "scale matrix", "matrix, inverse factors", "matrix", "always, unless a fused solve does it",
   [](const StageSizes& s) { return !s.fused(); },
   [](const StageSizes& s) { return Cost{s.slots * (2 * 9 * s.real + 4), s.slots * 90}; }},
  {StageKind::kSolve, Phase::kSolve, Scope::kScene, Communication::kExchanges,
   "conjugate gradients", "matrix, right-hand side", "solution", "always, unless a fused solve does it",
   [](const StageSizes& s) { return !s.fused(); },
   [](const StageSizes& s) { return s.solve(); }},
  {StageKind::kAdvance, Phase::kSolve, Scope::kScene, Communication::kReduces,
   "advance", "solution", "velocity, displacement, guard reports; the checkpoint if nothing predicts",
   "always, unless a fused solve does it",
   [](const StageSizes& s) { return !s.fused(); },
   [](const StageSizes& s) {
     return Cost{s.rows * (s.edges && s.m.checks_volume() ? 11 : 9) * 4 * s.real, s.rows * 50};
   }},
  {StageKind::kResidentSolve, Phase::kSolve, Scope::kFusedOnDevice, Communication::kExchanges,
   "resident solve: factorize, scale, conjugate gradients, advance", "matrix, right-hand side",
   "velocity, displacement, checkpoint, guard reports",
   "on a GPU, in single precision, if a patch's rows fit its thread block",
   [](const StageSizes& s) { return s.m.solve == model::SolveKind::kResident; },
   [](const StageSizes& s) { return s.solve(); }},
  {StageKind::kStreamedSolve, Phase::kSolve, Scope::kFusedOnDevice, Communication::kExchanges,
   "streamed solve: scale, pack, conjugate gradients, advance", "matrix, inverse factors, right-hand side",
   "velocity, displacement, checkpoint, guard reports",
   "on a GPU, in single precision, for larger patches",
   [](const StageSizes& s) { return s.m.solve == model::SolveKind::kStreamed; },
   [](const StageSizes& s) { return s.solve(); }},
  {StageKind::kBacktrack, Phase::kBacktrack, Scope::kScene, Communication::kReduces,
   "backtrack", "increment", "velocity, displacement", "instead of a full increment that made the residual larger",
   [](const StageSizes& s) { return s.m.iterates(); },
   [](const StageSizes& s) { return Cost{s.rows * 5 * 4 * s.real, s.rows * 12}; }},
  {StageKind::kMeasureBalance, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "measure balance", "displacement, velocity, contacts, friction, links", "missing momentum of free bodies",
   "as for begin balance",
   [](const StageSizes& s) { return s.balances(); },
   [](const StageSizes& s) { return Cost{s.rows * (4 + 20 * s.real) + s.contacts * s.real, s.rows * 300}; }},
  {StageKind::kSolveBalance, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "solve balance", "missing momentum of free bodies", "rigid motions of free bodies", "as for begin balance",
   [](const StageSizes& s) { return s.balances(); },
   [](const StageSizes& s) {
     const double entries = static_cast<double>(s.m.free_bodies.entry_body.size());
     return Cost{entries * sizeof(view::BalanceSums), entries * view::kBalanceSums};
   }},
  {StageKind::kApplyBalance, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "apply balance", "rigid motions of free bodies", "displacement, velocity, guard reports", "as for begin balance",
   [](const StageSizes& s) { return s.balances(); },
   [](const StageSizes& s) { return Cost{s.rows * 9 * 4 * s.real, s.rows * 60}; }},
  {StageKind::kMeasureContact, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "measure contact", "contacts, friction, velocity", "force on each tool, friction slips", "the scene has tools",
   [](const StageSizes& s) { return s.has_tools(); },
   [](const StageSizes& s) {
     const double slips = s.m.contacts_remember() ? 4 + 4 : 0;  // reads and writes
     return Cost{s.contacts * s.real * (1 + slips), s.contacts};
   }},
  {StageKind::kMeasureLinks, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "measure links", "links, velocity, tools", "broken springs, friction slips, anchors of blades, report",
   "bodies touch or are attached to each other, or a blade cuts",
   [](const StageSizes& s) { return s.has_links(); },
   [](const StageSizes& s) {
     const double links = s.m.links.count();
     return Cost{links * (4 * 4 + 24 * s.real), links * 100};
   }},
  {StageKind::kExtrapolate, Phase::kEnd, Scope::kScene, Communication::kReduces,
   "extrapolate", "base displacement and velocity, displacement, velocity", "displacement, velocity, guard reports",
   "the integrator is the implicit midpoint rule",
   [](const StageSizes& s) { return s.m.extrapolates(); },
   [](const StageSizes& s) { return Cost{s.rows * 9 * 4 * s.real, s.rows * 50}; }},
  {StageKind::kCheckInversion, Phase::kEnd, Scope::kShape, Communication::kReducesInParts,
   "check inversion", "displacement; on a CPU relative positions", "smallest det F of inverted elements",
   "for each group whose law does not recover from inversion, unless the fused solve checks it",
   [](const StageSizes& s) { return s.group->checks_volume && !s.group->solve_checks_volume; },
   [](const StageSizes& s) {
     // Checked from positions: one field for packs of elements, two otherwise.
     return Cost{static_cast<double>(s.group->rows.size()) * (4 + (s.edges ? 4 : 8) * s.real),
                 static_cast<double>(s.group->element_count) * s.group->point_count * 80};
   }},
  {StageKind::kDiagnostics, Phase::kDiagnostics, Scope::kShapeAndLaw, Communication::kReduces,
   "diagnostics", "displacement, rest shapes", "smallest det F, strain, rotation, elastic energy",
   "four times a second, for the status",
   [](const StageSizes&) { return true; },
   [](const StageSizes& s) {
     return Cost{static_cast<double>(s.group->rows.size()) * (4 + 4 * s.real) +
                     static_cast<double>(s.group->rest.size()) * s.real,
                 static_cast<double>(s.group->element_count) * s.group->point_count * 600};
   }},
  {StageKind::kGatherSurface, Phase::kFrame, Scope::kScene, Communication::kNone,
   "gather surface", "displacement", "positions of visible vertices", "when a frame is due",
   [](const StageSizes& s) { return s.m.visible.count() > 0; },
   [](const StageSizes& s) {
     const double vertices = s.m.visible.point_count();
     return Cost{vertices * (4 * (4 + 9 * s.real) + 12), vertices * 24};
   }},
};
// clang-format on

/// The first row of a kind in the table, for its fields that do not depend on the phase.
constexpr const StageInfo& info(StageKind kind) {
  for (const StageInfo& stage : kStages) {
    if (stage.kind == kind) return stage;
  }
  return kStages[0];  // never: the assertion below
}
constexpr bool is_of_group(Scope scope) { return scope == Scope::kShape || scope == Scope::kShapeAndLaw; }

inline constexpr int kStageKinds = static_cast<int>(StageKind::kGatherSurface) + 1;
static_assert(
    [] {
      for (int kind = 0; kind < kStageKinds; ++kind) {
        if (info(static_cast<StageKind>(kind)).kind != static_cast<StageKind>(kind)) return false;
      }
      return true;
    }(),
    "every StageKind has a row in kStages");

/// A stage of one model.
struct Stage {
  const StageInfo* info;
  std::uint32_t group = 0;  ///< index of its group, for a stage of a group
};

/// Returns the stages of a model in the order in which they run. Adjacent stages of groups run group by group.
std::vector<Stage> list_stages(const model::Model& model);

/// Returns the cost of one run of a stage; for a solve, of one iteration.
Cost cost(const model::Model& model, const Stage& stage);

}  // namespace tensormass::step
