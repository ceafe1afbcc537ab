#pragma once

#include <span>
#include <vector>

#include "model/compile_parts.h"
#include "physics/element/element.h"
#include "physics/lists.h"

/// Clusters: elements that share a quadrature point, so that selective quadrature does not lock near ν = 0.5.
///
/// Why: selective quadrature gives each element one point for its change of volume, which is one constraint. Wedges and
/// linear tetrahedra have more elements than displacements that could satisfy the constraints, and the mesh locks.
/// A cluster has one constraint:
///
///   W = Σ_e V_e [(1 − d) W_dev(F_e)] + V [d W_dev(F̄) + W_vol(F̄)]      F̄ = I + Σ_k u_k ⊗ ā_k
///
///   e, V_e        element of the cluster, its volume at rest [m³]; V = Σ_e V_e
///   F_e, F̄        deformation gradient of the element, and its mean over the cluster
///   ā_k           (Σ_e V_e ∇N_k) / V, mean gradient of node k [1/m]
///   W_dev, W_vol  deviatoric and volumetric part of the law's energy density [J/m³]
///   d             part of the deviatoric energy that the cluster takes over
///
///                                    wedges (wedge_pairs.h)    linear tetrahedra (tetrahedron_rings.h)
///   elements of a cluster            2, with a common face     2 to 6, with a common edge
///   d                                0                         kRingPart
///
/// Wedges: de Souza Neto, Pires, Owen 2005 (F-bar patches), written as an energy. Linear tetrahedra are too stiff in
/// bending even if their volume is free to change. The mean gradient of a ring is not too stiff, but motions within the
/// ring cost it no energy. So the tetrahedra keep a part of the energy, as Puso and Solberg 2006 do for means around
/// nodes.
///
/// A cluster has eight nodes and one point, so the element pass of the hexahedron evaluates it without a change. A
/// smaller cluster takes neighbouring nodes in addition, whose gradients are zero.
namespace tensormass::model {

/// d of linear tetrahedra. docs/decisions/mesh.md has the measurements.
inline constexpr double kRingPart = 0.7;

/// Whether two materials may share a point for the change of volume. The volumetric part of a law depends on nothing
/// else; fibres belong to the deviatoric part.
bool same_dilatation(const Material& a, const Material& b);

struct Clusters {
  std::vector<Cluster> clusters;
  std::vector<Finding> findings;  ///< many elements of a body stay alone and lock
};
/// Makes the clusters of all bodies, one body after the other.
Clusters make_clusters(std::span<const ReadBody> bodies);

/// Returns the point of a cluster and its weights of the moduli.
physics::ElementAtRest<ClusterShape> mean_at_rest(const Cluster& cluster);

}  // namespace tensormass::model
