#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "mesh/mesh.h"
#include "tensor/layout.h"

/// A compiled scene: immutable, in double precision, and nothing in it that the scene does not need. An empty vector
/// means that the scene has no use for it; no backend allocates a buffer for it.
namespace tensormass::model {

/// What a step can consist of, in the order in which the stages run.
enum class StageKind : std::uint8_t {
  kDetectContact,
  kRespondContact,
  kElements,  ///< once for each element group
  kAssemble,
  kExternalForces,
  kAssembleContact,
  kFactorize,
  kScaleEdges,
  kSolve,
  kAdvance,
  kMeasureContact,
};

struct Stage {
  StageKind kind;
  std::uint32_t group = 0;  ///< of kElements
};

/// Elements of one (shape, law) whose tensors change with the deformation.
struct ElementGroup {
  int shape = 0;  ///< index into physics::Shapes
  int law = 0;    ///< index into physics::Laws
  std::uint32_t element_count = 0;
  std::uint32_t stride = 0;         ///< element_count rounded up to a multiple of kSliceRows
  std::uint32_t partial_begin = 0;  ///< in reals
  std::uint32_t record_reals = 0;
  std::vector<std::uint32_t> rows;  ///< [shape nodes][stride]
  std::vector<double> rest;         ///< [quadrature points][rest reals][stride]
  std::vector<double> parameters;   ///< [law parameters][stride]
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
  std::uint32_t node_begin = 0, node_count = 0;  ///< in the scene's nodes
  std::uint32_t element_count = 0;
  std::uint32_t fixed_node_count = 0;
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

struct Model {
  std::string name;
  bool double_precision = false;
  bool lockstep = false;
  double dt_s = 0;
  double rate_hz = 0;
  double frame_rate_hz = 0;
  double status_rate_hz = 0;
  double cg_tolerance = 0;
  std::uint32_t cg_max_iterations = 0;
  Vec3<double> gravity_m_per_s2 = Vec3<double>::Zero();
  bool has_gravity = false;

  std::vector<BodyModel> bodies;
  std::vector<ToolModel> tools;
  std::vector<std::string> warnings;

  tensor::Layout layout;
  tensor::GatherMap gather;  ///< of `groups`
  std::vector<ElementGroup> groups;
  std::vector<double> constant_edges;  ///< [slot] 3×3, blocked as SceneView; empty without linear laws
  std::vector<double> rest;            ///< [row_count, 4]
  std::vector<double> inertia;         ///< [row_count, 4]
  std::vector<double> external;        ///< [row_count, 4]; empty without gravity and loads
  ContactSurface contact;              ///< empty without tools
  VisibleSurface visible;              ///< empty without frames

  std::vector<Stage> stages;

  std::uint64_t partial_reals() const {
    return groups.empty()
               ? 0
               : groups.back().partial_begin + std::uint64_t{groups.back().stride} * groups.back().record_reals;
  }
};

}  // namespace tensormass::model
