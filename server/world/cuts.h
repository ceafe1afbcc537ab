#pragma once

#include <cstdint>
#include <memory>
#include <span>

#include "core/result.h"
#include "model/cut_bodies.h"
#include "model/model.h"
#include "tensormass/v1/adjustment.pb.h"
#include "tensormass/v1/edit.pb.h"
#include "tensormass/v1/scene.pb.h"
#include "world/surface_changes.h"
#include "world/sweeps.h"

/// Cuts of a scene that steps. They are values of it, as stiffness is: a scene that is cut is the loaded scene,
/// compiled again with its bodies cut apart, and takes the place of the present one between two steps (Loop::do_swap).
///
///   EditScene ──blade──> cut_edges ──────┐
///   a tool ──BladeSweeps──> cut_along ───┼──> SceneCuts ──compile──> World, with cut_state of the present one
///   a recording, AdjustScene ──read_cuts─┘
namespace tensormass::world {

/// Returns the cuts of the values `wanted`. present: those of the scene now, which `wanted` must have, and others after
/// them. Fails if it has not, or if an edge or a crossing does not exist.
Result<model::SceneCuts> read_cuts(const v1::Scene& loaded, const v1::SceneAdjustments& wanted,
                                   const model::SceneCuts& present);
/// Puts all cuts into the values of a scene. adjustments: adjustments_of (adjustments.h), with each body
void write_cuts(const model::SceneCuts& cuts, v1::SceneAdjustments& adjustments);

/// Returns the present cuts and those of an edit. Fails if a body or a blade is not as edit.proto says, or crosses no
/// edge of the mesh.
Result<model::SceneCuts> cut_edges(const v1::Scene& loaded, const v1::SceneEdit& edit, const model::SceneCuts& present);

/// Returns the present cuts and those of the ways of blades, one for each body; the present ones if no edge is crossed.
Result<model::SceneCuts> cut_along(const v1::Scene& loaded, std::span<const SweptWay> ways,
                                   const model::SceneCuts& present);

/// A piece of a body that hangs on nothing any more.
struct FreedPiece {
  std::uint32_t body;  ///< place in Model::bodies
  double volume_m3;
};
/// Returns what further cuts have freed, in each body by volume: of a piece in two the smaller part.
std::vector<FreedPiece> freed_pieces(const model::SceneCuts& before, const model::SceneCuts& after);

/// Returns the hash of a scene that is cut. scene_hash: of its values without the cuts
std::uint64_t hash_of_cut(std::uint64_t scene_hash, const v1::SceneAdjustments& adjustments);

/// Sum over all bodies [m²].
double area_of(const model::SceneCuts& cuts);
/// Returns how the surface differs from that of the loaded scene. Leaves the revision open. model: with these cuts
std::shared_ptr<SurfaceChanges> changes_of(const model::Model& model, const model::SceneCuts& cuts);

}  // namespace tensormass::world
