#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string_view>
#include <vector>

#include "mesh/cut_parts.h"
#include "mesh/cut_search.h"
#include "mesh/cut_topology.h"

namespace tensormass::mesh {

/// Least distance of a crossing from both ends of its edge, as part of the edge. Bounds the least part of an element.
inline constexpr double kMinCrossing = 0.05;
/// A crossing nearer than this to a mid-edge node is moved to this distance below it, so that the node has a side.
inline constexpr double kMiddleGap = 1e-9;

/// What the constructor of `Cut` reserves. No edit allocates memory.
struct CutReserve {
  std::uint32_t parts = 0;  ///< parts of all split elements
  std::uint32_t rows = 0;   ///< virtual nodes
};

/// A part of a split element: a copy of the element with all of its nodes.
struct CutPart {
  std::uint32_t element = kNone;
  std::uint32_t parent = kNone;  ///< the part it was split from; kNone: the whole element
  std::uint32_t next = kNone;    ///< the element's next part, by lowest corner
  std::uint8_t corners = 0;      ///< bit i: corner i has its material in this part
  std::uint32_t nodes = 0;       ///< the same for all nodes
  PartShares shares;
  /// The row of each node: the mesh node itself, or node_count + i for virtual node i. kNone beyond the element's
  /// nodes.
  std::array<std::uint32_t, kMaxElementNodes> rows{};
};

/// A virtual node: a copy of a mesh node without material of its own, free to move with the material beyond a cut.
/// Starts with the state of its parent.
struct VirtualNode {
  std::uint32_t node = kNone;    ///< the mesh node at whose place it rests
  std::uint32_t parent = kNone;  ///< the row that this one was split from
};

/// Why an edit was refused. The mesh is then as before.
enum class CutRefusal {
  kUnknownEdge,  ///< an edge's index is beyond the mesh's edges
  kCrossing,     ///< a crossing is not a number from 0 to 1
  kPartsFull,    ///< the reserve of parts is used up
  kRowsFull,     ///< the reserve of rows is used up
};

/// Returns what happened and what helps.
std::string_view words(CutRefusal refusal);

/// What an edit changed. Spans are valid until the next edit.
struct CutChange {
  bool refused = false;
  CutRefusal refusal{};                  ///< valid if refused
  std::span<const std::uint32_t> edges;  ///< newly cut, ascending
  std::span<const std::uint32_t>
      elements;                          ///< those with a newly cut edge, ascending: parts, shares or surface changed
  std::span<const std::uint32_t> parts;  ///< changed and new ones, ascending
  std::uint32_t first_part = 0;          ///< parts from here on are new
  std::uint32_t first_row = 0;           ///< virtual nodes from here on are new (index into `virtual_nodes`)
};

/// Material that hangs together.
struct CutPiece {
  std::uint32_t row = kNone;  ///< its lowest row
  double volume_m3 = 0.0;
};

/// A mesh that is being cut, by virtual nodes (Molino, Bao, Fedkiw 2004).
///
/// State is the set of cut edges with their crossings. A cut edge stays cut, and its first crossing stays. Elements
/// whose corners no longer hang together by uncut edges have parts. Two parts of neighbours share all nodes of their
/// common face if a corner of the face belongs to both; a whole element has all of its corners. What remains apart gets
/// rows of its own.
///
/// Parts and which of them share rows depend on the cut edges alone. The numbers of parts and virtual nodes follow the
/// order of edits: they are only appended, and a row keeps its number.
///
/// Shares of an element's parts stay as they are when further edges are cut, unless the element or one of its faces is
/// separated further; then the shares of all its parts change.
class Cut {
 public:
  /// The topology must outlive this object.
  Cut(const CutTopology& topology, const CutReserve& reserve);

  /// Cuts edges; those that are cut already are ignored. Takes O(what changes) time and allocates nothing.
  CutChange cut(std::span<const CutEdge> edges);

  /// Heals all cuts.
  void reset();

  const CutTopology& topology() const { return topology_; }
  bool is_cut(std::uint32_t edge) const { return edge_cut_[edge] != 0; }
  /// The crossing of a cut edge, from 0 at its lower node to 1, at least kMinCrossing from both.
  double crossing(std::uint32_t edge) const { return crossings_[edge]; }
  std::span<const CutPart> parts() const { return parts_; }
  std::span<const VirtualNode> virtual_nodes() const { return virtual_nodes_; }
  std::uint32_t row_count() const { return topology_.node_count() + static_cast<std::uint32_t>(virtual_nodes_.size()); }
  /// The element's first part, kNone if it is whole.
  std::uint32_t first_part(std::uint32_t element) const { return first_part_[element]; }
  /// The part that has a local corner's material. The element must be split; a whole one has its nodes as rows.
  std::uint32_t part_of(std::uint32_t element, std::uint32_t corner) const;
  /// The element's cut edges, with crossings along their local directions.
  ElementCut element_cut(std::uint32_t element) const;
  PartLabels labels(std::uint32_t element) const;

  /// Writes the pieces by lowest row to `room`; returns how many there are, which may be more than `room` has. Takes
  /// O(mesh) time and allocates nothing.
  std::size_t pieces(std::span<CutPiece> room);

 private:
  struct Member {
    std::uint32_t part;
    std::uint32_t node;  // local
    std::uint32_t set;   // union-find over members
    std::uint32_t row;   // known for a set's root only
  };
  struct Saved {
    std::uint32_t index;
    CutPart part;
  };

  bool take_edges(std::span<const CutEdge> edges, CutRefusal& refusal);
  bool split(std::uint32_t element);
  bool join(std::uint32_t node);
  void share(std::uint32_t element);
  void undo();
  CutPart& change(std::uint32_t part);
  std::uint32_t find(std::uint32_t member);
  void unite(std::uint32_t a, std::uint32_t b);
  void unite_across(std::uint32_t element, std::uint32_t face);
  std::uint32_t member_of(std::uint32_t element, std::uint32_t corner) const {
    return member_of_part_[part_of(element, corner)];
  }

  const CutTopology& topology_;
  CutReserve reserve_;
  std::vector<std::uint8_t> edge_cut_;
  std::vector<double> crossings_;
  std::vector<std::uint32_t> first_part_;
  std::vector<CutPart> parts_;
  std::vector<VirtualNode> virtual_nodes_;
  std::vector<double> element_volume_m3_;

  // Scratch of one edit, reserved for the largest.
  std::uint64_t edit_ = 0;
  std::uint32_t parts_before_ = 0, rows_before_ = 0;
  std::vector<std::uint64_t> element_edit_, node_edit_, part_edit_;
  std::vector<std::uint32_t> new_edges_, touched_elements_, split_elements_, touched_nodes_, changed_parts_;
  std::vector<Saved> saved_;
  std::vector<Member> members_;
  std::vector<std::uint32_t> member_of_part_;
  std::vector<std::uint32_t> piece_of_row_;
  std::vector<double> piece_volume_m3_;
};

}  // namespace tensormass::mesh
