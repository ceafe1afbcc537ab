#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "model/read_parts.h"

/// Which wedges form a cluster (clusters.h).
///
///   3 ------ 2        one face of each wedge, seen along the prism axis
///   | \    B |        the pair has the eight nodes of a hexahedron
///   |  A  \  |
///   0 ------ 1
///
/// In the plane of its triangles a mesh of wedges has two elements to a node. Two constraints take both displacements
/// of the node in that plane. Two wedges that share a quadrilateral face have one constraint together.
namespace tensormass::model {

/// Two elements of a body's mesh, in ascending order.
using ElementPair = std::array<std::uint32_t, 2>;

/// Pairs the wedges of a body. Returns the pairs in ascending order; none without selective quadrature.
///
/// Both wedges have the same law, Young's modulus, Poisson's ratio and Prony terms.
///
/// Greedy: a wedge with one candidate left is paired first, so that few stay alone. Otherwise the pair with the largest
/// common face is next, because it is the most compact: the halves of a box become the box. O(n log n), deterministic.
std::vector<ElementPair> pair_wedges(const ReadBody& body);

}  // namespace tensormass::model
