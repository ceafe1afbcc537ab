#pragma once

#include <array>
#include <cstdint>
#include <span>

#include <Eigen/Core>

#include "mesh/shapes.h"

/// What cut edges make of one element: its parts, their shares of volume and mass, and the faces between them.
///
/// A part is a set of corners that hang together by uncut edges. Each part gets the space around its corners (dual
/// subdivision): an edge has a point P, a face a point F, an element a point C, and the tetrahedra C u v F fill the
/// element, where u v is a piece of an edge between a node and P, or between two nodes:
///
///        b                  P   where the edge is cut
///        |╲                 F   mean of the P of a face's cut edges if at least two are cut, otherwise of its middles
///      P +  ╲               C   mean of the P of all edges between two parts
///        |╲F─+ P
///        |   ╲ ╲            Corner a has the tetrahedra over a P F and a F P.
///        a ────── c         Corners b and c have those over P b F, b c F and c P F.
///
/// Both elements of a face see the same P and F, so faces between parts close without gaps. C lies inside because the
/// edges between two parts never all lie in one face. All tetrahedra have positive volume in the reference shape.
///
/// Everything here depends on the cut edges alone, not on the order in which they were cut.
namespace tensormass::mesh {

inline constexpr std::size_t kMaxElementCorners = 8;
inline constexpr std::size_t kMaxElementNodes = 20;
inline constexpr std::size_t kMaxElementEdges = 12;
/// Parts of an element: at most one a corner.
inline constexpr std::size_t kMaxElementParts = kMaxElementCorners;
/// Half the width around an edge's middle in which a crossing takes the place of the mid-edge node in faces.
inline constexpr double kMiddleWidth = 0.02;

/// An element and its cut edges.
struct ElementCut {
  const Topology* shape = nullptr;
  std::uint32_t cut_edges = 0;                       ///< bit i: `Topology::edges[i]` is cut
  std::array<double, kMaxElementEdges> crossings{};  ///< where edges are cut, from 0 at nodes[0] to 1 at nodes[1]

  bool is_cut(std::size_t edge) const { return (cut_edges >> edge & 1u) != 0; }
};

/// Which part each corner belongs to. Parts are ordered by their lowest corner.
struct PartLabels {
  std::uint8_t count = 1;
  std::array<std::uint8_t, kMaxElementCorners> part{};

  /// Returns the corners of a part, one bit each.
  std::uint8_t corners(std::uint8_t of_part) const;
};

/// Returns the parts of an element.
PartLabels label_parts(const Topology& shape, std::uint32_t cut_edges);

/// Returns the corner on whose side of its edge a mid-edge node lies: nodes[0] if the edge is cut beyond its middle, or
/// not at all. A crossing exactly in the middle has no side that all elements of the edge agree on; `Cut` has none.
std::uint8_t owner_of_middle(const ElementCut& cut, std::size_t edge);

/// A part's shares. Those of all parts of an element sum to 1.
struct PartShares {
  double volume = 0.0;
  /// Share of each node's mass in this element: what the part has of ∫ N_k dV, with N_k of the linear shape. A mid-edge
  /// node takes 4 N_a N_b of its ends instead, because quadratic N_k have both signs. In linear tetrahedra, and in
  /// hexahedra and wedges with parallel sides, mass and centre of mass of each part are then exact.
  std::array<double, kMaxElementNodes> nodes{};
};

/// Computes the shares of all parts.
///
/// positions_m: the element's nodes at rest [m]. Volumes are measured there, so they are what the visible surface
/// encloses. In an element so distorted that a tetrahedron of the subdivision is inverted they are measured in the
/// reference shape.
std::array<PartShares, kMaxElementParts> part_shares(const ElementCut& cut, const PartLabels& labels,
                                                     std::span<const Eigen::Vector3d> positions_m);

/// Computes what share of a quadrature point each part has: the volume of the part's tetrahedra that are nearer to it
/// than to other points, over that of all tetrahedra nearest to it. A point without any takes the shares of volume.
///
/// points: reference coordinates, as in physics/element. shares: [point, part], kMaxElementParts for each point.
void point_shares(const ElementCut& cut, const PartLabels& labels, std::span<const Eigen::Vector3d> points,
                  std::span<std::array<double, kMaxElementParts>> shares);

/// Values of the linear shape functions at a reference point, one for each corner.
std::array<double, kMaxElementCorners> corner_values(const Topology& shape, const Eigen::Vector3d& at);

/// A point of the subdivision. Its position is a fixed weighted sum of an element's nodes, at rest and deformed.
struct CutPoint {
  enum class Kind : std::uint8_t { kNode, kEdge, kFace, kCell };
  Kind kind = Kind::kNode;
  std::uint8_t index = 0;  ///< local node, edge or face
  bool operator==(const CutPoint&) const = default;
};

/// Returns a point's weights on the element's nodes. They sum to 1.
std::array<double, kMaxElementNodes> point_weights(const ElementCut& cut, const PartLabels& labels, CutPoint point);

/// A triangle of a part's surface, counter-clockwise seen from outside of the part.
struct CutTriangle {
  std::uint8_t part = 0;
  std::array<CutPoint, 3> points;
};

/// Triangles between the parts of an element, at most four for each edge; those of a face, at most four for each side.
inline constexpr std::size_t kMaxSheetTriangles = 4 * kMaxElementEdges;
inline constexpr std::size_t kMaxFaceTriangles = 4 * kMaxFaceCorners;

/// Writes the triangles between parts, each seen from both sides; returns how many. They are those of the quads
/// P F C F', cut along P C. `room` has kMaxSheetTriangles.
std::size_t sheet_triangles(const ElementCut& cut, const PartLabels& labels, std::span<CutTriangle> room);

/// Writes the triangles of a face with at least one cut edge; returns how many. Uncut edges stay whole, so that faces
/// beside it fit. `room` has kMaxFaceTriangles.
std::size_t face_triangles(const ElementCut& cut, const PartLabels& labels, std::size_t face,
                           std::span<CutTriangle> room);

}  // namespace tensormass::mesh
