#pragma once

#include <algorithm>
#include <string_view>

#include "core/parallel.h"
#include "model/model.h"
#include "physics/lists.h"

/// The one place that says which buffers a model needs. The same function fills a view in host memory, in device
/// memory, or, with an arena that only counts, lists the buffers for the plan.
///
/// An Arena has
///   const T* constant<T>(name, const std::vector<U>&)  a copy, converted by static_cast; nullptr for an empty vector
///   T* zeros<T>(name, count)                           zeroed memory; nullptr for no items
///   const T* generated<T>(name, count, fill)           what fill(T*) writes over zeros; nullptr for no items
namespace tensormass::model {

/// What a step is told and what it reports. A device may have it elsewhere than its other buffers.
template <class Real>
struct StepExchange {
  const tensor::StepControl<Real>* control;
  const tensor::ToolState<Real>* tools;
  const Real* prescribed;
  tensor::SolveReport<Real>* solve_report;
  tensor::PatchReport<Real>* patch_reports;
  tensor::PatchResidual<Real>* residuals;
  tensor::PatchWatch<Real>* watch;
  Real* min_det_f;
  tensor::ToolLoad<Real>* tool_loads;
};

template <class Real, class Arena>
StepExchange<Real> make_exchange(const Model& m, Arena& arena) {
  const std::size_t patches = m.layout.patch_count, tools = m.tools.size(), groups = m.groups.size();
  StepExchange<Real> e{};
  e.control = arena.template zeros<tensor::StepControl<Real>>("step control", 1);
  e.tools = arena.template zeros<tensor::ToolState<Real>>("tools", tools);
  e.prescribed = arena.template zeros<Real>("prescribed displacements", 4 * m.prescribed.size());
  e.solve_report = arena.template zeros<tensor::SolveReport<Real>>("solve report", 1);
  e.patch_reports = arena.template zeros<tensor::PatchReport<Real>>("patch reports", patches);
  e.residuals = arena.template zeros<tensor::PatchResidual<Real>>("residuals", m.iterates() ? patches : 0);
  e.watch = arena.template zeros<tensor::PatchWatch<Real>>("watch", groups * patches);
  e.min_det_f = arena.template zeros<Real>("volume check", m.checks_volume() ? groups * patches : 0);
  e.tool_loads = arena.template zeros<tensor::ToolLoad<Real>>("tool loads", tools * patches);
  return e;
}

template <class Real, class Arena>
tensor::SceneView<Real> bind(const Model& m, Arena& arena, const StepExchange<Real>& exchange) {
  using std::uint32_t;
  const tensor::Layout& layout = m.layout;
  const std::size_t rows = layout.row_count, patches = layout.patch_count, tools = m.tools.size();
  const std::size_t local = rows + layout.halo.size();
  const std::size_t triangles = m.contact.triangle_count();
  const auto only_if = [](bool needed, std::size_t count) { return needed ? count : 0; };
  tensor::SceneView<Real> s{};
  s.row_count = layout.row_count;
  s.patch_count = layout.patch_count;
  s.tool_count = static_cast<uint32_t>(tools);
  s.triangle_count = m.contact.triangle_count();
  s.control = exchange.control;
  s.tools = exchange.tools;
  s.prescribed = exchange.prescribed;
  s.solve_report = exchange.solve_report;
  s.patch_reports = exchange.patch_reports;
  s.residuals = exchange.residuals;
  s.watch = exchange.watch;
  s.min_det_f = exchange.min_det_f;
  s.tool_loads = exchange.tool_loads;
  s.cg_tolerance = static_cast<Real>(m.cg_tolerance);
  s.size_m = static_cast<Real>(m.size_m);

  s.patch_rows = arena.template constant<uint32_t>("patch rows", layout.patch_rows);
  s.patch_halo = arena.template constant<uint32_t>("patch halo offsets", layout.patch_halo);
  s.halo = arena.template constant<uint32_t>("halo rows", layout.halo);
  const bool edges = layout.storage == tensor::Storage::kEdges;
  s.slice_begin = arena.template constant<uint32_t>("matrix slices", layout.slice_begin);
  s.columns = arena.template constant<uint32_t>("matrix columns", layout.columns);
  s.tile_rows = layout.tile_rows;
  s.slice_read = arena.template constant<uint32_t>("matrix slices' columns to be read", layout.slice_read);
  s.used_twice = arena.template constant<uint32_t>("matrix blocks of two rows", layout.used_twice);
  s.slice_halo = arena.template constant<uint32_t>("matrix slices' halo", layout.slice_halo);
  s.patch_boundary = arena.template constant<uint32_t>("boundary rows of patches", layout.patch_boundary);
  s.boundary = arena.template constant<uint32_t>("boundary rows", layout.boundary);
  s.own_product = arena.template zeros<Real>("own product", only_if(edges, 4 * rows));

  s.constant_edges = arena.template constant<Real>("constant edge tensors", m.constant_edges);

  s.begun_slices = arena.template constant<std::uint8_t>("begun rows", m.begun_slices);

  s.displacement = arena.template zeros<Real>("displacement", 4 * rows);
  s.velocity = arena.template zeros<Real>("velocity", 4 * rows);
  s.rest = arena.template constant<Real>("rest positions", m.rest);
  s.relative_position = arena.template zeros<Real>("relative positions", only_if(edges && m.checks_volume(), 4 * rows));
  s.inertia = arena.template constant<Real>("inertia", m.inertia);
  s.external = arena.template constant<Real>("external forces", m.external);
  s.mass_edges = arena.template constant<Real>("consistent mass", m.mass_edges);

  const bool two_steps = m.integrator == Integrator::kBdf2;
  s.base_displacement = arena.template zeros<Real>("base displacement", only_if(!m.is_plain(), 4 * rows));
  s.base_velocity = arena.template zeros<Real>("base velocity", only_if(!m.is_plain(), 4 * rows));
  s.previous_displacement = arena.template zeros<Real>("previous displacement", only_if(two_steps, 4 * rows));
  s.previous_velocity = arena.template zeros<Real>("previous velocity", only_if(two_steps, 4 * rows));
  s.kept_displacement = arena.template zeros<Real>("kept displacement", 4 * rows);
  s.kept_velocity = arena.template zeros<Real>("kept velocity", 4 * rows);
  s.kept_previous_displacement = arena.template zeros<Real>("kept previous displacement", only_if(two_steps, 4 * rows));
  s.kept_previous_velocity = arena.template zeros<Real>("kept previous velocity", only_if(two_steps, 4 * rows));
  s.increment = arena.template zeros<Real>("increment", only_if(m.iterates(), 4 * rows));
  s.iterate = arena.template zeros<Real>("iterate", only_if(m.iterates(), 4 * rows));
  s.internal_force = arena.template zeros<Real>("internal forces", only_if(m.iterates(), 4 * rows));
  s.newton = arena.template zeros<tensor::NewtonControl>("outer iteration", only_if(m.iterates(), 1));

  s.patch_driven = arena.template constant<uint32_t>("driven rows of patches", m.driven.patch_driven);
  s.driven = arena.template constant<uint32_t>("driven rows", m.driven.driven);

  s.pressure_faces = arena.template constant<tensor::PressureFace<Real>>("pressure faces", m.pressure.faces);
  s.patch_pressed = arena.template constant<uint32_t>("pressed rows of patches", m.pressure.patch_pressed);
  s.pressed_rows = arena.template constant<uint32_t>("pressed rows", m.pressure.pressed_rows);
  s.pressed_begin = arena.template constant<uint32_t>("pressed corner offsets", m.pressure.pressed_begin);
  s.pressed_corners = arena.template constant<uint32_t>("pressed corners", m.pressure.pressed_corners);

  s.patch_tetrahedra = arena.template constant<uint32_t>("checked tetrahedra of patches", m.checked.begin);
  s.tetrahedron_rows = arena.template constant<std::uint16_t>("checked tetrahedra", m.checked.rows);

  s.edges = arena.template zeros<Real>("matrix", 9 * std::size_t{layout.slot_count()});
  s.diagonal = arena.template zeros<Real>("matrix diagonal", 8 * rows);
  s.rhs = arena.template zeros<Real>("right-hand side", 4 * rows);
  s.solution = arena.template zeros<Real>("solution", 4 * rows);
  s.residual = arena.template zeros<Real>("residual", only_if(!m.solve_keeps_vectors, 4 * local));
  s.direction = arena.template zeros<Real>("direction", only_if(!m.solve_keeps_vectors, 4 * local));
  s.product = arena.template zeros<Real>("product", 2 * 4 * rows);

  s.triangle_rows = arena.template constant<uint32_t>("contact triangles", m.contact.triangle_rows);
  s.triangle_neighbours = arena.template constant<uint32_t>("contact neighbours", m.contact.triangle_neighbours);
  s.patch_triangles = arena.template constant<uint32_t>("contact triangles of patches", m.contact.patch_triangles);
  s.triangle_area = arena.template constant<Real>("contact areas", m.contact.triangle_area);
  s.vertex_of_corner = arena.template constant<uint32_t>("contact corners", m.contact.vertex_of_corner);
  s.surface_rows = arena.template constant<uint32_t>("contact rows", m.contact.surface_rows);
  s.patch_surface = arena.template constant<uint32_t>("contact rows of patches", m.contact.patch_surface);
  s.incidence_begin = arena.template constant<uint32_t>("contact incidence offsets", m.contact.incidence_begin);
  s.incidence = arena.template constant<uint32_t>("contact incidence", m.contact.incidence);
  s.closest = arena.template zeros<tensor::ClosestTriangle<Real>>("contact closest", tools * patches);
  s.contacts = arena.template zeros<tensor::TriangleContact<Real>>("contacts", tools * triangles);

  s.visible_count = m.visible.count();
  s.visible_rows = arena.template constant<uint32_t>("visible rows", m.visible.rows);
  s.visible_weights = arena.template constant<Real>("visible weights", m.visible.weights);
  s.visible_positions = arena.template zeros<float>("visible positions", 3 * std::size_t{m.visible.count()});

  s.reduction = arena.template zeros<Real>("partial sums", 2 * patches * tensor::kPatchSums);
  s.exchange_tags = arena.template zeros<uint32_t>("exchange tags", patches);
  return s;
}

/// All of it from one arena.
template <class Real, class Arena>
tensor::SceneView<Real> bind(const Model& m, Arena& arena) {
  return bind<Real>(m, arena, make_exchange<Real>(m, arena));
}

/// Rest shapes and parameters of a group, element by element (tensor::record_reals).
template <class Real>
void write_records(const ElementGroup& group, Real* to) {
  const std::size_t stride = group.stride, parameters = group.parameters.size() / stride;
  const std::size_t reals = group.rest.size() / stride / group.point_count, record = group.record_reals();
  const std::size_t step = tensor::point_stride(static_cast<std::uint32_t>(reals), group.point_count);
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

template <class Real, class Arena>
tensor::ElementView<Real> bind(const Model& m, std::size_t group_index, Arena& arena) {
  const ElementGroup& group = m.groups[group_index];
  tensor::ElementView<Real> e{};
  e.count = group.stride;
  e.point_count = group.point_count;
  e.watch_begin = static_cast<std::uint32_t>(group_index) * m.layout.patch_count;
  e.rows = arena.template constant<std::uint32_t>("element rows", group.rows);
  physics::for_each_type(physics::Shapes{}, [&](auto shape, int index) {
    using Shape = typename decltype(shape)::Type;
    // One point of several nodes' mean gradients is no point of the reference shape.
    const bool is_mean = group.point_count == 1 && !Shape::kSinglePoint;
    if (index != group.shape || !group.checks_volume || group.solve_checks_volume || is_mean) return;
    const std::vector<double> gradients = physics::reference_gradients<Shape>();
    e.reference_points = static_cast<std::uint32_t>(gradients.size() / (3 * Shape::kNodes));
    e.reference_gradients = arena.template constant<Real>("reference gradients", gradients);
  });
  if (m.layout.storage == tensor::Storage::kEdges) {
    e.rest = arena.template constant<Real>("element rest shapes", group.rest);
    e.parameters = arena.template constant<Real>("element parameters", group.parameters);
  } else {
    e.record_reals = group.record_reals();
    e.records = arena.template generated<Real>("element records", std::size_t{group.stride} * e.record_reals,
                                               [&](Real* to) { write_records(group, to); });
    const bool decomposes = physics::decomposes(group.law) && !group.is_constant;
    e.decompositions = arena.template zeros<Real>(
        "decompositions", decomposes ? std::size_t{e.count} * e.point_count * tensor::kDecompositionReals : 0);
    const tensor::RowLists& lists = group.row_lists;
    e.slice_count = static_cast<std::uint32_t>(lists.slices.size());
    e.slices = arena.template constant<tensor::ListedSlice>("slices of elements", lists.slices);
    e.listed = arena.template constant<std::uint32_t>("element lists", lists.listed);
    e.place_bits = lists.place_bits;
    e.places = arena.template constant<std::uint32_t>("places of elements", lists.places);
  }
  e.shares = arena.template constant<tensor::ModuliWeights<Real>>("selective integration", group.shares);
  e.prony_count = static_cast<std::uint32_t>(group.prony.size());
  for (std::size_t i = 0; i < group.prony.size(); ++i) {
    e.prony[i] = {static_cast<Real>(group.prony[i].share), static_cast<Real>(group.prony[i].relaxation_time_s)};
  }
  e.patch_elements = arena.template constant<std::uint32_t>("elements of patches", group.patch_elements);
  e.pair_places = arena.template constant<std::uint32_t>("element places", group.pair_places);
  e.history = arena.template zeros<Real>("stress histories", group.history_reals());
  e.kept_history = arena.template zeros<Real>("kept stress histories", group.history_reals());
  return e;
}

}  // namespace tensormass::model
