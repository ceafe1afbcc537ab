#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "core/result.h"
#include "mesh/mesh.h"
#include "model/compile_parts.h"
#include "model/model.h"

/// What edits of a scene start from: the scene as it was loaded, element by element, and where each element is in the
/// model. Compiling would throw it away otherwise. Constant for the life of the scene.
///
///   record   a place in a group that elements contribute to: an element's own one, or that of its cluster. With
///            Storage::kEdges it has several places, one for each patch that it touches.
///   corner   an element or a record at one of its rows
///   face     one side of an element, which is a part of the surface while no other element with material is behind it
///   piece    a triangle of a face; a quadrilateral has two
///   skin     a visible surface beside the boundary of the mesh, finer or coarser than it
namespace tensormass::model {

/// Room for triangles around a vertex that comes to light.
inline constexpr std::uint32_t kRoomOfNewVertex = 16;

/// Lists of items, one after the other.
template <class T>
struct Lists {
  std::vector<std::uint32_t> begin{0};  ///< [list + 1] into items
  std::vector<T> items;

  std::span<const T> operator[](std::size_t list) const {
    return std::span(items).subspan(begin[list], begin[list + 1] - begin[list]);
  }
  std::size_t size() const { return begin.size() - 1; }
  void end_list() { begin.push_back(static_cast<std::uint32_t>(items.size())); }
};

/// What edits of bodies with skins start from (edit_skin_tables.cpp makes it). Empty if no body has one.
///
///   skin       ──┬───●───┬──      a skin triangle hangs on the elements behind the pieces that it covers, and on those
///                    ┊ foot       in which its vertices are embedded
///   boundary   ────┬─┴──┬────
///
/// Triangles and vertices are numbered over all bodies: those of clients, body by body.
struct SkinTables {
  /// The point of the boundary nearest to a skin vertex at rest: Σ_k weights[k] · x(rows[k]).
  struct Foot {
    std::array<std::uint32_t, 3> rows{mesh::kNone, mesh::kNone, mesh::kNone};  ///< kNone: the vertex is on the boundary
    std::array<double, 3> weights{};
  };
  std::vector<std::uint32_t> triangle_begin;  ///< [body + 1]
  Lists<std::uint32_t> hanging;               ///< [element] skin triangles that go with it
  Lists<std::uint32_t> covered;               ///< [triangle] pieces of the boundary
  /// [triangle] the one across the edge from corner i to corner i + 1; mesh::kNone unless exactly two triangles meet
  /// there and run along it in opposite directions
  std::vector<std::array<std::uint32_t, 3>> neighbours;
  std::vector<Foot> feet;                     ///< [vertex]
  std::vector<std::uint32_t> nearest_vertex;  ///< [row] of the boundary: vertex in its body; else mesh::kNone
  Lists<std::uint32_t> boundary;              ///< [body] pieces of its boundary
  std::vector<std::uint32_t> piece_element;   ///< [piece]

  bool empty() const { return triangle_begin.empty(); }
};

struct EditTables {
  struct Corner {
    std::uint32_t item;  ///< element or record
    std::uint32_t node;  ///< which of its nodes
  };
  /// An element of a cluster, with V_e ∇N_k at the nodes of the cluster (clusters.h).
  struct Member {
    std::uint32_t element;
    double volume_m3;
    std::uint32_t gradient_begin, gradient_end;  ///< into gradient_nodes and gradients
  };
  /// Values of a group without an edit.
  struct Group {
    std::vector<std::uint32_t> elements, rows;
    std::vector<double> rest;
  };

  // Elements, numbered in the scene.
  Lists<std::uint32_t> rows;     ///< [element] rows of its nodes
  std::vector<double> masses;    ///< [row of an element] what it adds to Model::row_mass [kg]
  std::vector<double> inertias;  ///< [row of an element] what it adds to Model::inertia [kg]
  Lists<double> pair_masses;     ///< [element] what each pair of its nodes adds to Model::mass_edges; empty: lumped
  std::vector<double> volumes;   ///< [element] m³
  Lists<Corner> corners;         ///< [row] elements at it
  Lists<std::uint32_t> pressed;  ///< [element] its faces in Model::pressure
  std::vector<std::uint32_t> checked;  ///< [element] its place in Model::checked, or mesh::kNone

  // Records: those of the elements, then those of the clusters.
  std::vector<std::uint32_t> record_group;  ///< [record] index into Model::groups
  Lists<std::uint32_t> places;              ///< [record]
  std::vector<std::uint32_t> cluster_of;    ///< [element] record of its cluster, or mesh::kNone
  Lists<Member> members;                    ///< [cluster]
  std::vector<std::uint8_t> gradient_nodes;
  std::vector<Vec3<double>> gradients;
  Lists<Corner> linear;  ///< [row] records of linear laws at it
  std::vector<Group> groups;

  // Rows.
  std::vector<double> free_bits;  ///< [row] 4th entry of Model::rest
  /// [row, 3] ValueTables::loads, or, where gravity has a schedule, the scheduled force without it [N]
  std::vector<double> loads;
  std::vector<std::uint32_t> gravity_entries;  ///< [row] entry of ScheduledLoads; empty: gravity has no schedule
  std::vector<std::uint32_t> row_bodies;       ///< [row] FreeBodies::row_body
  std::vector<std::uint32_t> center_rows;      ///< FreeBodies::center_rows
  Lists<std::uint32_t> springs;                ///< [row] places of its springs
  std::vector<double> pressures;               ///< [face of Model::pressure] Pa
  std::vector<std::uint16_t> checked_rows;     ///< PatchTetrahedra::rows

  // Faces.
  Lists<std::uint32_t> faces;                  ///< [element] faces of all elements, numbered through
  std::vector<std::uint32_t> face_behind;      ///< [face] the same side of the element behind it, or mesh::kNone
  std::vector<std::uint32_t> face_element;     ///< [face]
  Lists<std::array<std::uint32_t, 3>> pieces;  ///< [face] rows of their corners, outward winding
  std::vector<std::uint32_t> piece_triangle;   ///< [piece] its contact triangle, or mesh::kNone
  std::vector<std::uint32_t> piece_visible;    ///< [piece] its visible triangle, in its body, or mesh::kNone
  ContactSurface contact;                      ///< with room for new triangles
  std::vector<std::uint32_t> surface_vertex;   ///< [row] its vertex in `contact`, or mesh::kNone
  std::vector<std::uint32_t> visible_vertex;   ///< [row] its visible vertex, in its body, or mesh::kNone
  std::uint32_t max_new_triangles = 0, max_new_vertices = 0;  ///< Editing, with the defaults
  SkinTables skin;

  std::uint32_t element_count() const { return static_cast<std::uint32_t>(volumes.size()); }
};

struct EditTablesInput {
  const ReadBodies& bodies;
  std::span<const Cluster> clusters;
};
/// Makes the part for skins. The other tables of faces and rows must be there.
SkinTables make_skin_tables(const Model& model, const EditTables& tables);

/// Makes the tables of a model and gives its surfaces room for what edits bring to light. Call it last.
/// Fails if the scene has something that cannot change yet.
Result<void> make_editable(const EditTablesInput& input, Model& model);

}  // namespace tensormass::model
