#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <utility>
#include <vector>

#include "core/result.h"
#include "mesh/cut.h"
#include "mesh/cut_changes.h"
#include "mesh/cut_surface.h"
#include "mesh/surface.h"
#include "model/compile_parts.h"
#include "model/read_parts.h"
#include "model/tetrahedron_rings.h"
#include "physics/element/quadrature.h"

/// Bodies that are cut apart, as meshes that the other parts of the compiler read like any other.
///
///   mesh as loaded ──mesh::Cut──> cut edges, parts, virtual nodes ──cut_apart──> mesh with copies
///
///                  4 ─── 5                 4 ─── 5            Element A = (0 1 4), cut at edges 0-4 and 1-4:
///                  │╲ B  │                 │╲ B  │
///                  │A ╲  │                 a'── b'            its place    (0 1 c')   has the corners 0 and 1
///                  0 ─── 1                 ..................
///                                          0 ─ c'─ 1          a copy       (a' b' 4)  has the corner 4
///
/// A part of an element is a copy of it: the same shape and gradients, weights times what it has of each quadrature
/// point, masses times what it has of each node's. The part with the lowest corner has the place of the element, the
/// others follow the elements as loaded. Virtual nodes follow the nodes as loaded. No number changes when a body is cut
/// further.
///
/// Sources: Molino, Bao, Fedkiw 2004 (virtual nodes); Hansbo, Hansbo 2004 (the same functions as an enrichment).
namespace tensormass::model {

/// One cut of a body, and what the numbers of its parts and vertices depend on.
struct CutBatch {
  std::uint32_t order = 0;              ///< grows with each cut of the scene, whatever body it is in
  std::vector<mesh::CutEdge> edges;     ///< as they were crossed; the first crossing of an edge counts
  std::uint32_t appended_vertices = 0;  ///< after it, of this body
};

/// The cuts of a body. Scenes share it, so it must not change once a scene has it: cut a copy.
class BodyCut {
 public:
  /// body: whole. Fails if it has a shape whose parts the physics does not know yet.
  static Result<std::unique_ptr<BodyCut>> make(const ReadBody& body);
  /// Returns a body with the same cuts, to be cut further.
  std::unique_ptr<BodyCut> copy() const;

  /// Returns the edges of a cut without those that crumbs keep (crumbs.h). O(mesh). The body is as before.
  std::vector<mesh::CutEdge> without_crumbs(std::vector<mesh::CutEdge> edges);
  /// Makes a cut. Fails, and leaves the body as it was, if an edge does not exist or a reserve is used up.
  Result<void> make_cut(std::uint32_t order, std::vector<mesh::CutEdge> edges);

  /// What cuts never change. Copies share it.
  struct Whole {
    mesh::Mesh mesh;                 ///< as loaded
    std::vector<ElementRing> rings;  ///< tetrahedron_rings.h
    mesh::CutTopology topology{mesh};
    std::vector<mesh::BoundaryFace> faces{mesh::boundary_faces(mesh)};
    mesh::Surface surface{mesh::surface_of(mesh, faces)};
    std::vector<double> volumes_m3;  ///< [element]

    Whole(mesh::Mesh of_mesh, std::vector<ElementRing> of_rings);
    Whole(const Whole&) = delete;  // the topology refers to the mesh
  };
  const Whole& whole() const { return *whole_; }
  const mesh::CutTopology& topology() const { return whole_->topology; }
  const mesh::Cut& cut() const { return cut_; }
  /// What physics takes of each part of the cut: crumbs.h.
  const std::vector<mesh::PartShares>& shares() const { return shares_; }
  const mesh::CutChanges& changes() const { return changes_; }
  /// The whole surface after the last cut. Must have a cut.
  const mesh::CutSurface& surface() const { return *surface_; }
  const std::vector<CutBatch>& batches() const { return batches_; }
  double area_m2() const { return area_m2_; }  ///< sum over all cuts, one side of each
  /// What hangs together, by lowest row; and the same of the body as loaded.
  const std::vector<mesh::CutPiece>& pieces() const { return pieces_; }
  const std::vector<mesh::CutPiece>& whole_pieces() const { return whole_pieces_; }

  BodyCut(const BodyCut&) = delete;
  BodyCut& operator=(const BodyCut&) = delete;

 private:
  BodyCut(std::shared_ptr<const Whole> whole, mesh::CutChanges changes);
  void cut_again(const std::vector<CutBatch>& batches);

  std::shared_ptr<const Whole> whole_;
  mesh::Cut cut_;
  mesh::CutChanges changes_;
  std::shared_ptr<const mesh::CutSurface> surface_;
  std::vector<CutBatch> batches_;
  std::vector<mesh::CutPiece> pieces_, whole_pieces_;
  double area_m2_ = 0;
  std::vector<mesh::PartShares> shares_;
};

/// Returns where each appended vertex of each body is among those of the scene: [body][vertex]. Later cuts append.
std::vector<std::vector<std::uint32_t>> places_of_appended(const SceneCuts& cuts);

/// Returns the bodies with the copies that their cuts make.
Result<ReadBodies> cut_apart(ReadBodies whole, const SceneCuts& cuts);

/// A copy of an element, or an element that is whole.
struct ElementPart {
  std::uint32_t loaded;                      ///< the element as loaded, numbered in the body
  std::uint32_t part;                        ///< index into Cut::parts; mesh::kNone: the element is whole
  const mesh::PartShares* shares = nullptr;  ///< nullptr: it has all of its material
};
/// element: numbered in the body
ElementPart part_of(const ReadBody& body, std::uint32_t element);

/// Returns whether tools touch faces of cuts in elements of a shape (view::CarriedView).
bool carries_triangles(const mesh::Topology& shape);

/// Returns the faces that belong to one element of the mesh as loaded and that no cut crosses, with the rows of the
/// copies that have them. Numbered in the body. With those that elements carry, tools can touch all of the surface.
std::vector<mesh::BoundaryFace> uncut_boundary_faces(const ReadBody& body);

/// Returns what is left of the rings of a body that is cut: members that still hang together by their faces.
std::vector<ElementRing> rings_of_cut(const ReadBody& body);

/// Returns what a copy has of each quadrature point; empty: the element is whole.
///
/// weights: of the points of the whole element [m³], in the order of physics::rest_points. rule: of its shape, in full
std::vector<double> point_shares_of(const ReadBody& body, const ElementPart& part, std::span<const double> weights,
                                    const physics::QuadratureRule& rule);

/// Multiplies the weights of an element's quadrature points by what a copy has of them. A point without any gets
/// zero gradients too, so it does nothing.
template <class Shape>
void take_part(const ReadBody& body, std::uint32_t element, physics::ElementAtRest<Shape>& rest) {
  const ElementPart part = part_of(body, element);
  if (part.shares == nullptr) return;
  std::vector<double> weights;
  for (const auto& point : rest.points) weights.push_back(point.back());
  const std::vector<double> shares = point_shares_of(body, part, weights, Shape::full_rule());
  for (std::size_t q = 0; q < shares.size(); ++q) {
    rest.points[q].back() *= shares[q];
    if (!(shares[q] > 0)) rest.points[q].fill(0);
  }
}

}  // namespace tensormass::model
