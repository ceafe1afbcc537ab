#pragma once

#include <string_view>

#include "model/model.h"

/// The one place that says which buffers a model needs. The same function fills a view in host memory, in device
/// memory, or, with an arena that only counts, lists the buffers for the plan.
namespace tensormass::model {

/// An Arena has
///   const T* constant<T>(name, const std::vector<U>&)  a copy, converted; nullptr for an empty vector
///   T* zeros<T>(name, count)                           zeroed memory; nullptr for no items
template <class Real, class Arena>
tensor::SceneView<Real> bind(const Model& m, Arena& arena) {
  using std::uint32_t;
  const tensor::Layout& layout = m.layout;
  const std::size_t rows = layout.row_count, patches = layout.patch_count, tools = m.tools.size();
  const std::size_t local = rows + layout.halo.size();
  const std::size_t triangles = m.contact.triangle_count();
  tensor::SceneView<Real> s{};
  s.row_count = layout.row_count;
  s.patch_count = layout.patch_count;
  s.tool_count = static_cast<uint32_t>(tools);
  s.triangle_count = m.contact.triangle_count();
  s.dt_s = static_cast<Real>(m.dt_s);
  s.cg_tolerance = static_cast<Real>(m.cg_tolerance);
  s.cg_max_iterations = m.cg_max_iterations;

  s.patch_rows = arena.template constant<uint32_t>("patch rows", layout.patch_rows);
  s.patch_halo = arena.template constant<uint32_t>("patch halo offsets", layout.patch_halo);
  s.halo = arena.template constant<uint32_t>("halo rows", layout.halo);
  s.slice_begin = arena.template constant<uint32_t>("matrix slices", layout.slice_begin);
  s.columns = arena.template constant<uint32_t>("matrix columns", layout.columns);

  s.constant_edges = arena.template constant<Real>("constant edge tensors", m.constant_edges);

  s.partials = arena.template zeros<Real>("element tensors", m.partial_reals());
  if (!m.groups.empty()) {
    s.force_gather_begin = arena.template constant<uint32_t>("force gather offsets", m.gather.force_begin);
    s.force_gather = arena.template constant<uint32_t>("force gather", m.gather.force);
    s.edge_gather_begin = arena.template constant<uint32_t>("edge gather offsets", m.gather.edge_begin);
    s.edge_gather = arena.template constant<uint32_t>("edge gather", m.gather.edge);
  }

  s.displacement = arena.template zeros<Real>("displacement", 4 * rows);
  s.velocity = arena.template zeros<Real>("velocity", 4 * rows);
  s.rest = arena.template constant<Real>("rest positions", m.rest);
  s.inertia = arena.template constant<Real>("inertia", m.inertia);
  s.external = arena.template constant<Real>("external forces", m.external);

  s.edges = arena.template zeros<Real>("matrix", 9 * std::size_t{layout.slot_count()});
  s.diagonal = arena.template zeros<Real>("matrix diagonal", 8 * rows);
  s.rhs = arena.template zeros<Real>("right-hand side", 4 * rows);
  s.solution = arena.template zeros<Real>("solution", 4 * rows);
  s.residual = arena.template zeros<Real>("residual", 4 * local);
  s.direction = arena.template zeros<Real>("direction", 4 * local);
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
  s.tools = arena.template zeros<tensor::ToolState<Real>>("tools", tools);
  s.closest = arena.template zeros<tensor::ClosestTriangle<Real>>("contact closest", tools * patches);
  s.contacts = arena.template zeros<tensor::TriangleContact<Real>>("contacts", tools * triangles);
  s.tool_loads = arena.template zeros<tensor::ToolLoad<Real>>("tool loads", tools * patches);

  s.visible_count = m.visible.count();
  s.visible_rows = arena.template constant<uint32_t>("visible rows", m.visible.rows);
  s.visible_weights = arena.template constant<Real>("visible weights", m.visible.weights);
  s.visible_positions = arena.template zeros<float>("visible positions", 3 * std::size_t{m.visible.count()});

  s.patch_reports = arena.template zeros<tensor::PatchReport<Real>>("patch reports", patches);
  s.solve_report = arena.template zeros<tensor::SolveReport<Real>>("solve report", 1);
  s.reduction = arena.template zeros<Real>("partial sums", 2 * patches * 4);
  return s;
}

template <class Real, class Arena>
tensor::ElementView<Real> bind(const ElementGroup& group, Arena& arena) {
  tensor::ElementView<Real> e{};
  e.count = group.stride;
  e.partial_begin = group.partial_begin;
  e.rows = arena.template constant<std::uint32_t>("element rows", group.rows);
  e.rest = arena.template constant<Real>("element rest shapes", group.rest);
  e.parameters = arena.template constant<Real>("element parameters", group.parameters);
  return e;
}

}  // namespace tensormass::model
