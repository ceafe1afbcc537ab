#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/result.h"
#include "matrix/layout.h"
#include "matrix/patch_tetrahedra.h"
#include "matrix/row_lists.h"
#include "mesh/mesh.h"
#include "model/compile.h"
#include "model/model.h"
#include "model/read_parts.h"
#include "model/values.h"
#include "physics/element/element.h"
#include "physics/lists.h"

/// The parts of model::compile, each a function from inputs to outputs. A part can be made again alone: it reads its
/// parameters only, and what it makes it returns.
///
///   read_parts.h   bodies, tools, links, settings
///        │
///        ├─ make_clusters ─ make_layout ──┬─ make_row_fields ─ make_boundary_conditions   fields by row
///        │                                ├─ group_elements ─ list_elements_of_rows ─ choose_solve
///        │                                ├─ make_contact_surface ─ make_links             what tools and bodies touch
///        │                                └─ make_visible_surface, make_visible_springs   what clients see
///        └─ find_*                                                                        what is probably a mistake
///
/// The Model holds the outputs; compile() moves them there.
namespace tensormass::model {

/// The shape whose element pass evaluates a cluster.
using ClusterShape = physics::Hexahedron;
inline constexpr std::size_t kClusterNodes = ClusterShape::kNodes;

/// Elements that share a quadrature point (clusters.h).
struct Cluster {
  std::size_t body;
  double deviatoric_part;                                   ///< d
  std::array<std::uint32_t, kMaxClusterElements> elements;  ///< numbered in the body; mesh::kNone: there are fewer
  std::array<double, kMaxClusterElements> parts;            ///< V_e / V of each element
  std::array<std::uint32_t, kClusterNodes> nodes;           ///< numbered in the scene
  physics::PointGradients<ClusterShape, double> mean;       ///< ā_k and V
};

/// Makes the layout of a mesh for the patches of a policy. The matrix couples all nodes of an element, and all nodes of
/// a cluster.
matrix::Layout make_layout(const mesh::Mesh& mesh, std::span<const Cluster> clusters, const PatchPolicy& policy);

/// Fields of the rows that hold without boundary conditions. The members are those of Model.
struct RowFields {
  double size_m = 0;
  std::vector<double> rest, inertia, row_mass, mass_edges;
};
/// damping: [body]
RowFields make_row_fields(const ReadBodies& bodies, std::span<const Damping> damping, const ReadLinks& links,
                          const Settings& settings, const matrix::Layout& layout);

/// Boundary conditions, loads and the initial state. Members without a comment are those of Model.
struct BoundaryConditions {
  std::vector<std::uint8_t> held;               ///< [row] bits of the directions that are fixed or prescribed
  std::vector<std::uint32_t> fixed_node_count;  ///< [body] BodyModel::fixed_node_count
  std::vector<double> external, initial_displacement, initial_velocity;
  std::vector<double> loads;  ///< ValueTables::loads
  PrescribedRows prescribed_rows;
  std::vector<Prescribed> prescribed;
  PressureSurface pressure;
  ScheduledLoads scheduled;
};
/// row_mass: RowFields::row_mass, for gravity
Result<BoundaryConditions> make_boundary_conditions(const v1::Scene& scene, const ReadBodies& bodies,
                                                    const Settings& settings, const matrix::Layout& layout,
                                                    std::span<const double> row_mass);
/// Takes the directions that are held from the free ones. rest: RowFields::rest
void hold_directions(std::span<const std::uint8_t> held, std::span<double> rest);

/// All elements of a scene. The members are those of Model.
struct GroupedElements {
  std::vector<ElementGroup> groups;  ///< without row_lists
  std::vector<double> constant_edges;
  std::vector<ValueTables::Group> sources;  ///< [group] ValueTables::groups
  std::vector<RecordPlace> linear;          ///< ValueTables::linear
};
/// Puts every element into a group, and adds up the tensors of linear laws. Fails if an element is folded.
Result<GroupedElements> group_elements(const ReadBodies& bodies, std::span<const Cluster> clusters,
                                       const matrix::Layout& layout);

/// Storage::kRows, kTiles: lists the elements that each row evaluates, for the groups whose tensors change: to
/// compute them, or to gather those that are kept. Empty with kEdges, where elements add to the matrix directly. Fails
/// if a node has too many neighbours.
Result<matrix::GroupRowLists> list_elements_of_rows(const Settings& settings, const matrix::Layout& layout,
                                                    const GroupedElements& elements);

/// Who runs the solve, where its vectors are stored, and which volumes it checks at its end.
struct SolveChoice {
  SolveKind kind = SolveKind::kStages;
  bool keeps_vectors = false;               ///< Model::solve_keeps_vectors
  std::vector<std::size_t> checked_groups;  ///< groups with ElementGroup::solve_checks_volume
  matrix::PatchTetrahedra checked;          ///< Model::checked
};
SolveChoice choose_solve(const Settings& settings, const ReadLinks& links, const matrix::Layout& layout,
                         std::span<const ElementGroup> groups, const PatchPolicy& policy);

/// Makes the triangles that tools and bodies can touch: the boundary of all bodies, with the faces of their cuts.
ContactSurface make_contact_surface(const ReadBodies& bodies, const matrix::Layout& layout);
/// Adds the moduli behind a triangle of the contact surface. element: the one behind it, numbered in the scene
void add_moduli(std::span<const ReadBody> bodies, std::uint32_t element, ContactSurface& out);
/// Appends the triangles that elements carry (view::CarriedView) to those that no cut crosses. Nothing happens in a
/// scene without cuts.
void carry_triangles(const ReadBodies& bodies, const matrix::Layout& layout, ContactSurface& surface);

struct LinkInput {
  const ReadBodies& bodies;
  const ReadLinks& links;
  const matrix::Layout& layout;
  const ContactSurface& contact;  ///< empty if bodies do not touch
  std::span<const ToolModel> tools;
};
/// Makes the links of contacts between bodies, of attachments and of blades.
Links make_links(const LinkInput& input);

/// Returns the places of tools that are blades. Fails if the scene cannot be cut by them.
Result<std::vector<std::uint32_t>> find_blades(const v1::Scene& scene, const ReadBodies& bodies,
                                               std::span<const ToolModel> tools);
/// Makes the points of blades, and the tetrahedra that they may hold.
Blades make_blades(const LinkInput& input);

struct FreeBodyInput {
  const ReadBodies& bodies;
  const matrix::Layout& layout;
  std::span<const double> rest;  ///< Model::rest
  const PrescribedRows& prescribed_rows;
  const PressureSurface& pressure;
  std::span<const BodyContactModel> contacts;
  std::span<const std::uint32_t> spring_rows;  ///< Links::spring_rows
};
/// Finds the free bodies whose momentum a step can balance.
FreeBodies find_free_bodies(const FreeBodyInput& input);

/// Divides the rows into aggregates for the coarse level of a solve: compact, connected pieces of about equal size.
/// Empty if no solve of the scene can use them.
Aggregates make_aggregates(const Settings& settings, const mesh::Mesh& mesh, const matrix::Layout& layout);

/// What clients see of the bodies.
struct VisibleBodies {
  VisibleSurface surface;
  std::vector<VisibleBody> bodies;
  std::vector<Finding> findings;  ///< those of their skins
};
/// Makes the vertices that clients see: the skin of each body, or the boundary of its mesh.
Result<VisibleBodies> make_visible_surface(const v1::Scene& scene, const ReadBodies& bodies, BodyBoundaries& boundaries,
                                           const matrix::Layout& layout);

/// Appends the vertices that cuts have made, and room for more, to the points that clients see. Fails if the scene has
/// no room for so many.
Result<void> append_cut_vertices(const v1::Scene& scene, const ReadBodies& bodies, const matrix::Layout& layout,
                                 VisibleSurface& visible);

/// The springs that clients see, and the points at their ends.
struct VisibleSprings {
  std::vector<VisibleAttachment> attachments;
  std::vector<std::uint32_t> rows;  ///< [attachment point, 4], as in VisibleSurface
  std::vector<double> weights;      ///< [attachment point, 4]
};
VisibleSprings make_visible_springs(std::span<const ReadAttachment> attachments, const matrix::Layout& layout);

/// Finds bodies that are too large, lock, or have a law that gets softer where a tool presses.
std::vector<Finding> find_mistakes_of_bodies(std::span<const ReadBody> bodies, bool has_moving_tool);

struct ToolMistakeInput {
  const Settings& settings;
  std::span<const BodyModel> bodies;
  std::span<const Damping> damping;  ///< [body]
  std::span<const ReadAttachment> attachments;
  std::span<const ToolModel> tools;
  std::span<const float> tool_samples;
  const matrix::Layout& layout;
  const ContactSurface& contact;
  std::span<const double> rest, initial_displacement, initial_velocity;  ///< as of Model
};
/// Finds tools that start inside tissue, that are smaller than the triangles which they touch, and that a free body
/// passes within a step.
std::vector<Finding> find_mistakes_of_tools(const ToolMistakeInput& input);

struct OverlapInput {
  const ReadBodies& bodies;
  BodyBoundaries& boundaries;
  std::span<const BodyContactModel> contacts;
  const matrix::Layout& layout;
  const ContactSurface& contact;
};
/// Finds bodies that overlap at rest.
std::vector<Finding> find_overlaps(const OverlapInput& input);

}  // namespace tensormass::model
