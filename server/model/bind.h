#pragma once

#include <algorithm>
#include <cstdint>
#include <iterator>
#include <string_view>

#include "core/assert.h"
#include "core/parallel.h"
#include "matrix/lagged_tangents.h"
#include "model/edit_buffers.h"
#include "model/model.h"
#include "physics/lists.h"
#include "view/coarse.h"

/// Allocates the buffers of a model and makes the views that stages read (view/scene.h).
///
/// Why templates: one function serves three arenas, so host memory, device memory and the plan of `tensormass inspect`
/// cannot disagree about buffers.
///
///                    +--> backend::cpu::Arena   host memory          SceneView: the scene
///   Model --bind()--+--> DeviceArena           device memory   -->  ElementView: one for each group
///                    +--> CountingArena         names and bytes      StepExchange: input and output of a step
///                                                                    HostInputs: what the host writes between steps
///
/// An Arena has three functions. Each returns nullptr for no items; CountingArena always does.
///
///   T* constant<T>(name, const std::vector<U>& items)   returns a copy, converted to T by static_cast
///   T* zeros<T>(name, count)                            returns `count` zeros
///   T* generated<T>(name, count, fill)                  returns zeros over which fill(T*) has written once
///
/// Stages only read what is constant: their views have const pointers to it.
///
/// A buffer that the scene does not need has no items, and its pointer is null. Lengths follow from
///   rows   rows of the layout, with gap rows       local  rows + all halos: vectors that are stored patch by patch
///   4      reals of a vector: three, and padding
namespace tensormass::model {

/// The input of a step and its reports. A device may keep them apart from its other buffers, to copy them at once.
template <class Real>
struct StepExchange {
  view::StepControl<Real>* control;
  physics::PlacedTool<Real>* tools;
  Real* prescribed;
  view::SolveReport<Real>* solve_report;
  view::PatchReport<Real>* patch_reports;
  view::PatchResidual<Real>* residuals;
  view::PatchDiagnostics<Real>* diagnostics;
  Real* min_det_f;
  view::ToolLoad<Real>* tool_loads;
  view::LinkReport<Real>* link_reports;
  view::BladeReport<Real>* blade_reports;
  view::BalanceReport<Real>* balance_reports;
};

/// The buffers that the host writes between steps and stages only read. Members as in the views that have them.
template <class Real>
struct HostInputs {
  view::StepControl<Real>* control;
  physics::PlacedTool<Real>* tools;
  Real* prescribed;
  view::NewtonControl* newton;
  Real* external;
  view::PressureFace<Real>* faces;
};

template <class Real>
struct BoundScene {
  view::SceneView<Real> view;
  HostInputs<Real> inputs;
  SceneBuffers buffers;
};

template <class Real, class Arena>
StepExchange<Real> make_exchange(const Model& m, Arena& arena) {
  const std::size_t patches = m.layout.patch_count, tools = m.tools.size(), groups = m.groups.size();
  StepExchange<Real> e{};
  e.control = arena.template zeros<view::StepControl<Real>>("step control", 1);
  e.tools = arena.template zeros<physics::PlacedTool<Real>>("tools", tools);
  e.prescribed = arena.template zeros<Real>("prescribed displacements", 4 * m.prescribed.size());
  e.solve_report = arena.template zeros<view::SolveReport<Real>>("solve report", 1);
  e.patch_reports = arena.template zeros<view::PatchReport<Real>>("patch reports", patches);
  e.residuals = arena.template zeros<view::PatchResidual<Real>>("residuals", m.iterates() ? patches : 0);
  e.diagnostics = arena.template zeros<view::PatchDiagnostics<Real>>("diagnostics", groups * patches);
  e.min_det_f = arena.template zeros<Real>("volume check", m.checks_volume() ? groups * patches : 0);
  e.tool_loads = arena.template zeros<view::ToolLoad<Real>>("tool loads", tools * patches);
  e.link_reports = arena.template zeros<view::LinkReport<Real>>("link reports", m.links.count() > 0 ? patches : 0);
  e.blade_reports = arena.template zeros<view::BladeReport<Real>>("fronts of cuts", m.links.blades.point_count());
  e.balance_reports = arena.template zeros<view::BalanceReport<Real>>("balance reports", m.free_bodies.count());
  return e;
}

/// Allocates the buffers of a scene, except those of its groups and of the exchange.
template <class Real, class Arena>
BoundScene<Real> bind(const Model& m, Arena& arena, const StepExchange<Real>& exchange) {
  using std::uint32_t;
  const matrix::Layout& layout = m.layout;
  const std::size_t rows = layout.row_count, patches = layout.patch_count, tools = m.tools.size();
  const std::size_t local = rows + layout.halo.size();
  const std::size_t triangles = m.contact.triangle_count();
  const auto only_if = [](bool needed, std::size_t count) { return needed ? count : 0; };
  TM_ASSERT(layout.patch_rows.size() == patches + 1 && layout.patch_halo.size() == patches + 1,
            "each patch has rows and a halo");
  TM_ASSERT(rows % view::kSliceRows == 0 && m.rest.size() == 4 * rows, "a row field has a vector for each row");
  BoundScene<Real> bound{};
  view::SceneView<Real>& s = bound.view;
  HostInputs<Real>& inputs = bound.inputs;
  inputs.control = exchange.control;
  inputs.tools = exchange.tools;
  inputs.prescribed = exchange.prescribed;
  s.patches.row_count = layout.row_count;
  s.patches.patch_count = layout.patch_count;
  s.contact.tool_count = static_cast<uint32_t>(tools);
  s.contact.contact_points = m.contact_points();
  s.contact.triangle_count = m.contact.triangle_count();
  s.contact.vertex_count = static_cast<std::uint32_t>(m.contact.surface_rows.size());
  s.state.control = exchange.control;
  s.contact.tools = exchange.tools;
  s.prescribed.displacement = exchange.prescribed;
  s.solve.report = exchange.solve_report;
  s.guard.patch_reports = exchange.patch_reports;
  s.newton.residuals = exchange.residuals;
  s.guard.diagnostics = exchange.diagnostics;
  s.guard.min_det_f = exchange.min_det_f;
  s.contact.tool_loads = exchange.tool_loads;
  s.links.reports = exchange.link_reports;
  s.links.blades.reports = exchange.blade_reports;
  s.balance.reports = exchange.balance_reports;
  s.solve.cg_tolerance = static_cast<Real>(m.cg_tolerance);
  s.state.size_m = static_cast<Real>(m.size_m);
  s.state.iterates = m.iterates() ? 1 : 0;

  s.patches.patch_rows = arena.template constant<uint32_t>("patch rows", layout.patch_rows);
  s.patches.patch_halo = arena.template constant<uint32_t>("patch halo offsets", layout.patch_halo);
  s.patches.halo = arena.template constant<uint32_t>("halo rows", layout.halo);
  const bool edges = layout.storage == matrix::Storage::kEdges;
  s.matrix.slice_begin = arena.template constant<uint32_t>("matrix slices", layout.slice_begin);
  s.matrix.columns = arena.template constant<uint32_t>("matrix columns", layout.columns);
  s.matrix.tile_rows = layout.tile_rows;
  s.matrix.slice_read = arena.template constant<uint32_t>("matrix slices' columns to be read", layout.slice_read);
  s.matrix.used_twice = arena.template constant<uint32_t>("matrix blocks of two rows", layout.used_twice);
  s.matrix.slice_halo = arena.template constant<uint32_t>("matrix slices' halo", layout.slice_halo);
  s.matrix.patch_boundary = arena.template constant<uint32_t>("boundary rows of patches", layout.patch_boundary);
  s.matrix.boundary = arena.template constant<uint32_t>("boundary rows", layout.boundary);
  s.solve.own_product = arena.template zeros<Real>("own product", only_if(edges, 4 * rows));

  s.matrix.constant_edges = place_buffer<EditBuffer::kConstantEdges, Real>(m, arena, bound.buffers);

  s.matrix.begun_slices = arena.template constant<std::uint8_t>("begun rows", m.begun_slices);

  s.state.displacement = arena.template zeros<Real>("displacement", 4 * rows);
  s.state.velocity = arena.template zeros<Real>("velocity", 4 * rows);
  s.state.rest = place_buffer<EditBuffer::kRest, Real>(m, arena, bound.buffers);
  s.guard.relative_position =
      arena.template zeros<Real>("relative positions", only_if(edges && m.checks_volume(), 4 * rows));
  s.state.inertia = place_buffer<EditBuffer::kInertia, Real>(m, arena, bound.buffers);
  inputs.external = place_buffer<EditBuffer::kExternal, Real>(m, arena, bound.buffers);
  s.state.external = inputs.external;
  s.matrix.mass_edges = place_buffer<EditBuffer::kMassEdges, Real>(m, arena, bound.buffers);

  const bool two_steps = m.integrator == Integrator::kBdf2;
  s.state.base_displacement = arena.template zeros<Real>("base displacement", only_if(!m.is_plain(), 4 * rows));
  s.state.base_velocity = arena.template zeros<Real>("base velocity", only_if(!m.is_plain(), 4 * rows));
  s.state.previous_displacement = arena.template zeros<Real>("previous displacement", only_if(two_steps, 4 * rows));
  s.state.previous_velocity = arena.template zeros<Real>("previous velocity", only_if(two_steps, 4 * rows));
  s.state.show_to_readers();
  s.guard.checkpoint_displacement = arena.template zeros<Real>("checkpoint displacement", 4 * rows);
  s.guard.checkpoint_velocity = arena.template zeros<Real>("checkpoint velocity", 4 * rows);
  s.guard.checkpoint_previous_displacement =
      arena.template zeros<Real>("checkpoint previous displacement", only_if(two_steps, 4 * rows));
  s.guard.checkpoint_previous_velocity =
      arena.template zeros<Real>("checkpoint previous velocity", only_if(two_steps, 4 * rows));
  s.newton.increment = arena.template zeros<Real>("increment", only_if(m.iterates(), 4 * rows));
  s.newton.iterate = arena.template zeros<Real>("iterate", only_if(m.iterates(), 4 * rows));
  s.newton.internal_force = arena.template zeros<Real>("internal forces", only_if(m.iterates(), 4 * rows));
  inputs.newton = arena.template zeros<view::NewtonControl>("Newton control", only_if(m.iterates(), 1));
  s.newton.control = inputs.newton;

  s.prescribed.patch_begin =
      arena.template constant<uint32_t>("prescribed rows of patches", m.prescribed_rows.patch_begin);
  s.prescribed.rows = arena.template constant<uint32_t>("prescribed rows", m.prescribed_rows.rows);

  inputs.faces = place_buffer<EditBuffer::kPressures, Real>(m, arena, bound.buffers);
  s.pressure.faces = inputs.faces;
  s.pressure.patch_begin = arena.template constant<uint32_t>("pressed rows of patches", m.pressure.patch_begin);
  s.pressure.rows = arena.template constant<uint32_t>("pressed rows", m.pressure.rows);
  s.pressure.corner_begin = arena.template constant<uint32_t>("pressed corner offsets", m.pressure.corner_begin);
  s.pressure.corners = arena.template constant<uint32_t>("pressed corners", m.pressure.corners);
  s.pressure.slots = arena.template constant<uint32_t>("pressed corner slots", m.pressure.slots);

  s.guard.patch_tetrahedra = arena.template constant<uint32_t>("checked tetrahedra of patches", m.checked.begin);
  s.guard.tetrahedron_rows = place_buffer<EditBuffer::kCheckedTetrahedra, Real>(m, arena, bound.buffers);

  s.matrix.edges = arena.template zeros<Real>("matrix", 9 * std::size_t{layout.slot_count()});
  const bool lags = m.lags();
  s.matrix.lag_strain = static_cast<Real>(m.lag_strain);
  s.matrix.kept_edges = arena.template zeros<Real>("kept tensors", only_if(lags, 9 * std::size_t{layout.slot_count()}));
  s.matrix.kept_diagonal = arena.template zeros<Real>("kept diagonal", only_if(lags && edges, 8 * rows));
  s.matrix.kept_force = arena.template zeros<Real>("kept forces", only_if(lags, 4 * rows));
  s.matrix.kept_ahead = arena.template zeros<Real>("moves ahead of kept tensors", only_if(lags && edges, 4 * local));
  s.matrix.kept_touched =
      arena.template zeros<uint32_t>("slices with new tensors", only_if(lags && !edges, rows / view::kSliceRows));
  s.matrix.diagonal = arena.template zeros<Real>("matrix diagonal", 8 * rows);
  s.matrix.rhs = arena.template zeros<Real>("right-hand side", 4 * rows);
  s.solve.solution = arena.template zeros<Real>("solution", 4 * rows);
  s.solve.kept = arena.template zeros<Real>("solutions of steps", only_if(!m.iterates(), 2 * 4 * rows));
  s.solve.residual = arena.template zeros<Real>("residual", only_if(!m.solve_keeps_vectors, 4 * local));
  s.solve.direction = arena.template zeros<Real>("direction", only_if(!m.solve_keeps_vectors, 4 * local));
  s.solve.product = arena.template zeros<Real>("product", 2 * 4 * rows);

  s.contact.triangle_rows = place_buffer<EditBuffer::kTriangleRows, Real>(m, arena, bound.buffers);
  s.contact.triangle_neighbours = place_buffer<EditBuffer::kTriangleNeighbours, Real>(m, arena, bound.buffers);
  s.contact.patch_triangles =
      arena.template constant<uint32_t>("contact triangles of patches", m.contact.patch_triangles);
  // Without editing nothing lies behind what exists: it ends where the next one begins.
  const auto end_or_next = [](const uint32_t* end, const uint32_t* begin) {
    return end != nullptr || begin == nullptr ? end : begin + 1;
  };
  s.contact.triangles_end =
      end_or_next(place_buffer<EditBuffer::kTrianglesEnd, Real>(m, arena, bound.buffers), s.contact.patch_triangles);
  s.contact.triangle_area = place_buffer<EditBuffer::kTriangleAreas, Real>(m, arena, bound.buffers);
  s.contact.triangle_moduli = place_buffer<EditBuffer::kTriangleModuli, Real>(m, arena, bound.buffers);
  s.contact.vertex_of_corner = place_buffer<EditBuffer::kCornerVertices, Real>(m, arena, bound.buffers);
  s.contact.surface_rows = place_buffer<EditBuffer::kSurfaceRows, Real>(m, arena, bound.buffers);
  s.contact.patch_surface = arena.template constant<uint32_t>("contact rows of patches", m.contact.patch_surface);
  s.contact.surface_end =
      end_or_next(place_buffer<EditBuffer::kSurfaceEnd, Real>(m, arena, bound.buffers), s.contact.patch_surface);
  s.contact.incidence_begin = arena.template constant<uint32_t>("contact incidence offsets", m.contact.incidence_begin);
  s.contact.incidence_end =
      end_or_next(place_buffer<EditBuffer::kIncidenceEnd, Real>(m, arena, bound.buffers), s.contact.incidence_begin);
  s.contact.incidence = place_buffer<EditBuffer::kIncidence, Real>(m, arena, bound.buffers);
  const CarriedTriangles& carried = m.contact.carried;
  s.contact.carried.first = m.contact.outer_count();
  s.contact.carried.rows = arena.template constant<uint32_t>("carried triangles", carried.rows);
  s.contact.carried.weights = arena.template constant<Real>("weights of carried triangles", carried.weights);
  // Weights of no triangle, but readable (contact::TriangleRows).
  if (carried.weights.empty()) s.contact.carried.weights = s.state.rest;
  s.contact.carried.twins = arena.template constant<uint32_t>("twins of carried triangles", carried.twins);
  s.contact.carried.patch_triangles =
      arena.template constant<uint32_t>("carried triangles of patches", carried.patch_triangles);
  s.contact.carried.patch_rows = arena.template constant<uint32_t>("carrying rows of patches", carried.patch_rows);
  s.contact.carried.entry_begin = arena.template constant<uint32_t>("offsets of carrying rows", carried.entry_begin);
  s.contact.carried.entries = arena.template constant<uint32_t>("carrying rows", carried.entries);
  s.contact.carried.around_begin =
      arena.template constant<uint32_t>("offsets of carried triangles around vertices", carried.around_begin);
  s.contact.carried.around = arena.template constant<uint32_t>("carried triangles around vertices", carried.around);
  s.contact.closest = arena.template zeros<view::ClosestTriangle<Real>>("contact closest", m.core_points() * patches);
  s.contact.contacts = arena.template zeros<view::TriangleContact<Real>>("contacts", m.contact_points() * triangles);
  s.contact.samples = arena.template constant<float>("tool samples", m.tool_samples);
  const std::size_t frictions = only_if(m.has_friction(), m.contact_points() * triangles);
  s.contact.frictions = arena.template zeros<view::TriangleFriction<Real>>("friction", frictions);
  const std::size_t slips = 4 * only_if(m.contacts_remember(), m.contact_points() * triangles);
  s.contact.slips = arena.template zeros<Real>("friction slips", slips);
  s.contact.checkpoint_slips = arena.template zeros<Real>("checkpoint friction slips", slips);

  const Links& links = m.links;
  s.links.candidate_count = links.candidate_count();
  s.links.spring_count = links.spring_count();
  s.links.leaf_count = links.leaf_count();
  s.links.patch_rows = arena.template constant<uint32_t>("linked rows of patches", links.patch_rows);
  s.links.rows = arena.template constant<uint32_t>("linked rows", links.rows);
  s.links.row_place = arena.template constant<uint32_t>("places of linked rows", links.row_place);
  s.links.leaf_triangles = arena.template constant<uint32_t>("triangles in boxes", links.leaf_triangles);
  s.links.boxes =
      arena.template zeros<view::AxisBox<Real>>("boxes", links.leaf_count() + links.leaf_count() / view::kGroupLeaves);
  s.links.patch_candidates = arena.template constant<uint32_t>("contact candidates of patches", links.patch_candidates);
  s.links.candidates = arena.template constant<uint32_t>("contact candidates", links.candidates);
  s.links.candidate_area = arena.template constant<Real>("areas of contact candidates", links.candidate_area);
  s.links.candidate_modulus = place_buffer<EditBuffer::kCandidateModuli, Real>(m, arena, bound.buffers);
  s.links.side_groups = arena.template constant<uint32_t>("boxes of bodies", links.side_groups);
  s.links.side_numbers = arena.template constant<Real>("contacts of bodies", links.side_numbers);
  const std::size_t edge_slots = links.edge_slot_count(), edges_from = 4 * std::size_t{links.candidate_count()};
  view::BladesView<Real>& blades = s.links.blades;
  blades.blade_count = links.blades.count();
  blades.point_count = links.blades.point_count();
  blades.patch_count = layout.patch_count;
  const std::size_t blades_from = edges_from + view::kEdgeMemory * edge_slots;
  const std::size_t link_slips = blades_from + blades.reals();
  s.links.slips = arena.template zeros<Real>("friction slips of bodies", link_slips);
  s.links.checkpoint_slips = arena.template zeros<Real>("checkpoint friction slips of bodies", link_slips);
  s.links.edges.candidate_count = links.edge_candidate_count();
  s.links.edges.rows = arena.template constant<uint32_t>("sharp edges", links.edge_rows);
  s.links.edges.numbers = place_buffer<EditBuffer::kEdgeNumbers, Real>(m, arena, bound.buffers);
  s.links.edges.triangle_edges = arena.template constant<uint32_t>("sharp edges of triangles", links.triangle_edges);
  s.links.edges.patch_candidates =
      arena.template constant<uint32_t>("edge candidates of patches", links.patch_edge_candidates);
  s.links.edges.candidates = arena.template constant<uint32_t>("edge candidates", links.edge_candidates);
  s.links.edges.partners = arena.template zeros<uint32_t>("partners of edges", edge_slots);
  if (edge_slots > 0) {
    s.links.edges.memory = s.links.slips + edges_from;
    s.links.edges.checkpoint_memory = s.links.checkpoint_slips + edges_from;
  }
  blades.tools = arena.template constant<uint32_t>("blades", links.blades.tools);
  blades.first_points = arena.template constant<uint32_t>("points of blades", links.blades.first_points);
  blades.rows = arena.template constant<uint32_t>("tetrahedra", links.blades.rows);
  blades.neighbours = arena.template constant<uint32_t>("neighbours of tetrahedra", links.blades.neighbours);
  blades.toughness = arena.template constant<Real>("toughness of tetrahedra", links.blades.toughness);
  blades.patch_tetrahedra = arena.template constant<uint32_t>("tetrahedra of patches", links.blades.patch_tetrahedra);
  blades.tetrahedra = arena.template constant<uint32_t>("tetrahedra by patch", links.blades.tetrahedra);
  if (blades.point_count > 0) {
    blades.memory = s.links.slips + blades_from;
    blades.checkpoint_memory = s.links.checkpoint_slips + blades_from;
  }
  s.links.patch_springs = arena.template constant<uint32_t>("springs of patches", links.patch_springs);
  s.links.spring_rows = arena.template constant<uint32_t>("springs", links.spring_rows);
  s.links.spring_numbers = arena.template constant<Real>("stiffness of springs", links.spring_numbers);
  s.links.broken = arena.template zeros<Real>("broken springs", links.spring_count());
  s.links.checkpoint_broken = arena.template zeros<Real>("checkpoint broken springs", links.spring_count());
  s.links.links = arena.template zeros<view::Link<Real>>("links", links.count());
  s.links.head = arena.template zeros<uint32_t>("lists of links", only_if(links.count() > 0, rows));
  s.links.next = arena.template zeros<uint32_t>("entries of lists of links", 4 * std::size_t{links.count()});

  const FreeBodies& free = m.free_bodies;
  s.balance.body_count = free.count();
  s.balance.row_body = place_buffer<EditBuffer::kRowBodies, Real>(m, arena, bound.buffers);
  s.balance.center_rows = place_buffer<EditBuffer::kCenterRows, Real>(m, arena, bound.buffers);
  s.balance.patch_entries = arena.template constant<uint32_t>("free bodies of patches", free.patch_entries);
  s.balance.entry_body = arena.template constant<uint32_t>("free bodies by patch", free.entry_body);
  s.balance.body_begin = arena.template constant<uint32_t>("patches of free bodies", free.body_begin);
  s.balance.body_entries = arena.template constant<uint32_t>("patches by free body", free.body_entries);
  s.balance.start_velocity =
      arena.template zeros<Real>("velocity before the solve", only_if(free.count() > 0, 4 * rows));
  s.balance.sums = arena.template zeros<view::BalanceSums>("missing momentum of patches", free.entry_body.size());
  s.balance.totals = arena.template zeros<view::BalanceSums>("missing momentum", free.count());
  s.balance.corrections = arena.template zeros<view::BodyCorrection<Real>>("rigid motions of bodies", free.count());
  s.balance.partner_begin = arena.template constant<uint32_t>("partners of free bodies", free.partner_begin);
  s.balance.partners = arena.template constant<uint32_t>("partners", free.partners);
  s.balance.entry_partners = arena.template constant<uint32_t>("partners by patch", free.entry_partners);
  const std::size_t coupled = only_if(!free.entry_partners.empty(), std::size_t{6} * free.count());
  s.balance.partner_sums = arena.template zeros<view::PartnerSums>("coupling of partners", free.partner_sum_count());
  s.balance.system = arena.template zeros<double>("system of rigid motions", coupled * coupled);
  s.balance.motions = arena.template zeros<double>("motions of partners", coupled);

  s.surface.vertex_count = m.visible.point_count();
  s.surface.rows = place_buffer<EditBuffer::kVisibleRows, Real>(m, arena, bound.buffers);
  s.surface.weights = place_buffer<EditBuffer::kVisibleWeights, Real>(m, arena, bound.buffers);
  s.surface.positions = arena.template zeros<float>("visible positions", 3 * std::size_t{m.visible.point_count()});

  s.solve.reduction = arena.template zeros<Real>("partial sums", 2 * patches * view::kPatchSums);
  s.solve.exchange_tags = arena.template zeros<uint32_t>("exchange tags", patches);
  return bound;
}

/// Allocates the exchange and the other buffers of a scene from one arena.
template <class Real, class Arena>
BoundScene<Real> bind(const Model& m, Arena& arena) {
  return bind<Real>(m, arena, make_exchange<Real>(m, arena));
}

/// Allocates the buffers of the coarse level. `aggregate_count` is 0 if the scene has none.
template <class Real, class Arena>
view::CoarseView<Real> bind_coarse(const Model& m, Arena& arena) {
  const std::size_t count = m.aggregates.count(), n = view::kRigidModes * count, patches = m.layout.patch_count;
  const std::size_t local = count > 0 ? std::size_t{m.layout.row_count} + m.layout.halo.size() : 0;
  const std::size_t padded = view::kCoarseStride * count;
  view::CoarseView<Real> c{};
  c.aggregate_count = m.aggregates.count();
  c.row_aggregate = arena.template constant<std::uint32_t>("aggregates of rows", m.aggregates.row_aggregate);
  c.center_rows = arena.template constant<std::uint32_t>("centres of aggregates", m.aggregates.center_rows);
  c.inverse_sizes = arena.template constant<Real>("sizes of aggregates", m.aggregates.inverse_sizes);
  const bool edges = m.layout.storage == matrix::Storage::kEdges;
  c.sums = arena.template zeros<double>("coarse matrix of patches", (edges ? patches : 1) * n * n);
  c.factor = arena.template zeros<double>("coarse matrix", edges ? n * n : 0);
  c.lower = arena.template zeros<Real>("coarse factor", n * n);
  c.upper = arena.template zeros<Real>("transposed coarse factor", n * n);
  c.inverse_pivots = arena.template zeros<Real>("coarse pivots", edges ? n : 0);
  c.rows = arena.template zeros<Real>("rigid modes of rows", view::kCoarseRowReals * local);
  c.exchanged = arena.template zeros<Real>("coarse sums", 2 * view::kCoarseExchanged * patches * padded);
  const std::size_t rows = count > 0 ? m.layout.row_count : 0;
  c.row_sums = arena.template zeros<double>("sums of rows", 9 * rows);
  c.row_errors = arena.template zeros<Real>("rounding errors of rows", 9 * rows);
  c.row_losses = arena.template zeros<Real>("rounding losses of rows", view::kRowLossReals * rows);
  c.vectors = arena.template zeros<Real>("coarse vectors", edges ? patches * view::kCoarseVectors * padded : 0);
  return c;
}

/// Returns whether four reals can be read at once from here on; true for nullptr.
template <class Real>
bool is_aligned(const Real* reals) {
  return reinterpret_cast<std::uintptr_t>(reals) % (4 * sizeof(float)) == 0;
}

/// Writes the records of a group (view/elements.h): rest shapes and parameters, element by element.
/// to: [stride][record_reals], zeros
template <class Real>
void write_records(const ElementGroup& group, Real* to) {
  const std::size_t stride = group.stride, parameters = group.parameters.size() / stride;
  const std::size_t reals = group.rest.size() / stride / group.point_count, record = group.record_reals();
  const std::size_t step = view::point_stride(static_cast<std::uint32_t>(reals), group.point_count);
  constexpr std::size_t kGrain = 16384;
  parallel_ranges(stride, kGrain, [&](std::size_t begin, std::size_t end) {
    for (std::size_t e = begin; e < end; ++e) {
      Real* own = to + e * record;
      for (std::size_t q = 0; q < group.point_count; ++q) {
        for (std::size_t c = 0; c < reals; ++c) {
          own[q * step + c] = static_cast<Real>(group.rest[(q * reals + c) * stride + e]);
        }
      }
      for (std::size_t c = 0; c < parameters; ++c) {
        own[group.point_count * step + c] = static_cast<Real>(group.parameters[c * stride + e]);
      }
    }
  });
}

/// Returns the turn of each element (matrix/lagged_tangents.h), which is that of the slice with its first node: an edit
/// that takes the element's material away leaves that node. By edges, slices take turns one after the other, so that
/// every patch has elements in each step. By rows, neighbouring slices take theirs together: the tensors of few slices
/// are then summed anew.
inline std::vector<std::uint32_t> turns_of(const Model& m, const ElementGroup& group) {
  std::vector<std::uint32_t> out(group.rows.begin(), group.rows.begin() + group.stride);
  const std::uint64_t slices = m.layout.row_count / view::kSliceRows;
  const bool edges = m.layout.storage == matrix::Storage::kEdges;
  for (std::uint32_t& turn : out) {
    const std::uint64_t slice = turn / view::kSliceRows;
    turn = static_cast<std::uint32_t>(edges ? slice % m.lag_steps : slice * m.lag_steps / slices);
  }
  return out;
}

/// Allocates the buffers of one group. buffers: where those are that edits change; may be null.
template <class Real, class Arena>
view::ElementView<Real> bind(const Model& m, std::size_t group_index, Arena& arena,
                             GroupBuffers<Real>* buffers = nullptr) {
  GroupBuffers<Real> placed;
  TM_ASSERT(group_index < m.groups.size(), "the model has the group");
  const ElementGroup& group = m.groups[group_index];
  view::ElementView<Real> e{};
  e.count = group.stride;
  e.point_count = group.point_count;
  e.report_begin = static_cast<std::uint32_t>(group_index) * m.layout.patch_count;
  placed.rows = arena.template constant<std::uint32_t>("element rows", group.rows);
  e.rows = placed.rows;
  physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
    using Shape = typename decltype(shape)::Type;
    // A single point with mean gradients does not exist in the reference shape.
    const bool is_mean = group.point_count == 1 && !Shape::kSinglePoint;
    if (index != group.shape || !group.checks_volume || group.solve_checks_volume || is_mean) return;
    const std::vector<double> gradients = physics::reference_gradients<Shape>();
    e.reference_points = static_cast<std::uint32_t>(gradients.size() / (3 * Shape::kNodes));
    e.reference_gradients = arena.template constant<Real>("reference gradients", gradients);
  });
  if (m.layout.storage == matrix::Storage::kEdges) {
    placed.rest = arena.template constant<Real>("element rest shapes", group.rest);
    e.rest = placed.rest;
    placed.parameters = arena.template constant<Real>("element parameters", group.parameters);
    e.parameters = placed.parameters;
  } else {
    e.record_reals = group.record_reals();
    placed.records = arena.template generated<Real>("element records", std::size_t{group.stride} * e.record_reals,
                                                    [&](Real* to) { write_records(group, to); });
    e.records = placed.records;
    const bool decomposes = physics::decomposes(group.law) && !group.is_constant && !m.lags(group);
    e.decompositions = arena.template zeros<Real>(
        "decompositions", decomposes ? std::size_t{e.count} * e.point_count * view::kDecompositionReals : 0);
    TM_ASSERT(is_aligned(e.records) && is_aligned(e.decompositions), "four reals of a record are read at once");
    const matrix::RowLists& lists = group.row_lists;
    e.slice_count = static_cast<std::uint32_t>(lists.slices.size());
    e.slices = arena.template constant<view::ListedSlice>("slices of elements", lists.slices);
    e.listed = arena.template constant<std::uint32_t>("element lists", lists.listed);
    e.place_bits = lists.place_bits;
    e.places = arena.template constant<std::uint32_t>("places of elements", lists.places);
  }
  e.moduli_weights = arena.template constant<view::ModuliWeights<Real>>("selective integration", group.shares);
  TM_ASSERT(group.prony.size() <= std::size(e.prony), "the view has room for the Prony terms");
  e.prony_count = static_cast<std::uint32_t>(group.prony.size());
  for (std::size_t i = 0; i < group.prony.size(); ++i) {
    e.prony[i] = {static_cast<Real>(group.prony[i].share), static_cast<Real>(group.prony[i].relaxation_time_s)};
  }
  e.patch_elements = arena.template constant<std::uint32_t>("elements of patches", group.patch_elements);
  if (m.lags(group)) {
    const auto is_lagged = [&m](const ElementGroup& one) { return m.lags(one); };
    e.begins_kept = &group == &*std::find_if(m.groups.begin(), m.groups.end(), is_lagged) ? 1 : 0;
    physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
      if (index != group.shape) return;
      constexpr std::size_t kReals = matrix::kKeptReals<typename decltype(shape)::Type>;
      e.kept = arena.template zeros<Real>("kept tensors of elements", group.stride * kReals);
    });
    e.turns = arena.template constant<std::uint32_t>("turns of elements", turns_of(m, group));
  }
  e.pair_places = arena.template constant<std::uint32_t>("element places", group.pair_places);
  e.internal_variables = arena.template zeros<Real>("viscoelastic internal variables", group.internal_variable_reals());
  e.checkpoint_internal_variables =
      arena.template zeros<Real>("checkpoint internal variables", group.internal_variable_reals());
  if (buffers != nullptr) *buffers = placed;
  return e;
}

}  // namespace tensormass::model
