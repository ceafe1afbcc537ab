#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "core/limits.h"
#include "core/result.h"
#include "model/edit_buffers.h"
#include "model/edit_tables.h"
#include "model/model.h"

/// Edits of a scene between two steps: material is taken out of elements.
///
///   World::edit ──> Editor: changes the vectors of the model ──> ModelEdit: which entries ──> SceneState::apply
///                                                                                              copies exactly those
///
/// An element has a share of its material, κ from 1 to 0. Its energy and its mass are κ times those at the start:
/// weights of quadrature points, masses, weight. A cluster (clusters.h) has the mean over what is left of its elements:
///
///   V = Σ_e κ_e V_e      ā_k = (Σ_e κ_e V_e ∇N_k) / V
///
/// Where tissue coagulates (coagulation.h), weights of quadrature points and means of clusters have κ C(κ) for κ.
///
/// 1. Every value is computed anew from the shares of the elements that it sums over, and never updated by a
///    difference. So nothing drifts, and a scene that is healed has the bits with which it was loaded.
/// 2. An element without material has zero weight and zero gradients, and all of its rows are the first one: it does
///    nothing, and no check finds it inverted. A row whose elements are all gone is held, so that no equation is
///    singular.
/// 3. An edit costs as much as what it touches. Sizes never change, so a captured graph stays valid.
/// 4. The contact surface depends on the order in which elements go, and is the same for the same order.
namespace tensormass::model {

/// An element of the scene, and the share of its material that is left.
struct Ablation {
  std::uint32_t element;
  double kept;
};

/// What an edit has changed.
struct ModelEdit {
  std::vector<EditRange> ranges;
  std::vector<std::uint32_t> held_rows;  ///< rows that lost the last of their material: they stop
  std::vector<std::uint32_t> severed;    ///< springs that break, as places of Links::spring_rows
  /// Contact triangles whose memory of friction moves: from, to, in this order. From mesh::kNone: it starts empty.
  std::vector<std::pair<std::uint32_t, std::uint32_t>> moved_triangles;
  bool changes_loads = false;  ///< gravity or pressure

  void clear();
};

/// What an appended triangle shows: the numbers of v1::BodyChanges::Face.
enum class Face : std::uint8_t { kOuter = 0, kCut = 1, kBurnt = 2 };

/// The visible surface of a body since its topology (docs/protocol.md). Vertices: those of the topology, then appended.
struct BodySurface {
  std::vector<std::uint32_t> dead_triangles;       ///< ascending; numbered in the body, appended ones last
  std::vector<std::uint32_t> appended_vertices;    ///< places among the visible points
  std::vector<mesh::Triangle> appended_triangles;  ///< vertices numbered in the body
  std::vector<Face> appended_kinds;                ///< [appended triangle]
  std::vector<std::uint8_t> coagulation;           ///< [vertex] coagulation_seen; empty: all tissue is raw
};

/// The vectors of a model that with_values changes and edits do not, for an edited model.
struct EditedValues {
  explicit EditedValues(const Model& of)
      : external(of.external), constant_edges(of.constant_edges), element_moduli(of.element_moduli) {
    for (const ElementGroup& group : of.groups) parameters.push_back(group.parameters);
  }

  std::vector<double> external, constant_edges, element_moduli;
  std::vector<std::vector<double>> parameters;  ///< [group]
};

/// Edits one model. It keeps the shares and the surfaces; the model is given with each call and is always the same.
class Editor {
 public:
  explicit Editor(const Model& model);

  /// Says in words why an edit cannot be done: an element that does not exist, is named twice, has less material than
  /// that already, or is the last one of its body, or a surface that has no room.
  Result<void> check(const Model& m, std::span<const Ablation> ablations) const;
  /// Does an edit that was checked. Allocates nothing as long as edits are about as large as before.
  const ModelEdit& ablate(Model& m, std::span<const Ablation> ablations);

  /// The rest of the scene: elements that are gone, in the order in which they went, as many at once as an edit
  /// took, then those that have lost a part.
  struct Shares {
    std::vector<Ablation> ablations;
    std::vector<std::uint32_t> batches;  ///< [edit] how many of the first ones went together
  };
  Shares shares() const;
  /// Says in words why edits cannot have left this. Tries it on a copy of the model; slow.
  Result<void> check_shares(const Model& m, const Shares& shares) const;
  /// Gives all elements all of their material back.
  ///
  ///   apply(const ModelEdit&)   is called for each part of the change
  template <class Apply>
  void heal(Model& m, const Apply& apply) {
    for (const std::span<const Ablation> part : parts_to_heal()) apply(write(m, part));
    apply(heal_surfaces(m));
  }
  /// Makes the shares those of another editor of an equal scene.
  template <class Apply>
  void take(Model& m, const Shares& shares, const Apply& apply) {
    heal(m, apply);
    for_each_batch(shares, [&](std::span<const Ablation> batch) { apply(ablate(m, batch)); });
  }
  /// Computes every value of the model that edits compute, once, so that healing gives the same bits.
  void write_all(Model& m);
  /// Computes loads and constant tensors of a model without edits that got other values (values.h).
  void write_values(Model& m);
  /// Gives the edited model the values of another one of its scene that has no edits (with_values). Returns the entries
  /// that differ from those of `next` because material is gone. values: of `next`; afterwards those that the edited
  /// model had, so that nothing is copied or freed here
  const ModelEdit& take_values(Model& m, const Model& next, EditedValues& values);

  double kept(std::uint32_t element) const { return kept_[element]; }
  double volume_m3(std::uint32_t element) const { return tables().volumes[element]; }
  /// Returns the element that a contact triangle is a side of; mesh::kNone: the triangle is room.
  std::uint32_t element_behind(std::uint32_t triangle) const {
    return triangle < triangle_element_.size() ? triangle_element_[triangle] : mesh::kNone;
  }
  double removed_mass_kg() const { return removed_mass_kg_; }
  double removed_volume_m3() const { return removed_volume_m3_; }
  /// [body] empty if the scene has no frames
  std::span<const BodySurface> surfaces() const { return surfaces_; }
  /// Grows with each change of the visible surface, its colour included.
  std::uint32_t surface_revision() const { return surface_revision_; }
  /// Grows with each change of the surface's triangles.
  std::uint32_t shape_revision() const { return shape_revision_; }
  /// Calls visit(corners) for each triangle around what is left of a body with a skin. Corners are vertices of
  /// surfaces(); a node that clients do not see is where the nearest vertex of the skin is. So the triangles are
  /// closed, also where skin and boundary are apart.
  template <class Visit>
  void for_each_enclosing_triangle(const Model& m, std::size_t body, const Visit& visit) const {
    const SkinTables& skin = tables().skin;
    const auto visit_piece = [&](std::uint32_t piece) {
      mesh::Triangle corners;
      for (std::size_t c = 0; c < 3; ++c) {
        const std::uint32_t row = tables().pieces.items[piece][c];
        corners[c] = visible_vertex_[row] != mesh::kNone ? visible_vertex_[row] : skin.nearest_vertex[row];
      }
      visit(corners);
    };
    for (const std::uint32_t piece : skin.boundary[body]) {
      if (!is_gone(skin.piece_element[piece])) visit_piece(piece);
    }
    for (const std::uint32_t piece : exposed_) {
      if (piece_visible_[piece] != mesh::kNone && m.bodies[body].has_element(skin.piece_element[piece]))
        visit_piece(piece);
    }
  }

 private:
  /// Calls visit(ablations) for each edit that leads to the shares.
  template <class Visit>
  static void for_each_batch(const Shares& shares, const Visit& visit) {
    std::span<const Ablation> left = shares.ablations;
    for (const std::uint32_t count : shares.batches) {
      visit(left.first(count));
      left = left.subspan(count);
    }
    for (; !left.empty(); left = left.subspan(std::min(left.size(), limits::kMaxElementsOfEdit))) {
      visit(left.first(std::min(left.size(), limits::kMaxElementsOfEdit)));
    }
  }
  const EditTables& tables() const { return *tables_; }
  const ModelEdit& write(Model& m, std::span<const Ablation> shares);
  void write_record(Model& m, std::uint32_t record);
  void write_cluster(Model& m, std::uint32_t record);
  void store_rest(Model& m, std::uint32_t record, bool is_gone);
  void write_row(Model& m, std::uint32_t row);
  void write_external(Model& m, std::uint32_t row);
  void write_free_body(Model& m, std::uint32_t row);
  void write_pair_masses(Model& m, std::uint32_t element);
  void write_linear(Model& m, std::uint32_t record);
  void write_face_pressures(Model& m, std::uint32_t element);
  void write_checked(Model& m, std::uint32_t element);
  void write_triangle_moduli(Model& m) const;
  void place_loaded_triangles();
  void add(EditBuffer buffer, std::size_t begin, std::size_t count, std::size_t step = 1, std::uint32_t group = 0);
  std::vector<std::span<const Ablation>> parts_to_heal();

  // edit_surfaces.cpp
  bool has_contact() const { return !tables().contact.surface_rows.empty(); }
  bool has_clients() const { return !surfaces_.empty(); }
  bool is_gone(std::uint32_t element) const { return !(kept_[element] > 0); }
  Result<void> check_surfaces(const Model& m, std::span<const Ablation> ablations) const;
  void write_surfaces(Model& m);
  const ModelEdit& heal_surfaces(Model& m);
  void count_torn_skin(const Model& m, std::span<const Ablation> ablations, std::size_t& triangles,
                       std::size_t& vertices) const;
  void hide(Model& m, std::uint32_t face);
  void expose(Model& m, std::uint32_t face);
  void remove_triangle(Model& m, std::uint32_t piece);
  void add_triangle(Model& m, std::uint32_t piece, std::uint32_t element);
  bool will_go(std::uint32_t element) const { return named_[element] == 2 * check_number_ + 1; }
  std::uint32_t append_vertex(Model& m, std::size_t body, const std::array<std::uint32_t, 4>& rows,
                              const std::array<double, 4>& weights);
  std::uint32_t append_triangle(const Model& m, std::size_t body, const mesh::Triangle& triangle, Face kind);
  void show(Model& m, std::uint32_t piece, std::size_t body, Face kind);
  void kill(std::size_t body, std::uint32_t triangle);
  std::uint32_t surface_vertex(Model& m, std::uint32_t row);
  void coagulate(const Model& m);
  void pale(const Model& m, std::size_t body, std::uint32_t vertex, std::uint8_t seen);
  double stiffness_left(const Model& m, std::uint32_t element) const;
  void list_triangle(std::uint32_t triangle);
  void touch_vertex(std::uint32_t vertex);
  void find_neighbours(Model& m, std::uint32_t triangle);

  // edit_skins.cpp
  void tear_skin(const Model& m, std::uint32_t element);
  void close_skin(Model& m);
  void add_wall(Model& m, std::size_t body, std::uint32_t triangle, std::uint32_t side);
  void heal_skin();
  std::size_t body_of_skin_triangle(std::uint32_t triangle) const;
  std::uint32_t foot_vertex(Model& m, std::size_t body, std::uint32_t vertex);
  std::uint32_t wall_count(const Model& m, std::size_t body, std::uint32_t triangle, std::uint32_t side) const;

  std::shared_ptr<const EditTables> tables_;
  std::vector<double> kept_;                   // [element]
  std::vector<std::uint32_t> live_of_body_;    // [body] elements with material
  std::vector<std::uint8_t> has_material_;     // [row]
  std::vector<std::uint32_t> batches_, gone_;  // as in Shares
  double removed_mass_kg_ = 0, removed_volume_m3_ = 0;
  ModelEdit edit_;
  std::vector<double> rest_;  // the rest shape of one record
  std::vector<Ablation> to_heal_;

  // Surfaces.
  std::vector<std::uint32_t> piece_triangle_, triangle_piece_;  // [piece], [contact triangle]
  std::vector<std::uint32_t> triangle_element_;                 // [contact triangle] the one behind; kNone: room
  std::vector<std::uint32_t> surface_vertex_;                   // [row]
  std::vector<std::uint32_t> piece_visible_, visible_vertex_;   // [piece], [row]
  std::vector<BodySurface> surfaces_;
  std::uint32_t appended_triangles_ = 0, surface_revision_ = 0, shape_revision_ = 0;
  std::vector<std::uint8_t> element_coagulation_, row_coagulation_;  // [element], [row] coagulation_seen
  bool pales_ = false;                                               // the present edit changes a vertex's colour

  // Skins, numbered as SkinTables.
  std::vector<std::uint8_t> is_torn_;         // [triangle]
  std::vector<std::uint32_t> walls_;          // [triangle, 3] first appended triangle at its edge, or mesh::kNone
  std::vector<std::uint32_t> foot_vertices_;  // [vertex] its foot, as a vertex of its body, or mesh::kNone
  std::vector<std::uint32_t> exposed_;        // pieces that came to light inside of bodies with skins

  // What the present edit has met, marked by its number.
  std::uint32_t number_ = 0;
  std::vector<std::uint32_t> row_met_, record_met_, mass_met_, linear_met_, vertex_met_;
  std::vector<std::uint32_t> rows_, records_, elements_, vertices_, went_;
  mutable std::uint32_t check_number_ = 0;
  mutable std::vector<std::uint32_t> named_;  // [element]
  mutable std::vector<std::int32_t> change_;  // [patch or surface row] triangles more than now; zeros between two calls
  std::vector<std::uint32_t> torn_;           // skin triangles that the present edit takes
  mutable std::vector<std::uint32_t> tearing_, tearing_met_, foot_met_, piece_met_;  // the same for a check
};

}  // namespace tensormass::model
