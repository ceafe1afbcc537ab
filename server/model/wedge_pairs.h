#pragma once

#include <array>
#include <cstdint>
#include <vector>

#include "mesh/mesh.h"
#include "model/compile_parts.h"
#include "physics/element/element.h"
#include "physics/lists.h"

/// Pairs of wedges that share a volumetric quadrature point, so that wedges do not lock near ν = 0.5.
///
/// Why: selective quadrature gives each element one point for its change of volume, which is one constraint. In the
/// plane of its triangles a mesh of wedges has two elements to a node. Two constraints take both displacements of the
/// node in that plane, and the mesh locks like linear triangles. Two wedges that share a quadrilateral face have one
/// constraint together (de Souza Neto, Pires, Owen 2005, written as an energy):
///
///   3 ------ 2        one face of each wedge, seen along the prism axis
///   | \    B |        the pair has the eight nodes of a hexahedron
///   |  A  \  |
///   0 ------ 1        ā_k = (∫ ∇N_k dV over both wedges) / (V₁ + V₂)
///
///   W = Σ over both wedges ∫ W_dev(F) dV + (V₁ + V₂) W_vol(I + Σ_k u_k ⊗ ā_k)
///
///   V₁, V₂        volumes at rest [m³]
///   N_k, u_k      shape function and displacement of node k
///   W_dev, W_vol  deviatoric and volumetric part of the law's energy density [J/m³]
///
/// A pair has eight nodes and one point, so the element pass of the hexahedron runs it without a change. A wedge
/// without a partner keeps its own point.
namespace tensormass::model {

/// The shape whose element pass evaluates a pair.
using WedgePairShape = physics::Hexahedron;

/// Two elements of a body's mesh, in ascending order.
using ElementPair = std::array<std::uint32_t, 2>;

/// Pairs the wedges of a body. Returns the pairs in ascending order; none without selective quadrature.
///
/// Both wedges have the same law, Young's modulus, Poisson's ratio and Prony terms. The volumetric part of a law
/// depends on nothing else; fibres belong to the deviatoric part.
///
/// Greedy: a wedge with one candidate left is paired first, so that few stay alone. Otherwise the pair with the largest
/// common face is next, because it is the most compact: the halves of a box become the box. O(n log n), deterministic.
std::vector<ElementPair> pair_wedges(const ReadBody& body);

/// Fills Compilation::wedge_pairs. Warns if many wedges of a body stay alone and lock.
void make_wedge_pairs(Compilation& c);

/// Returns the pairs as a block of elements, for the layout only: the matrix couples all nodes of a pair.
mesh::ElementBlock wedge_pair_block(const Compilation& c);

/// The quadrature point of a pair.
struct WedgePairAtRest {
  physics::ElementAtRest<WedgePairShape> rest;
  double first_part;  ///< V₁ / (V₁ + V₂)
};
WedgePairAtRest wedge_pair_at_rest(const Compilation& c, const WedgePair& pair);

}  // namespace tensormass::model
