#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "mesh/cut.h"

/// Crumbs: what a cut leaves with next to no material, and how it moves with the tissue beside it.
///
/// A cut may pass a node at a distance of mesh::kMinCrossing. The parts around the node then have 1e-4 of their
/// elements, and the virtual nodes of these parts 1e-7 of a node's mass. The error that an iterative solve leaves is
/// small in energy, so a row moves by an error that grows with 1 / √mass: metres in a step for such rows, whatever the
/// law is.
///
/// So no row has next to no mass, for two reasons:
///
///   slivers   a part has kLeastShare of its element's stiffness, and of the mass of each of its nodes. The other parts
///             give what it lacks, so the parts still add up to the element: mass, centre of mass, momentum and energy
///             at the cut are exact as before.
///   pieces    a cut frees no piece smaller than kLeastPiece of an element. One edge of it stays whole: the one that it
///             has most of. With a second one it could join two sides of a cut that goes on.
namespace tensormass::model {

/// Least share of a part in its element.
inline constexpr double kLeastShare = 0.02;
/// Least volume of a piece that comes free, in elements of the size of those that it was cut from.
inline constexpr double kLeastPiece = 0.5;

/// Raises the shares that are below kLeastShare, and lowers the others in proportion to what they have above it.
/// shares: of all parts of an element, at most mesh::kMaxElementParts, which sum to 1
void raise_to_least(std::span<double> shares);

/// Returns the shares of parts that physics takes. [part of the cut]
std::vector<mesh::PartShares> shares_in_physics(const mesh::Cut& cut);

/// Returns the edges of a cut that crumbs keep, one for each: indices into `edges`, ascending. Empty: it frees none. To
/// be called again after they are left out: crumbs may hang on each other.
///
///   cut         with the edges
///   volumes_m3  [element] as loaded
///   edges       of the last cut, which may be left out
std::vector<std::size_t> edges_that_crumbs_keep(const mesh::Cut& cut, std::span<const double> volumes_m3,
                                                std::span<const mesh::CutEdge> edges);

}  // namespace tensormass::model
