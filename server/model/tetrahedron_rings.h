#pragma once

#include <cstdint>
#include <vector>

#include "model/read_parts.h"

/// Which linear tetrahedra form a cluster (clusters.h): those around an edge.
///
///        b            Tetrahedra a b 1 2, a b 2 3, ..: all have the edge a b.
///      / | \          Six of them that close the ring have eight nodes.
///     1--2--3 ..
///      \ | /
///        a
namespace tensormass::model {

/// Elements of a body that share an edge, in ascending order.
using ElementRing = std::vector<std::uint32_t>;

/// Divides the linear tetrahedra of a body into rings of two to six with at most eight nodes. Returns none without
/// selective quadrature. A few tetrahedra stay alone.
///
/// All tetrahedra of a ring have the same material, because the ring evaluates the whole law.
///
/// Greedy: first all rings of six, then of five, and so on to two. The longest edge is next, because tetrahedra around
/// a long edge are compact together: around the diagonal of a box they are the box. Lengths within 1e-6 of the longest
/// are equal, and the edge with the lower nodes is next. O(n log n), deterministic.
std::vector<ElementRing> ring_tetrahedra(const ReadBody& body);

}  // namespace tensormass::model
