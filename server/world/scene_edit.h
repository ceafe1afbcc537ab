#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "core/result.h"
#include "model/edit.h"
#include "model/model.h"
#include "tensormass/v1/edit.pb.h"
#include "tensormass/v1/recording.pb.h"

/// Edits of a scene as clients and snapshots write them: names and numbers in a body, instead of those of the model.
namespace tensormass::world {

/// What World::edit takes.
struct ModelChange {
  std::vector<model::Ablation> ablations;
  std::vector<std::uint32_t> springs;
};

/// Reads an edit. Fails for names that the scene does not have, and for lists of unequal lengths; World::edit checks
/// the rest.
///
///   broken   World::broken_springs: a severing without numbers means those that are whole
Result<ModelChange> read_scene_edit(const model::Model& model, const v1::SceneEdit& edit,
                                    std::span<const std::uint8_t> broken);

void write_shares(const model::Editor::Shares& shares, v1::SnapshotState& out);
/// Reads what edits have left of a scene. World::check_shares says whether edits of this scene can have left it.
Result<model::Editor::Shares> read_shares(const model::Model& model, const v1::SnapshotState& message);

}  // namespace tensormass::world
