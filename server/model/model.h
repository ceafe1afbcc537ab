#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "core/findings.h"
#include "matrix/layout.h"
#include "matrix/patch_tetrahedra.h"
#include "matrix/row_lists.h"
#include "mesh/mesh.h"
#include "model/schedule.h"
#include "model/settings.h"
#include "model/texture.h"
#include "physics/element/prony.h"
#include "physics/element/rest.h"
#include "physics/tool/pose.h"
#include "physics/tool/tool.h"
#include "view/links.h"

namespace tensormass::v1 {
class Tool;
}

/// A compiled scene: what model::compile makes of a message, and what model/bind.h copies into buffers.
///
/// A Model is in double precision. Nothing but an Editor (edit.h) changes it after it was compiled; other values of the
/// scene make another Model (values.h). An empty vector
/// means that the scene does not need it, and no backend allocates a buffer for it. model/check.h asserts the sizes
/// that the comments state.
///
///   Model ── layout         rows, patches, slots (matrix/layout.h)
///         ── groups         elements by (shape, law), sorted by row
///         ── row fields     rest, inertia, external, ..: [row_count, 4]
///         ── slot fields    constant_edges, mass_edges
///         ── boundary       prescribed rows, pressure
///         ── surfaces       contact: what tools touch; visible: what clients see
///
///   row, slot, patch, slice   as in matrix/layout.h
///   place                     index of an element within its group, padding included
namespace tensormass::model {

/// Who runs the linear solve and what belongs to it (step/stages.h).
enum class SolveKind : std::uint8_t {
  kStages,    ///< scaling, conjugate gradients and `advance` are stages
  kResident,  ///< one GPU kernel for all of them; the matrix stays on the chip
  kStreamed,  ///< one GPU kernel; each iteration reads the matrix from memory
};

/// The most elements that share a quadrature point (clusters.h).
inline constexpr std::size_t kMaxClusterElements = 6;

/// Elements of one (shape, law). Linear and viscoelastic laws have a group for each body.
struct ElementGroup {
  int shape = 0;  ///< index into physics::Shapes
  int law = 0;    ///< index into physics::Laws
  std::uint32_t element_count = 0;
  std::uint32_t stride = 0;       ///< places: a multiple of kSliceRows, at least element_count
  bool is_constant = false;       ///< a linear law: the tensors are in Model::constant_edges
  std::uint32_t point_count = 0;  ///< quadrature points of an element
  /// [point_count] selective reduced integration weights; empty: each point integrates all moduli.
  std::vector<physics::ModuliWeights> shares;
  std::vector<physics::PronyTerm> prony;  ///< viscoelastic terms; empty: the law is elastic
  /// [place] element of the scene. mesh::kNone: padding, or an element that an earlier place has computed for another
  /// patch. May end before the padding does.
  std::vector<std::uint32_t> elements;
  /// [kMaxClusterElements][stride] elements of each cluster, the first as in `elements`; mesh::kNone: there are fewer.
  /// Empty: the group has no clusters.
  std::vector<std::uint32_t> members;
  std::vector<double> member_parts;  ///< [kMaxClusterElements][stride] part of the cluster's volume
  std::vector<std::uint32_t> rows;   ///< [shape nodes][stride]
  std::vector<double> rest;          ///< [point_count][rest reals][stride]
  std::vector<double> parameters;    ///< [law parameters][stride]
  matrix::RowLists row_lists;        ///< empty if is_constant, and with Storage::kEdges
  // Storage::kEdges only (matrix/patch_elements.h):
  std::vector<std::uint32_t> patch_elements;  ///< [patch_count, 2]
  std::vector<std::uint32_t> pair_places;     ///< [pairs][stride]; empty if the tensors are constant
  /// The law does not recover from inversion (Inversion::kCaught). False for clusters: their elements are checked.
  bool checks_volume = false;
  bool solve_checks_volume = false;  ///< the solve checks the volumes (Model::checked), not a stage

  /// Returns the reals of an element's record (view::record_reals).
  std::uint32_t record_reals() const {
    return view::record_reals(static_cast<std::uint32_t>(rest.size() / stride / point_count), point_count,
                              static_cast<std::uint32_t>(parameters.size() / stride));
  }
  bool has_clusters() const { return !members.empty(); }
  /// Returns the reals of all Γ_i: [point_count][prony][6][stride].
  std::size_t internal_variable_reals() const {
    return std::size_t{point_count} * prony.size() * physics::kSymmetricReals * stride;
  }
};

/// Rows with prescribed displacements, grouped by patch.
struct PrescribedRows {
  std::vector<std::uint32_t> patch_begin;  ///< [patch_count + 1] into rows
  std::vector<std::uint32_t> rows;         ///< [entry, 3] row, index into Model::prescribed, bits of the directions
};

/// A prescribed displacement over time, the same for all of its nodes.
struct Prescribed {
  Vec3<double> displacement_m = Vec3<double>::Zero();
  Schedule schedule;
  /// Returns displacement_m times the factor.
  Vec3<double> at(double time_s) const { return displacement_m * schedule.at(time_s); }
};

/// Gravity and loads that follow schedules (model/loads.h). Loads of equal schedules share one.
struct ScheduledLoads {
  std::vector<Schedule> schedules;      ///< [schedule] none is empty
  std::vector<std::uint32_t> rows;      ///< [entry] ascending; a row may have several entries
  std::vector<std::uint32_t> of_entry;  ///< [entry] index into schedules
  std::vector<double> forces;           ///< [entry, 3] N at a factor of 1
  std::vector<std::uint32_t> of_face;   ///< [pressure face] index into schedules; mesh::kNone: the face has none
};

/// Boundary faces under pressure, and for each row the corners that it has in them. Rows are grouped by patch.
struct PressureSurface {
  std::vector<view::PressureFace<double>> faces;
  std::vector<std::uint32_t> patch_begin;   ///< [patch_count + 1] into rows
  std::vector<std::uint32_t> rows;          ///< [pressed row]
  std::vector<std::uint32_t> corner_begin;  ///< [pressed row + 1] into corners
  std::vector<std::uint32_t> corners;       ///< [entry, 2] face, corner
  std::vector<std::uint32_t> slots;         ///< [entry, kMaxFaceNodes], see PressureView
  bool conserves_energy = true;             ///< its stiffness is symmetric on every body, and the matrix has it
};

/// Contact triangles that elements carry: view::CarriedView.
struct CarriedTriangles {
  std::vector<std::uint32_t> rows;             ///< [carried, 4]
  std::vector<double> weights;                 ///< [carried, 3, 4]
  std::vector<std::uint32_t> twins;            ///< [carried]
  std::vector<std::uint32_t> patch_triangles;  ///< [patch_count + 1]
  std::vector<std::uint32_t> patch_rows;       ///< [patch_count + 1]
  std::vector<std::uint32_t> entry_begin;      ///< [surface vertex, then row without one + 1]
  std::vector<std::uint32_t> entries;          ///< [entry, 5]
  std::vector<std::uint32_t> around_begin;     ///< [surface vertex, then vertex that only they have + 1]
  std::vector<std::uint32_t> around;           ///< [entry, 2]

  std::uint32_t count() const { return static_cast<std::uint32_t>(rows.size() / 4); }
};

/// The boundary of the bodies, for contact. Triangles and vertices are grouped by the patch that owns them. Carried
/// triangles follow the others, and are grouped by patch too.
struct ContactSurface {
  std::vector<std::uint32_t> triangle_rows;        ///< [outer_count, 3]
  std::vector<std::uint32_t> triangle_neighbours;  ///< [triangle_count, 3]
  std::vector<std::uint32_t> patch_triangles;      ///< [patch_count + 1]; a scene with editing has room behind them
  std::vector<double> triangle_area;               ///< [triangle_count] m²
  std::vector<double> triangle_moduli;             ///< [triangle_count, 2], see ContactView
  std::vector<std::uint32_t> triangle_elements;    ///< [triangle_count]; mesh::kNone: room for another
  std::vector<std::uint32_t> vertex_of_corner;     ///< [triangle_count, 3], see ContactView
  std::vector<std::uint32_t> surface_rows;         ///< [surface vertex]
  std::vector<std::uint32_t> patch_surface;        ///< [patch_count + 1]
  std::vector<std::uint32_t> incidence_begin;      ///< [surface vertex + 1]
  std::vector<std::uint32_t> incidence;            ///< [entry, 4], see ContactView
  // Scenes with editing only, empty otherwise: where the triangles, the surface vertices and the entries that exist
  // end.
  std::vector<std::uint32_t> triangles_end;  ///< [patch_count]
  std::vector<std::uint32_t> surface_end;    ///< [patch_count]
  std::vector<std::uint32_t> incidence_end;  ///< [surface vertex]
  CarriedTriangles carried;

  /// Triangles between three rows: what no cut crosses of the boundary.
  std::uint32_t outer_count() const { return static_cast<std::uint32_t>(triangle_rows.size() / 3); }
  /// Returns a row of a triangle. All of its rows are of one body.
  std::uint32_t row_of(std::size_t triangle) const {
    const std::size_t outer = outer_count();
    return triangle < outer ? triangle_rows[3 * triangle] : carried.rows[4 * (triangle - outer)];
  }
  std::uint32_t triangle_count() const { return static_cast<std::uint32_t>(triangle_area.size()); }
};

/// Blades, and the tetrahedra that they cut (view/blades.h).
struct Blades {
  std::vector<std::uint32_t> tools;             ///< [blade] places in Model::tools
  std::vector<std::uint32_t> first_points;      ///< [blade + 1]
  std::vector<std::uint32_t> rows;              ///< [element, 4]
  std::vector<std::uint32_t> neighbours;        ///< [element, 4]
  std::vector<double> toughness;                ///< [element] J/m²
  std::vector<std::uint32_t> patch_tetrahedra;  ///< [patch_count + 1]
  std::vector<std::uint32_t> tetrahedra;        ///< [element]

  std::uint32_t count() const { return static_cast<std::uint32_t>(tools.size()); }
  std::uint32_t point_count() const { return first_points.empty() ? 0 : first_points.back(); }
  std::uint32_t tetrahedron_count() const { return static_cast<std::uint32_t>(toughness.size()); }
};

/// Contact between bodies, attachments and blades (view/links.h). Entries are grouped by patch.
struct Links {
  std::vector<std::uint32_t> patch_rows;        ///< [patch_count + 1] into rows
  std::vector<std::uint32_t> rows;              ///< rows that a link may have, ascending
  std::vector<std::uint32_t> row_place;         ///< [row_count]
  std::vector<std::uint32_t> leaf_triangles;    ///< [leaf_count, kLeafTriangles]
  std::vector<std::uint32_t> patch_candidates;  ///< [patch_count + 1]
  std::vector<std::uint32_t> candidates;        ///< [candidate_count, 2]
  std::vector<double> candidate_area;           ///< [candidate_count] m²
  std::vector<double> candidate_modulus;        ///< [candidate_count] Pa
  std::vector<std::uint32_t> side_groups;       ///< [side, 3]
  std::vector<double> side_numbers;             ///< [side, kSideNumbers]
  std::vector<std::uint32_t> patch_springs;     ///< [patch_count + 1]
  std::vector<std::uint32_t> spring_rows;       ///< [spring_count, 2]
  std::vector<double> spring_numbers;           ///< [spring_count, 3]
  /// [spring_count] place of each spring in the other arrays, in the order of the scene's attachments.
  std::vector<std::uint32_t> spring_places;
  /// [attachment + 1] its first spring, in that order; empty: the scene has no attachments.
  std::vector<std::uint32_t> attachment_begin;
  // Sharp edges (view::EdgesView); empty if no two bodies that touch both have some.
  std::vector<std::uint32_t> edge_rows;              ///< [edge, 4]
  std::vector<double> edge_numbers;                  ///< [edge, kEdgeNumbers]
  std::vector<std::uint32_t> triangle_edges;         ///< [triangle_count, 3]
  std::vector<std::uint32_t> patch_edge_candidates;  ///< [patch_count + 1]
  std::vector<std::uint32_t> edge_candidates;        ///< [edge_candidate_count, 2]
  Blades blades;

  std::uint32_t candidate_count() const { return static_cast<std::uint32_t>(candidate_area.size()); }
  std::uint32_t spring_count() const { return static_cast<std::uint32_t>(spring_rows.size() / 2); }
  std::uint32_t edge_candidate_count() const { return static_cast<std::uint32_t>(edge_candidates.size() / 2); }
  std::uint32_t edge_slot_count() const { return edge_candidate_count() * view::kEdgeSlots; }
  std::uint32_t count() const {
    return candidate_count() + spring_count() + edge_slot_count() + view::kPinLinks * blades.point_count();
  }
  std::uint32_t leaf_count() const { return static_cast<std::uint32_t>(leaf_triangles.size() / view::kLeafTriangles); }
  /// Returns whether contacts remember something from step to step (view::LinksView::slips): the force with which a
  /// node pushed, friction, on which side of its own body's surface a node is, or which edges touch.
  bool contacts_remember() const { return candidate_count() > 0; }
};

/// Free bodies whose momentum each step balances (view/balance.h), and the patches that have rows of them.
struct FreeBodies {
  std::vector<std::uint32_t> row_body;       ///< [row_count]
  std::vector<std::uint32_t> center_rows;    ///< [body]
  std::vector<std::uint32_t> patch_entries;  ///< [patch_count + 1]
  std::vector<std::uint32_t> entry_body;     ///< [entry]
  std::vector<std::uint32_t> body_begin;     ///< [body + 1]
  std::vector<std::uint32_t> body_entries;   ///< [entry]
  // Empty if no two free bodies may be joined by links, or more than view::kMaxCoupledBodies may.
  std::vector<std::uint32_t> partner_begin;   ///< [body + 1]
  std::vector<std::uint32_t> partners;        ///< [partner]
  std::vector<std::uint32_t> entry_partners;  ///< [entry + 1]

  std::uint32_t count() const { return static_cast<std::uint32_t>(center_rows.size()); }
  std::uint32_t partner_sum_count() const { return entry_partners.empty() ? 0 : entry_partners.back(); }
};

/// The points that clients see: vertices, body by body, then the ends of springs. Each is a weighted mean of four rows.
struct VisibleSurface {
  std::vector<std::uint32_t> rows;   ///< [point_count, 4]
  std::vector<double> weights;       ///< [point_count, 4]
  std::uint32_t vertex_count = 0;    ///< vertices of bodies
  std::uint32_t room = 0;            ///< last points: room for vertices that edits append
  std::uint32_t appended_count = 0;  ///< how many of them exist
  std::uint32_t point_count() const { return static_cast<std::uint32_t>(rows.size() / 4); }
  /// Returns how many points the scene has when it is loaded.
  std::uint32_t count() const { return point_count() - room; }
  std::uint32_t attachment_point_count() const { return count() - vertex_count; }
};

/// The springs of an attachment as clients see them, in the order of the scene.
struct VisibleAttachment {
  std::string name;
  std::vector<std::array<std::uint32_t, 2>> springs;  ///< ends: places among the attachment points
  std::vector<float> rest_lengths_m;                  ///< [spring]
  /// One spring's. breaking_force_n is infinite if it never breaks.
  double stiffness_n_per_m = 0, breaking_force_n = 0;
};

/// A node or an element that a cut has copied; both are numbered in the body.
struct CutCopy {
  std::uint32_t loaded;  ///< the one of the mesh
  std::uint32_t parent;  ///< the one it was split from: it starts with that one's state
};

/// Returns whether the elements of a group follow their last tangents (matrix/lagged_tangents.h).
inline bool lags_of(const Settings& settings, const ElementGroup& group) {
  return settings.asks_for_lag() && !group.is_constant && group.prony.empty();
}

/// A body as its scene describes it, after its mesh was admitted.
struct AdmittedBody {
  std::string name;
  std::uint32_t node_begin = 0, node_count = 0;        ///< range in the scene's nodes
  std::uint32_t element_begin = 0, element_count = 0;  ///< range in the scene's elements
  std::uint32_t component_count = 0;
  double volume_m3 = 0, mass_kg = 0, min_dihedral_angle_deg = 0;
  double ablation_j_per_m3 = 0;            ///< energy that takes the material out of a volume
  double fracture_toughness_j_per_m2 = 0;  ///< work that cuts an area
  double coagulated_stiffness_factor = 1;  ///< coagulation.h
  bool has_color = false;
  Vec3<double> color_srgb = Vec3<double>::Zero();

  /// Nodes and elements as loaded are the first ones. The others are copies that cuts made (cut_bodies.h).
  std::uint32_t loaded_node_count = 0, loaded_element_count = 0;
  std::vector<CutCopy> node_copies;     ///< [node_count − loaded_node_count] virtual nodes
  std::vector<CutCopy> element_copies;  ///< [element_count − loaded_element_count] further parts of split elements

  bool has_node(std::uint32_t node) const { return node - node_begin < node_count; }
  bool has_element(std::uint32_t element) const { return element - element_begin < element_count; }
};

/// A body as clients see it. Empty: the scene has no frames.
struct VisibleBody {
  std::uint32_t vertex_begin = 0, vertex_count = 0;  ///< range in the visible surface
  std::vector<mesh::Triangle> triangles;             ///< visible, relative to vertex_begin
  std::vector<std::uint32_t> vertex_nodes;           ///< mesh node of each visible vertex; empty for a skin
  bool has_skin = false;
  Texture texture;
};

/// Least and largest Young's modulus behind the surface of a body [Pa]. Zero: the scene has no contact surface.
struct SurfaceModuli {
  double least_surface_modulus_pa = 0, most_surface_modulus_pa = 0;
};

struct BodyModel : AdmittedBody, VisibleBody, SurfaceModuli {
  std::uint32_t fixed_node_count = 0;  ///< fixed or prescribed in at least one direction
};

/// Returns the place of the body that has a node or an element, numbered in the scene. bodies: AdmittedBody or derived,
/// in the order of their ranges.
template <class Bodies>
std::size_t body_of_node(const Bodies& bodies, std::uint32_t node) {
  const auto after = std::upper_bound(bodies.begin(), bodies.end(), node,
                                      [](std::uint32_t i, const AdmittedBody& body) { return i < body.node_begin; });
  return static_cast<std::size_t>(after - bodies.begin()) - 1;
}
template <class Bodies>
std::size_t body_of_element(const Bodies& bodies, std::uint32_t element) {
  const auto after = std::upper_bound(bodies.begin(), bodies.end(), element,
                                      [](std::uint32_t i, const AdmittedBody& body) { return i < body.element_begin; });
  return static_cast<std::size_t>(after - bodies.begin()) - 1;
}

/// Contact of a body with another, or with itself.
struct BodyContactModel {
  std::size_t body, other;                                                ///< places in Model::bodies
  double distance_m, penalty_pa_per_m, penalty_per_m, friction, reach_m;  ///< penalties: as of ToolModel
};

struct ToolModel {
  std::string name;
  std::uint32_t kind = 0;                          ///< place in physics::Tools
  std::uint32_t core_points = 0;                   ///< kCorePoints of the kind
  std::uint32_t first_core_point = 0;              ///< its core points among those of all tools
  std::uint32_t contact_points = 0;                ///< kContactPoints of the kind
  std::uint32_t first_contact_point = 0;           ///< its contact points among those of all tools
  std::size_t first_sample = 0;                    ///< its place in Model::tool_samples, if it is sampled
  bool fixed = false;                              ///< an obstacle: it takes no poses
  double cautery_w = 0;                            ///< power that it brings into tissue at level 1; 0: it burns nothing
  std::span<const physics::ToolParameter> joints;  ///< kJoints of the kind
  double radius_m = 0;                             ///< for a solid half its thickness
  double reach_m = 0;  ///< for a solid the largest distance of its surface from the origin of the shape's frame
  double width_m = 0;  ///< the second largest of its three sizes; infinite for a plane
  physics::ToolParameters parameters{};
  Vec3<double> tip_offset_m = Vec3<double>::Zero();  ///< origin of the shape's frame in the tool's frame
  double penalty_pa_per_m = 0;                       ///< pressure of contact per depth, if the scene gives it; else 0
  double penalty_per_m = 0;      ///< else this times E of what the tool touches; 0 if the scene gives it
  double severs_m = 0;           ///< springs this near to its core are severed (contact/severing.h); 0: it severs none
  double severing_length_m = 0;  ///< length of the core that severs, from the tip on
  double friction = 0;           ///< Coulomb's coefficient
  bool keeps_force = false;      ///< augmented Lagrangian method (contact/tools.h)
  double steepest = 0;           ///< where its contact hardens no further (contact/tools.h)
  double max_speed_m_per_s = 0;
  /// Largest load on the hand [N, N m; of a joint N m or N], above which the tool gives way (world/hold.h).
  double max_force_n = 0, max_torque_n_m = 0, max_joint_load = 0;
  /// Virtual coupling (world/coupling.h) [kg, N/m, N s/m]. Without a mass the tool is at its pose.
  double mass_kg = 0, coupling_stiffness_n_per_m = 0, coupling_damping_n_s_per_m = 0;
  physics::Pose initial_pose;
  std::shared_ptr<const v1::Tool> description;  ///< the scene's message, for viewers; never null

  /// Returns whether its contacts remember something from step to step (view::ContactView::slips).
  bool remembers() const { return contact_points > 0 && (friction > 0 || keeps_force || !fixed); }
  /// Returns a bound of the stiffness of its contact with rigid tissue [N/m]: a sphere of its radius cannot press on
  /// more than its cross-section. modulus_pa: of what it touches.
  double stiffest_contact_n_per_m(double modulus_pa) const {
    return (penalty_pa_per_m + penalty_per_m * modulus_pa) * EIGEN_PI * radius_m * radius_m;
  }
  /// Returns the tool with its shape's frame at a pose. That frame is the tool's own, moved by tip_offset_m.
  /// start: pose of the shape at the start of the step. presence: share of its contact stiffness.
  template <class Real>
  physics::PlacedTool<Real> placed(const physics::Pose& shape, const physics::Pose& start, double presence = 1) const {
    physics::PlacedTool<Real> out{};
    const Mat3<double> rotation = physics::rotation(shape).toRotationMatrix();
    const Mat3<double> turned =
        Mat3<double>::Identity() - physics::rotation(start).toRotationMatrix() * rotation.transpose();
    for (int c = 0; c < 3; ++c) out.position_m[c] = static_cast<Real>(shape.position_m[c]);
    for (int c = 0; c < 9; ++c) out.rotation[c] = static_cast<Real>(rotation(c / 3, c % 3));
    for (int c = 0; c < 3; ++c) out.moved_m[c] = static_cast<Real>(shape.position_m[c] - start.position_m[c]);
    for (int c = 0; c < 9; ++c) out.turned[c] = static_cast<Real>(turned(c / 3, c % 3));
    for (std::size_t i = 0; i < joints.size(); ++i) {
      out.joint_values[i] = static_cast<Real>(shape.joint_values[i]);
      out.joints_moved[i] = static_cast<Real>(shape.joint_values[i] - start.joint_values[i]);
    }
    for (std::size_t i = 0; i < parameters.size(); ++i) out.parameters[i] = static_cast<Real>(parameters[i]);
    out.radius_m = static_cast<Real>(radius_m);
    out.steepest = static_cast<Real>(steepest);
    out.penalty_pa_per_m = static_cast<Real>(presence * penalty_pa_per_m);
    out.penalty_per_m = static_cast<Real>(presence * penalty_per_m);
    out.presence = static_cast<Real>(presence);
    out.friction = static_cast<Real>(friction);
    out.severs_m = static_cast<Real>(presence == 1 ? severs_m : 0);
    out.severing_length_m = static_cast<Real>(severing_length_m);
    out.keeps_force = keeps_force ? 1 : 0;
    out.remembers = remembers() ? 1 : 0;
    out.kind = kind;
    out.first_core_point = first_core_point;
    out.contact_points = contact_points;
    out.first_contact_point = first_contact_point;
    return out;
  }
};

/// Aggregates of rows for the coarse level of a solve (view/coarse.h).
struct Aggregates {
  std::vector<std::uint32_t> row_aggregate;  ///< [row_count] aggregate, or view::kNoAggregate
  std::vector<std::uint32_t> center_rows;    ///< [aggregate]
  std::vector<double> inverse_sizes;         ///< [aggregate] 1/m

  std::uint32_t count() const { return static_cast<std::uint32_t>(center_rows.size()); }
};

struct EditTables;   // edit_tables.h
struct ValueTables;  // values.h

struct Model : Settings {
  std::vector<BodyModel> bodies;
  std::vector<ToolModel> tools;
  std::vector<BodyContactModel> body_contacts;
  std::vector<float> tool_samples;        ///< signed distances of tools, see physics/tool/mesh_solid.h
  std::vector<Finding> findings;          ///< those of the load
  std::vector<AcceptedFinding> accepted;  ///< also while the scene steps

  matrix::Layout layout;
  std::vector<std::uint8_t> begun_slices;  ///< [slice] MatrixView::begun_slices
  std::vector<ElementGroup> groups;        ///< linear laws last
  SolveKind solve = SolveKind::kStages;
  bool solve_keeps_vectors = false;    ///< the solve's vectors stay in shared memory; no buffer exists for them
  matrix::PatchTetrahedra checked;     ///< tetrahedra whose volume the solve checks; empty: stages check
  std::vector<double> constant_edges;  ///< [slot] 3×3, at Layout::component; empty: no linear laws
  std::vector<double> mass_edges;      ///< [slot] kg; empty: lumped mass
  double size_m = 0;                   ///< diagonal of the box around the scene at rest
  std::vector<double> rest;            ///< [row_count, 4]
  std::vector<double> inertia;         ///< [row_count, 4] StateView::inertia
  std::vector<double> row_mass;        ///< [row_count] kg; also in quasi-static scenes, where inertia has no mass
  /// [row_count, 4] N, without the forces of `scheduled`. Empty: neither gravity nor forces, not even scheduled ones.
  std::vector<double> external;
  /// [row_count, 4] m, m/s; empty: the scene starts at rest.
  std::vector<double> initial_displacement, initial_velocity;
  PrescribedRows prescribed_rows;
  std::vector<Prescribed> prescribed;
  PressureSurface pressure;
  ScheduledLoads scheduled;
  ContactSurface contact;                      ///< empty: neither tools nor contact between bodies
  Links links;                                 ///< empty: neither contact between bodies nor attachments nor blades
  Aggregates aggregates;                       ///< empty: no solve has a coarse level
  FreeBodies free_bodies;                      ///< empty: no step balances momentum
  VisibleSurface visible;                      ///< empty: no frames
  std::vector<VisibleAttachment> attachments;  ///< empty: no frames, or no attachments
  /// [element] stiffness of its material over that of its law (coagulation.h); empty: all 1
  std::vector<double> stiffening;
  std::vector<double> element_moduli;  ///< [element, 2] ContactView::triangle_moduli; empty: no editing
  /// What other values of the scene are made from (values.h). Never null.
  std::shared_ptr<const ValueTables> value_tables;
  /// What edits start from (edit.h); nullptr: the scene never changes.
  std::shared_ptr<const EditTables> edit_tables;

  /// Returns the place of the body that has a node or an element, numbered in the scene.
  std::size_t body_of_node(std::uint32_t node) const { return model::body_of_node(bodies, node); }
  std::size_t body_of_element(std::uint32_t element) const { return model::body_of_element(bodies, element); }
  /// Returns whether a step needs neither û nor v̂ (view/state.h): implicit Euler, linearized once, without prescribed
  /// displacements. A prescribed node needs v̂ because its neighbours feel that, not its velocity, through a consistent
  /// mass. Its velocity is also written before a plain step would save its checkpoint.
  bool is_plain() const {
    return integrator == Integrator::kImplicitEuler && !iterates() && prescribed_rows.rows.empty();
  }
  /// Returns whether some tensors change in each step, so that elements are evaluated.
  bool has_refreshed_tensors() const { return !groups.empty() && !groups.front().is_constant; }
  /// Returns whether the elements of a group follow their last tangents (matrix/lagged_tangents.h).
  bool lags(const ElementGroup& group) const { return lags_of(*this, group); }
  bool lags() const {
    return std::any_of(groups.begin(), groups.end(), [this](const ElementGroup& group) { return lags(group); });
  }
  /// Returns the number of core points of all tools (physics/tool/tool.h).
  std::uint32_t core_points() const {
    return tools.empty() ? 0 : tools.back().first_core_point + tools.back().core_points;
  }
  /// Returns the number of contacts that a triangle can have.
  std::uint32_t contact_points() const {
    return tools.empty() ? 0 : tools.back().first_contact_point + tools.back().contact_points;
  }
  /// Returns whether a tool has friction.
  bool has_friction() const {
    return std::any_of(tools.begin(), tools.end(), [](const ToolModel& tool) { return tool.friction > 0; });
  }
  /// Returns whether contacts of tools remember something from step to step (view::ContactView::slips).
  bool contacts_remember() const {
    return std::any_of(tools.begin(), tools.end(), [](const ToolModel& tool) { return tool.remembers(); });
  }
  bool checks_volume() const {
    return std::any_of(groups.begin(), groups.end(), [](const ElementGroup& group) { return group.checks_volume; });
  }
};

}  // namespace tensormass::model
