#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "matrix/layout.h"
#include "matrix/patch_tetrahedra.h"
#include "matrix/row_lists.h"
#include "mesh/mesh.h"
#include "physics/element/prony.h"
#include "physics/element/rest.h"
#include "solver/time_scheme.h"

/// A compiled scene: immutable, in double precision, and nothing in it that the scene does not need. An empty vector
/// means that the scene has no use for it; no backend allocates a buffer for it.
namespace tensormass::model {

/// Who runs the linear solve and what belongs to it (step/stages.h).
enum class SolveKind : std::uint8_t {
  kStages,    ///< scaling, conjugate gradients and `advance` are stages
  kResident,  ///< one GPU kernel for all of them; the matrix stays on the chip
  kStreamed,  ///< one GPU kernel; the matrix comes from memory in each iteration
};

/// Elements of one (shape, law); of one body if the law is linear or has a memory.
struct ElementGroup {
  int shape = 0;  ///< index into physics::Shapes
  int law = 0;    ///< index into physics::Laws
  std::uint32_t element_count = 0;
  std::uint32_t stride = 0;                    ///< places: a multiple of kSliceRows, at least element_count
  bool is_constant = false;                    ///< the tensors are in Model::constant_edges
  std::uint32_t point_count = 0;               ///< quadrature points of an element
  std::vector<physics::ModuliWeights> shares;  ///< [point_count]; empty: each integrates all moduli
  std::vector<physics::PronyTerm> prony;       ///< empty: no memory
  /// [place] index in the scene's mesh; mesh::kNone where an element is computed once more for another patch, and in
  /// padding. May end before the padding does.
  std::vector<std::uint32_t> elements;
  std::vector<std::uint32_t> partners;  ///< [place] of wedge pairs (wedge_pairs.h) the second; else empty
  std::vector<double> first_parts;      ///< [place] the first's part of a pair's volume; else empty
  std::vector<std::uint32_t> rows;      ///< [shape nodes][stride]
  std::vector<double> rest;             ///< [point_count][rest reals][stride]
  std::vector<double> parameters;       ///< [law parameters][stride]
  matrix::RowLists row_lists;           ///< but for Storage::kEdges, of refreshed tensors
  // Only with Storage::kEdges, see ElementView:
  std::vector<std::uint32_t> patch_elements;  ///< [patch_count, 2]
  std::vector<std::uint32_t> pair_places;     ///< [pairs][stride]; empty if the tensors are constant
  /// Its law is Inversion::kCaught; a pair of wedges is looked at by its wedges.
  bool checks_volume = false;
  bool solve_checks_volume = false;  ///< with Model::checked, in place of a stage

  /// Of an element's record (view::record_reals).
  std::uint32_t record_reals() const {
    return view::record_reals(static_cast<std::uint32_t>(rest.size() / stride / point_count), point_count,
                              static_cast<std::uint32_t>(parameters.size() / stride));
  }
  bool is_wedge_pairs() const { return !partners.empty(); }
  /// Of Γ_i, [point_count][prony][6][stride].
  std::size_t internal_variable_reals() const {
    return std::size_t{point_count} * prony.size() * physics::kSymmetricReals * stride;
  }
};

/// Rows with prescribed displacements, grouped by the patch that owns them.
struct PrescribedRows {
  std::vector<std::uint32_t> patch_begin;  ///< [patch_count + 1] into rows
  std::vector<std::uint32_t> rows;         ///< [.., 3] row, index into Model::prescribed, bits of the directions
};

/// A displacement over time, the same for all of its nodes.
struct Prescribed {
  Vec3<double> displacement_m = Vec3<double>::Zero();
  std::vector<double> time_s, factor;  ///< empty: always 1
  Vec3<double> at(double time_s) const;
};

/// Boundary faces under pressure, in rows, and the corners of each row in them; grouped by patch.
struct PressureSurface {
  std::vector<view::PressureFace<double>> faces;
  std::vector<std::uint32_t> patch_begin;   ///< [patch_count + 1] into rows
  std::vector<std::uint32_t> rows;          ///< [pressed row]
  std::vector<std::uint32_t> corner_begin;  ///< [pressed row + 1] into corners
  std::vector<std::uint32_t> corners;       ///< [.., 2] face, corner
};

/// Tissue boundary for contact, in rows; grouped by the patch that owns it.
struct ContactSurface {
  std::vector<std::uint32_t> triangle_rows;        ///< [triangle_count, 3]
  std::vector<std::uint32_t> triangle_neighbours;  ///< [triangle_count, 3]
  std::vector<std::uint32_t> patch_triangles;      ///< [patch_count + 1]
  std::vector<double> triangle_area;               ///< [triangle_count] m²
  std::vector<std::uint32_t> vertex_of_corner;     ///< [triangle_count, 3]
  std::vector<std::uint32_t> surface_rows;         ///< [surface vertex]
  std::vector<std::uint32_t> patch_surface;        ///< [patch_count + 1]
  std::vector<std::uint32_t> incidence_begin;      ///< [surface vertex + 1]
  std::vector<std::uint32_t> incidence;            ///< [.., 4], see SceneView

  std::uint32_t triangle_count() const { return static_cast<std::uint32_t>(triangle_area.size()); }
};

/// Vertices that clients see, all bodies one after the other.
struct VisibleSurface {
  std::vector<std::uint32_t> rows;  ///< [visible_count, 4]
  std::vector<double> weights;      ///< [visible_count, 4]
  std::uint32_t count() const { return static_cast<std::uint32_t>(rows.size() / 4); }
};

struct BodyModel {
  std::string name;
  std::uint32_t node_begin = 0, node_count = 0;        ///< in the scene's nodes
  std::uint32_t element_begin = 0, element_count = 0;  ///< in the scene's elements
  std::uint32_t fixed_node_count = 0;                  ///< held or driven in at least one direction
  std::uint32_t component_count = 0;
  double volume_m3 = 0, mass_kg = 0, min_dihedral_angle_deg = 0;
  std::uint32_t vertex_begin = 0, vertex_count = 0;  ///< in the visible surface
  std::vector<mesh::Triangle> triangles;             ///< visible, relative to vertex_begin
  std::vector<std::uint32_t> vertex_nodes;           ///< mesh node of each visible vertex; empty for a skin
  bool has_skin = false;
  bool has_color = false;
  Vec3<double> color_srgb = Vec3<double>::Zero();
};

struct ToolModel {
  std::string name;
  double radius_m = 0;
  Vec3<double> tip_offset_m = Vec3<double>::Zero();
  double penalty_pa_per_m = 0;
  double max_speed_m_per_s = 0;
  /// E / (1 − ν²) of the stiffest law of the scene, for the local model [Pa].
  double plane_strain_modulus_pa = 0;
  Vec3<double> initial_position_m = Vec3<double>::Zero();
  std::array<double, 4> initial_orientation{1, 0, 0, 0};  ///< w x y z
};

using solver::Integrator;

struct Model {
  std::string name;
  bool double_precision = false;
  bool lockstep = false;
  double dt_s = 0;
  double rate_hz = 0;
  double frame_rate_hz = 0;
  double status_rate_hz = 0;
  Integrator integrator = Integrator::kImplicitEuler;
  std::uint32_t newton_max_iterations = 1;
  double newton_tolerance = 0;
  double cg_tolerance = 0;
  double budget_s = 0;                    ///< time that a step may take; 0: whatever it takes
  std::uint32_t floor_cg_iterations = 0;  ///< to which cg_max_iterations may be lowered for the budget
  double floor_tolerance = 0;             ///< residual above which no step is published; 0: none stated
  std::uint32_t cg_max_iterations = 0;
  Vec3<double> gravity_m_per_s2 = Vec3<double>::Zero();
  bool has_gravity = false;

  std::vector<BodyModel> bodies;
  std::vector<ToolModel> tools;
  std::vector<std::string> warnings;

  matrix::Layout layout;
  std::vector<std::uint8_t> begun_slices;  ///< see SceneView; but for Storage::kEdges
  std::vector<ElementGroup> groups;        ///< those with refreshed tensors first
  SolveKind solve = SolveKind::kStages;
  bool solve_keeps_vectors = false;    ///< the solve's vectors stay in shared memory; no buffer exists for them
  matrix::PatchTetrahedra checked;     ///< by the solve; empty: stages check
  std::vector<double> constant_edges;  ///< [slot] 3×3, blocked as SceneView; empty without linear laws
  std::vector<double> mass_edges;      ///< [slot] kg; empty for lumped mass
  double size_m = 0;                   ///< diagonal of the box around the scene at rest
  std::vector<double> rest;            ///< [row_count, 4]
  std::vector<double> inertia;         ///< [row_count, 4] as SceneView
  std::vector<double> row_mass;        ///< [row_count] kg, also where inertia leaves it out (quasi-static)
  std::vector<double> external;        ///< [row_count, 4]; empty without gravity and loads
  /// [row_count, 4] m, m/s; empty: at rest.
  std::vector<double> initial_displacement, initial_velocity;
  PrescribedRows prescribed_rows;
  std::vector<Prescribed> prescribed;
  PressureSurface pressure;
  ContactSurface contact;  ///< empty without tools
  VisibleSurface visible;  ///< empty without frames

  /// More than one linearized solve a step.
  bool iterates() const { return newton_max_iterations > 1; }
  /// Implicit Euler linearized once, without prescribed displacements: such a step needs neither û nor v̂
  /// (view/state.h). The velocity of a prescribed node differs from the v̂ that its neighbours feel through a consistent
  /// mass. It is also written before a plain step would save its checkpoint.
  bool is_plain() const {
    return integrator == Integrator::kImplicitEuler && !iterates() && prescribed_rows.rows.empty();
  }
  bool has_refreshed_tensors() const { return !groups.empty() && !groups.front().is_constant; }
  bool checks_volume() const {
    return std::any_of(groups.begin(), groups.end(), [](const ElementGroup& group) { return group.checks_volume; });
  }
};

}  // namespace tensormass::model
