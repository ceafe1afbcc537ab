#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "mesh/mesh.h"
#include "model/compile_parts.h"
#include "physics/element/element.h"
#include "physics/lists.h"

/// Wedges that do not lock near ν = 0.5.
///
/// Selective quadrature gives an element one point for its change of volume. In the plane of its triangles a mesh of
/// wedges has two of them to a node, so that these constraints leave a node's two displacements there no freedom: it
/// locks like linear triangles. Two wedges that share a quadrilateral face therefore have that point together, with the
/// gradients' mean over both and the volume of both (the patches of de Souza Neto, Pires, Owen 2005, as an energy):
///
///   ā_k = (∫ ∇N_k dV over both) / (V₁ + V₂)      W = Σ of both wedges ∫ W_dev(F) dV + (V₁ + V₂) W_vol(I + Σ u_k ⊗ ā_k)
///
/// A pair has eight nodes and one point, so that the element pass of the shape with eight nodes runs it as it is. A
/// wedge without a partner keeps its own point.
namespace tensormass::model {

/// The shape whose element pass runs a pair.
using WedgePairShape = physics::Hexahedron;

/// Elements of the body's mesh, the first before the second; the pairs in the order of their first.
using ElementPair = std::array<std::uint32_t, 2>;

/// Pairs the wedges of a body under selective quadrature; none under another. Both have the same law, Young's modulus,
/// Poisson's ratio and memory, which is all that the volumetric part of a law depends on (fibres belong to the rest).
///
/// A wedge that has one candidate left is served first, so that few stay alone; otherwise the largest face, which makes
/// the pair that is the most compact: of a box cut in two, the box. O(n log n), deterministic.
std::vector<ElementPair> pair_wedges(const ReadBody& body);

/// Fills Compilation::wedge_pairs; warns where many wedges stay alone and lock.
void make_wedge_pairs(Compilation& c);

/// The nodes of the pairs as elements. They are none of the scene, but couple all nodes of a pair in the matrix.
mesh::ElementBlock wedge_pair_block(const Compilation& c);

/// The point of a pair, and the first wedge's part of its volume.
struct WedgePairAtRest {
  physics::ElementAtRest<WedgePairShape> rest;
  double first_part;
};
WedgePairAtRest wedge_pair_at_rest(const Compilation& c, const WedgePair& pair);

}  // namespace tensormass::model
