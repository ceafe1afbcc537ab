#pragma once

#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "backend/backend.h"
#include "core/result.h"
#include "model/model.h"

/// The state of tissue by node, element and contact: what any backend, number of threads and storage goes on from.
///
///   SceneState ──read──> LayoutState ──by_node──> NodeState ──in_layout──> LayoutState ──write──> SceneState of
///   another
///                        one layout's order       a snapshot has it        the other's order      backend
///
/// A layout sorts nodes into rows, and elements, triangles and contacts by row, so the order of a backend's state says
/// nothing to another. These two functions are the only ones that know both orders. The order of a NodeState depends on
/// the scene alone:
///
///   nodes       as in the scene
///   elements    group by group (ElementGroup), ascending in each; a cluster counts as its first element
///   triangles   of the contact surface: by the node of the first corner, then as in the boundary of the mesh. In a
///               scene with editing as in its layout
///   candidates  nodes that may touch a surface: by node, then side (view::LinksView)
///   springs     as in the scene's attachments
///
/// A layout that computes an element in several patches has its state several times, all equal.
namespace tensormass::world {

/// The state of tissue in the order of a layout, as a backend reads and writes it.
struct LayoutState {
  backend::RowState rows;
  backend::StepHistory history;
};

/// What two sharp edges that touch remember (view::EdgeMemory).
struct EdgePair {
  using Edge = std::array<std::uint32_t, 2>;  ///< nodes at its ends, the lower one first
  std::uint32_t contact = 0;                  ///< place in Model::body_contacts
  Edge edge{}, other{};                       ///< edge < other
  std::uint32_t slot = 0;                     ///< the order in which the edge that searches adds its pairs up
  std::array<double, 3> stretch_m{};          ///< stretch of the spring of friction, as `edge` feels it
  double force_n = 0;                         ///< normal force
  std::strong_ordering operator<=>(const EdgePair& to) const {
    if (const auto order = contact <=> to.contact; order != 0) return order;
    if (const auto order = edge <=> to.edge; order != 0) return order;
    return other <=> to.other;
  }
  bool operator==(const EdgePair& to) const = default;
};

/// What a blade point remembers (view::BladeMemory), then the tetrahedron that was found around it, plus 1.
inline constexpr std::size_t kBladeReals = view::kBladeMemory + 1;

/// Arrays that the scene does not use are empty, as in backend::StepHistory.
struct NodeState {
  std::vector<double> displacement;           ///< [node_count, 3] m
  std::vector<double> velocity;               ///< [node_count, 3] m/s
  std::vector<double> previous_displacement;  ///< [node_count, 3] m
  std::vector<double> previous_velocity;      ///< [node_count, 3] m/s
  std::vector<double> solution;               ///< [node_count, 3] of the last linear solve
  std::vector<double> internal_variables;     ///< [element][quadrature point][Prony term][6] Pa
  std::vector<double> slips;                  ///< [triangle][contact point][4], see view::ContactView::slips
  std::vector<double> link_slips;             ///< [candidate][4], see view::LinksView::slips
  std::vector<std::uint8_t> broken;           ///< [spring] 1: it is broken
  std::vector<EdgePair> edge_pairs;           ///< ascending; no two of the same edges
  std::vector<double> blade_points;           ///< [blade point][kBladeReals]
  double internal_dt_s = 0;                   ///< these four as in RowState and StepHistory
  double last_dt_s = 0;
  double largest_force_squared = 0;
  std::uint32_t coarse_solves = 0;
};

/// Sizes of the arrays of a NodeState; 0: the scene does not use it.
struct NodeStateSizes {
  std::size_t nodes, previous, solution, internal_variables, slips, link_slips, broken, blade_points;
};
NodeStateSizes sizes_of(const model::Model& model);

/// Returns the state that a backend read.
NodeState by_node(const model::Model& model, const LayoutState& state);
/// Returns the state for a backend to write. state: its arrays have sizes_of(model), and check_edge_pairs accepts its
/// pairs.
///
/// The pairs of an edge are kept up to view::kEdgeSlots, those that press most: a layout decides by rounding which of
/// two equally fine bodies searches.
LayoutState in_layout(const model::Model& model, const NodeState& state);

/// Returns the triangles of the contact surface in the order of a NodeState.
std::vector<std::uint32_t> order_of_triangles(const model::Model& model);
/// Returns the elements of a group in the order of a NodeState.
std::vector<std::uint32_t> elements_of(const model::ElementGroup& group);

/// Refuses pairs that are not ascending, or that name edges which cannot touch in this scene.
Result<void> check_edge_pairs(const model::Model& model, std::span<const EdgePair> pairs);

}  // namespace tensormass::world
