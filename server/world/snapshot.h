#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "core/result.h"
#include "model/model.h"
#include "world/world.h"

/// Snapshots of a scene: bytes for a file or a call (SnapshotState in recording.proto has their form).
namespace tensormass::world {

/// The state of a scene's loop between two steps.
struct LoopState {
  World::Saved world;
  std::uint64_t next_diagnostics = 0;  ///< step after which the elements are checked next
};

/// Puts the header in front of a content (SnapshotState).
std::string seal_snapshot(const std::string& content);
/// Returns a header and the state. scene_hash: hash_of the scene that the model was compiled from.
std::string write_snapshot(const model::Model& model, std::uint64_t scene_hash, const LoopState& state);
/// Reads a snapshot for a loaded scene. Refuses with the reason what is not a snapshot, damaged, of another version,
/// scene or layout, or has numbers that no step of the scene ends with. present: the scene's own history, whose arrays
/// have the right sizes.
Result<LoopState> read_snapshot(const model::Model& model, std::uint64_t scene_hash,
                                const backend::StepHistory& present, std::string_view bytes);

}  // namespace tensormass::world
